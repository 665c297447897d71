"""`imud replay`: run a capture through the daemon's whole path, for clients to read, or printed."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec

from imud import config
from imud.cli.arguments import CliCommand, add_option, driver_settings, given_options
from imud.cli.status import block
from imud.contracts.can import CanDriver
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceStatus
from imud.daemon import Daemon
from imud.devices import DRIVERS
from imud.errors import ImudError
from imud.event import Event
from imud.links import LINKS
from imud.log import STDERR, log_to
from imud.runtime import event_loop

SPEEDS = ("recorded", "real", "maximum")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud replay`."""
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="capture, raw or time-stamped; for CAN a log of candump -L"
    )
    parser.add_argument("--driver", default="hipnuc-uart", choices=sorted(DRIVERS), help="default: %(default)s")
    parser.add_argument("--speed", default="maximum", choices=SPEEDS, help="default: %(default)s")
    parser.add_argument("--baud", type=int, default=115200, help="rate of a raw capture (default: %(default)s)")
    parser.add_argument(
        "--socket", type=Path, metavar="PATH", help="serve the samples on this socket, as the daemon does"
    )
    add_option(parser)
    parser.add_argument("--json", action="store_true", help="print every sample, one JSON object per line")


def run(args: argparse.Namespace) -> int:
    """Play the file to its end; the ledger goes to standard error. 1 when there was no sample in it."""
    with log_to(STDERR, "warning"):
        status = play(args)
    print(block(status), file=sys.stderr)
    return 0 if status.ledger["samples"] else 1


def play(args: argparse.Namespace) -> DeviceStatus:
    """Play the file to its end and return the state of its device then. Raises ImudError."""
    if not args.file.is_file():
        raise ImudError(f"{args.file}: expected a capture file, found none")
    settings = config.parse(configuration(args), str(args.file))
    check(settings.devices[0])
    printer = Printer(lambda: daemon.stop())  # noqa: PLW0108 - the daemon is made with the printer
    daemon = Daemon(settings, extra={"print": printer} if args.json else {}, until_finished=True)
    event_loop.run(serve(daemon))
    if printer.problem is not None:
        raise printer.problem
    return daemon.status()[0]


def check(device: config.DeviceConfig) -> None:
    """Check that the file can be played, since the daemon would retry. Raises LinkError."""
    row = LINKS[device.link]
    is_can = isinstance(DRIVERS[device.driver], CanDriver)
    link = row.make_can(device.link_settings) if is_can else row.make(device.link_settings)
    link.open()
    link.close()


async def serve(daemon: Daemon) -> None:
    """Run until the capture ends or the user interrupts."""
    daemon.install_signals()
    await daemon.run()


def configuration(args: argparse.Namespace) -> str:
    """Write the configuration of a daemon for this replay alone, as text, read the same way as a file.

    Raises BadArgument for options that the driver does not have.
    """
    driver = DRIVERS[args.driver]
    options = given_options(driver, args.option)
    driver_settings(driver, options)
    tree = {
        "socket": {"enabled": args.socket is not None, **({"path": str(args.socket)} if args.socket else {})},
        "shm": {"enabled": False},
        "metrics": {"enabled": False},
        "devices": {
            "replay": {
                "driver": args.driver,
                "options": options,
                "identify": False,
                "replay": {"path": str(args.file), "speed": args.speed, "baud": args.baud},
            }
        },
    }
    return msgspec.json.encode(tree).decode()


class Printer:
    """A publisher that prints samples as JSON lines, as long as they can be written."""

    def __init__(self, stop: Callable[[], None]) -> None:
        """`stop` is called at the first line that cannot be written."""
        self.problem: OSError | None = None
        """Why lines could not be written; None while they can."""
        self._stop = stop

    def start(self) -> None:
        """No-op: there is nothing to open."""

    def add_device(self, name: str, device_id: int) -> None:
        """No-op: every device is printed."""

    def remove_device(self, name: str) -> None:
        """No-op: nothing is kept per device."""

    def publish(self, batch: Batch) -> None:
        """One line per sample."""
        self._output("".join(msgspec.json.encode(sample).decode() + "\n" for sample in batch.samples))

    def event(self, event: Event) -> None:
        """No-op: events are in the log."""

    def tick(self, now_ns: int) -> None:
        """No-op: nothing depends on time."""

    def close(self) -> None:
        """Leave nothing in the buffer."""
        self._output("", flush=True)

    def _output(self, text: str, *, flush: bool = False) -> None:
        if self.problem is not None:
            return
        try:
            print(text, end="", flush=flush)
        except OSError as error:
            self.problem = error
            self._stop()


REPLAY = CliCommand(add_arguments, run)
