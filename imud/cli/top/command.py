"""Table of what `imud top` reads of the daemon for which screen, and the command itself."""

import argparse
import sys
from collections.abc import Callable
from typing import Final

from imud.cli.arguments import CliCommand, add_socket
from imud.client.feed import Feed, News, Wish
from imud.errors import BadArgument

OVERVIEW_HZ: Final = 4.0
DEVICE_HZ: Final = 20.0


class TopFeed(Feed):
    """What the screens read: all devices slowly, or one of them faster."""

    def __init__(self, path: str, on_news: Callable[[News], None]) -> None:
        super().__init__(path, on_news, Wish(rate_hz=OVERVIEW_HZ))

    def look_at(self, device: str | None) -> None:
        """Read samples of this device only, and more of them; None for all devices."""
        self.want(Wish(rate_hz=OVERVIEW_HZ) if device is None else Wish((device,), DEVICE_HZ))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud top`."""
    add_socket(parser)


def run(args: argparse.Namespace) -> int:
    """Show the table until `q`. Raises BadArgument without a terminal, or without the library that draws."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise BadArgument("expected a terminal; `imud status` and `imud watch` write to anything")
    try:
        from imud.cli.top.app import TopApp
    except ModuleNotFoundError as error:
        raise BadArgument(f"it needs {error.name}: pip install 'imud[top]'") from None
    TopApp(lambda on_news: TopFeed(args.socket, on_news)).run()
    return 0


TOP = CliCommand(add_arguments, run)
