"""`imud fleet top`: the overview of all gateways, redrawn in place in a terminal, else one table after another."""

import argparse
import asyncio
import signal
import sys
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Final, Protocol

from imud.cli.fleet.overview import FleetOverview
from imud.cli.streams import complain
from imud.errors import BadArgument
from imud.fleet import Fleet

INTERVAL_S: Final = 1.0
INTERVAL_LEAST_S: Final = 0.1
INTERVAL_MOST_S: Final = 3600.0


class _Screen(Protocol):
    def show(self, text: str) -> None: ...
    def close(self) -> None: ...


class _Lines:
    """One text after another."""

    def show(self, text: str) -> None:
        print(text, flush=True)

    def close(self) -> None:
        """No-op."""


class _Redrawn:
    """Each text in the place of the one before, by rich. Raises BadArgument without the extra `top`."""

    def __init__(self) -> None:
        try:
            from rich.live import Live
            from rich.text import Text
        except ModuleNotFoundError as error:
            words = f"imud fleet top: it needs {error.name}: pip install 'imud[top]'; or use --plain"
            raise BadArgument(words) from None
        self._text: Callable[[str], Text] = Text
        self._live = Live(screen=True, auto_refresh=False)
        self._live.start()

    def show(self, text: str) -> None:
        self._live.update(self._text(text), refresh=True)

    def close(self) -> None:
        self._live.stop()


def add_top(parser: argparse.ArgumentParser) -> None:
    """Add the options that only this action has."""
    parser.add_argument(
        "--interval", type=float, default=INTERVAL_S, metavar="S", help="time between pictures (default: %(default)g)"
    )
    parser.add_argument("--plain", action="store_true", help="one table after another, as where it is no terminal")


async def run_top(args: argparse.Namespace, fleet: Fleet) -> int:
    """Show the gateways until SIGINT, SIGTERM, or --duration; 1 if there was none. Raises ImudError."""
    if not INTERVAL_LEAST_S <= args.interval <= INTERVAL_MOST_S:
        raise BadArgument(f"--interval: expected {INTERVAL_LEAST_S:g} to {INTERVAL_MOST_S:g}, got {args.interval:g}")
    loop, overview = asyncio.get_running_loop(), FleetOverview(fleet)
    with closing(_Redrawn() if sys.stdout.isatty() and not args.plain else _Lines()) as screen:
        reading = asyncio.ensure_future(_read(args, fleet, overview))
        drawing = asyncio.ensure_future(_draw(screen, overview, args.interval))
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, drawing.cancel)
        await asyncio.wait((reading, drawing), timeout=args.duration, return_when=asyncio.FIRST_COMPLETED)
        for task in (drawing, reading):
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
    if fleet.problem:
        complain(f"nothing comes at the end: {fleet.problem}")
    return 0 if fleet.states else 1


async def _read(args: argparse.Namespace, fleet: Fleet, overview: FleetOverview) -> None:
    async for batch in fleet.watch(site=args.site, gateway=args.gateway, device=args.device):
        overview.add(batch)


async def _draw(screen: _Screen, overview: FleetOverview, interval_s: float) -> None:
    while True:
        await asyncio.sleep(interval_s)
        screen.show(overview.text())
