"""`imud replay`: run a capture through the daemon's whole path, for clients to read, or printed."""

import argparse
import sys
from collections import deque
from collections.abc import Callable, Collection
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from imud import config
from imud.cli.arguments import CliCommand, add_option, driver_settings, given_options
from imud.cli.output import paragraph
from imud.cli.status import block
from imud.contracts.driver import CanDriver
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceStatus
from imud.daemon import Daemon
from imud.drivers import DRIVERS
from imud.formats.can import CandumpReader
from imud.formats.capture import CaptureReader
from imud.formats.recording import MAGIC, RecordingReader, is_recording
from imud.host import event_loop
from imud.host.files import open_regular
from imud.host.log import STDERR, log_to
from imud.links import LINKS
from imud.model.errors import BadArgument, ImudError
from imud.model.event import Event
from imud.model.ledger import bytes_open, frames_open, lost
from imud.model.units import NS_PER_MS
from imud.recording.player import PlayedDevice, Player

DIFFERENCES_SHOWN = 3
LOOKED_AT_BYTES: Final = 1 << 20
"""Of a file whose begin is damaged: a recorder's blocks hold 256 KiB at most, but for records that are larger."""


def looks_like_recording(path: str) -> bool:
    """Whether a file is a recording by its first bytes, or by those of a later block. Raises OSError."""
    with open_regular(path) as file:
        begin = file.read(LOOKED_AT_BYTES)
    return is_recording(begin) or MAGIC in begin


def play_recording(args: argparse.Namespace) -> int:
    """Replay a recording; its ledgers go to standard error. 1 where it is not what the live run was, or has no sample.

    Raises BadArgument for options that are for captures only, ImudError.
    """
    for option, default in (("socket", None), ("option", []), ("driver", None), ("speed", None), ("baud", None)):
        if getattr(args, option) != default:
            raise BadArgument(
                f"--{option}: expected none with a recording, which has driver, options and times of the live run"
            )
    with open_regular(args.file) as file:
        return _play(file, args)


def _play(file: BinaryIO, args: argparse.Namespace) -> int:
    player = Player(print_samples if args.json else lambda _batch: None, fresh=args.fresh)
    report, status = play_to_end(file, str(args.file), player)
    sys.stdout.flush()
    print(report, file=sys.stderr)
    return status


def print_samples(batch: Batch) -> None:
    """Print one JSON line per sample. Raises OSError where it cannot be written."""
    print("".join(msgspec.json.encode(sample).decode() + "\n" for sample in batch.samples), end="")


def play_to_end(file: BinaryIO, name: str, player: Player) -> tuple[str, int]:
    """Play a recording to its end. Returns what came of it, for people, and the exit status of `imud replay`.

    Raises ImudError, and what the player's publisher raises as OSError.
    """
    reader = RecordingReader(file, name)
    player.play(reader)
    devices = list(player.devices.values())
    report = "\n\n".join(["\n".join(device_block(device)) for device in devices] + remarks(reader, player))
    same = all(not device.differences for device in devices) and not player.lost and not reader.is_damaged
    return report, 0 if same and any(device.ledger.samples for device in devices) else 1


def device_block(device: PlayedDevice, without: Collection[str] = ()) -> list[str]:
    """Format what came of a device, in 80 columns, without the rows of these names."""
    counts = device.ledger.snapshot()
    path = device.path
    newest = path.newest if path is not None else None
    clock = f"{newest.sync}, error {newest.t_err_ns / NS_PER_MS:.3f} ms" if newest is not None else "no sample"
    if path is not None and path.clock.expected_rate_hz:
        clock += f", {path.clock.expected_rate_hz:.1f} Hz by the device's clock"
    closes = not bytes_open(counts) and not frames_open(counts)
    rows = [
        ("link", f"{device.described.where}, driver {device.driver.name if device.driver else 'not found'}"),
        ("clock", clock),
        ("samples", f"{counts['samples']}; lost {lost(counts)}, {counts['lost_unknown']} gaps of unknown size"),
        ("bytes", f"{counts['bytes_in']}: {'closed' if closes else 'DOES NOT CLOSE'}"),
        ("compared", comparison(device)),
    ]
    lines = paragraph(f"{device.described.name}: ", "replayed")
    for name, text in rows:
        if name not in without:
            lines += paragraph(f"  {name:<10}", text)
    return lines


def comparison(device: PlayedDevice) -> str:
    """Format how the replay compares with what the recording says of the live run."""
    if device.fresh_starts:
        return (
            f"not the live run's stamps: {device.fresh_starts[0]}; the clock begins anew here, and needs some seconds "
            "until it is as good"
        )
    if not device.differences:
        return f"the same as the live run at {device.checks} of {device.checks} checks"
    return f"OTHER than the live run at {len(device.differences)} of {device.checks} checks: " + "; ".join(
        device.differences[:DIFFERENCES_SHOWN]
    )


def remarks(reader: RecordingReader, player: Player) -> list[str]:
    """What else is to be known of the file."""
    found = [f"the file: {problem}" for problem in reader.problems]
    if player.lost:
        found.append(f"records that were dropped when it was written: {player.lost}; what they held is missing")
    return ["\n".join(line for words in found for line in paragraph("", words))] if found else []


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
