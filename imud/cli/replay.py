"""`imud replay`: run a capture through the daemon's whole path, for clients to read, or printed."""

import argparse
import sys
from collections import deque
from pathlib import Path

import msgspec

from imud import config
from imud.cli.arguments import CliCommand, add_option, driver_settings, given_options
from imud.cli.recording.replay import Printer, looks_like_recording, play_recording
from imud.cli.status import block
from imud.contracts.can import CanDriver
from imud.contracts.status import DeviceStatus
from imud.daemon import Daemon
from imud.devices import DRIVERS
from imud.errors import ImudError
from imud.files import open_regular
from imud.formats.candump import CandumpReader
from imud.formats.capture import CaptureReader
from imud.links import LINKS
from imud.log import STDERR, log_to
from imud.runtime import event_loop

SPEEDS = ("recorded", "real", "maximum")
DRIVER, SPEED, BAUD = "hipnuc-uart", "maximum", 115200
NO_TIMES = (
    "not known: the capture has bytes and no time of any read. Rate, skew, residual, error and latency are unknown, "
    "and the host times of the samples are made of the baud rate"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud replay`."""
    parser.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="recording of imud, which needs no option; or a capture, raw or time-stamped; for CAN a log of candump -L",
    )
    parser.add_argument("--driver", choices=sorted(DRIVERS), help=f"of a capture (default: {DRIVER})")
    parser.add_argument("--speed", choices=SPEEDS, help=f"of a capture (default: {SPEED})")
    parser.add_argument("--baud", type=int, help=f"rate of a capture that names none (default: {BAUD})")
    parser.add_argument(
        "--socket", type=Path, metavar="PATH", help="serve the samples on this socket, as the daemon does"
    )
    add_option(parser)
    parser.add_argument(
        "--fresh", action="store_true", help="of a recording: begin with empty clocks, not with those of the live run"
    )
    parser.add_argument("--json", action="store_true", help="print every sample, one JSON object per line")


def run(args: argparse.Namespace) -> int:
    """Play the file to its end; the ledger goes to standard error. 1 when it has no sample, or is damaged."""
    if not args.file.is_file():
        raise ImudError(f"{args.file}: expected a recording or a capture, found none")
    with log_to(STDERR, "warning"):
        if looks_like_recording(str(args.file)):
            return play_recording(args)
        args.driver, args.speed = args.driver or DRIVER, args.speed or SPEED
        args.baud = args.baud or (0 if names_rate(args) else BAUD)
        without_times = "" if has_times(args) else NO_TIMES
        status = play(args)
    print(block(status, without_times, virtual=args.speed == "maximum"), file=sys.stderr)
    is_damaged = not isinstance(DRIVERS[args.driver], CanDriver) and problem_of(args)[1]
    return 0 if status.ledger["samples"] and not is_damaged else 1


def play(args: argparse.Namespace) -> DeviceStatus:
    """Play the file to its end and return the state of its device then. Raises ImudError."""
    settings = config.parse(configuration(args), str(args.file))
    check(settings.devices[0])
    printer = Printer(lambda: daemon.stop())  # noqa: PLW0108 - the daemon is made with the printer
    daemon = Daemon(settings, extra={"print": printer} if args.json else {}, until_finished=True)
    event_loop.run(serve(daemon))
    if printer.problem is not None:
        raise printer.problem
    return daemon.status()[0]


def has_times(args: argparse.Namespace) -> bool:
    """Whether the file says when its bytes were read: a stamped capture, or a log of a CAN bus."""
    if isinstance(DRIVERS[args.driver], CanDriver):
        return True
    with open_regular(args.file) as file:
        return CaptureReader(file).stamped


def names_rate(args: argparse.Namespace) -> bool:
    """Whether the file says at which rate its bytes came: the first line of a stamped capture."""
    if isinstance(DRIVERS[args.driver], CanDriver):
        return False
    with open_regular(args.file) as file:
        return CaptureReader(file).baud > 0


def problem_of(args: argparse.Namespace) -> tuple[str, bool]:
    """Read a capture without decoding it: what is wrong with the file, and whether that is damage, not a cut end."""
    with open_regular(args.file) as file:
        if isinstance(DRIVERS[args.driver], CanDriver):
            log = CandumpReader(file)
            deque(log, maxlen=0)
            return log.problem, False
        reader = CaptureReader(file)
        if reader.stamped:
            deque(reader, maxlen=0)
        return reader.problem, reader.is_damaged


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


REPLAY = CliCommand(add_arguments, run)
