"""`imud replay`: replay a recording or a capture. Print the samples, or serve them to clients."""

import argparse
import sys
from collections import deque
from collections.abc import Callable, Collection
from pathlib import Path
from typing import BinaryIO, Final

from msgspec.structs import replace

from imud import config
from imud.cli.arguments import (
    CliCommand,
    add_driver,
    add_interface,
    add_option,
    chosen_interface,
    driver_settings,
    given_options,
)
from imud.cli.output import paragraph
from imud.cli.status import block
from imud.contracts.codec import wrong_length_words
from imud.contracts.driver import CanDriver, StreamDriver
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceStatus
from imud.daemon import Daemon
from imud.drivers import DRIVERS
from imud.formats.can import CandumpReader
from imud.formats.capture import CaptureReader
from imud.formats.recording import MAGIC, RecordingReader, is_recording
from imud.host import event_loop
from imud.host.files import open_regular
from imud.host.log import STDERR, log_to, printable_json
from imud.links import LINKS
from imud.model.errors import BadArgument, ImudError
from imud.model.event import Event
from imud.model.ledger import bytes_open, frames_open, lost
from imud.model.units import NS_PER_MS
from imud.recording.player import PlayedDevice, Player

DIFFERENCES_SHOWN = 3
# Size of the searched part of a file with a damaged start. A block of a recording has about 256 KiB.
LOOKED_AT_BYTES: Final = 1 << 20


def looks_like_recording(path: str) -> bool:
    """Return whether a file starts like a recording, or contains the start of a block. Raises OSError."""
    with open_regular(path) as file:
        begin = file.read(LOOKED_AT_BYTES)
    # MAGIC at a later place: the first block is damaged
    return is_recording(begin) or MAGIC in begin


def play_recording(args: argparse.Namespace) -> int:
    """Replay a recording. Print the ledgers to standard error.

    Return 1 if the replay differs from the live run, or if the recording contains no sample. Raises BadArgument for
    options that apply to captures only.
    """
    for option, default in (
        ("socket", None), ("option", []), ("driver", None), ("speed", None), ("baud", None), ("interface", None),
    ):  # fmt: skip
        if getattr(args, option) != default:
            raise BadArgument(
                f"--{option} applies to captures only; a recording contains driver, options and times of the live run"
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
    """Print one JSON line per sample. Raises OSError if writing fails."""
    print("".join(printable_json(sample) + "\n" for sample in batch.samples), end="")


def play_to_end(file: BinaryIO, name: str, player: Player) -> tuple[str, int]:
    """Replay a recording to its end. Return the report as text, and the exit status of `imud replay`.

    Raises ImudError, and any OSError of the player's publisher.
    """
    reader = RecordingReader(file, name)
    player.play(reader)
    devices = player.all_devices
    report = "\n\n".join(["\n".join(device_block(device)) for device in devices] + remarks(reader, player))
    has_differences = player.is_comparable and any(device.different_checks for device in devices)
    is_complete = not has_differences and not player.lost and not reader.is_damaged
    return report, 0 if is_complete and any(device.ledger.samples for device in devices) else 1


def device_block(device: PlayedDevice, without: Collection[str] = ()) -> list[str]:
    """Format the result of a device in 80 columns, without the rows in `without`."""
    counts, before = device.ledger.snapshot(), device.before or {}
    own = {name: count - before.get(name, 0) for name, count in counts.items()}  # without the run before the recording
    path = device.path
    newest = path.newest if path is not None else device.newest
    rate_hz = path.clock.expected_rate_hz if path is not None else device.rate_hz
    unknown = path.unknown if path is not None else device.unknown
    clock = f"{newest.sync}, error {newest.t_err_ns / NS_PER_MS:.3f} ms" if newest is not None else "no sample"
    if rate_hz:
        clock += f", {rate_hz:.1f} Hz by the device's clock"
    closes = not bytes_open(counts) and not frames_open(counts)
    driver, words = device.driver, ""
    if driver is not None and unknown:
        if not counts["samples"]:
            words = driver.unknown_words(unknown, device.described.name, counted=True)
        elif isinstance(driver, StreamDriver):
            words = driver.unknown_types(unknown)
    odd = wrong_length_words(device.ledger, device.wrong_length)
    rows = [
        ("link", f"{device.described.where}, driver {device.driver.name if device.driver else 'unknown'}"),
        *(("problem", one) for one in (words, odd) if one),
        ("clock", clock),
        ("samples", f"{own['samples']}; lost {lost(own)}, {own['lost_unknown']} gaps of unknown size"),
        ("bytes", f"{own['bytes_in']}: {'all accounted for' if closes else 'NOT ALL ACCOUNTED FOR'}"),
        ("compared", comparison(device)),
    ]
    lines = paragraph(f"{device.described.name}: ", "replayed")
    for name, text in rows:
        if name not in without:
            lines += paragraph(f"  {name:<10}", text)
    return lines


def comparison(device: PlayedDevice) -> str:
    """Format the comparison of the replay with the live run."""
    if device.fresh_starts:
        return (
            f"the time stamps differ from the live run: {device.fresh_starts[0]}; the clock restarted, and its error "
            "is larger for some seconds"
        )
    if not device.different_checks:
        return f"equal to the live run at {device.checks} of {device.checks} checks"
    return f"DIFFERENT from the live run at {device.different_checks} of {device.checks} checks: " + "; ".join(
        device.differences[:DIFFERENCES_SHOWN]
    )


def remarks(reader: RecordingReader, player: Player) -> list[str]:
    """Return the problems of the file."""
    found = [f"file: {problem}" for problem in reader.problems]
    if player.lost:
        found.append(f"the recorder dropped {player.lost} records; their data is missing")
    return ["\n".join(line for words in found for line in paragraph("", words))] if found else []


class Printer:
    """Publisher that prints samples as JSON lines until writing fails."""

    def __init__(self, stop: Callable[[], None]) -> None:
        """`stop` is called after the first failed write."""
        self.problem: OSError | None = None  # error of the first failed write; None if no write failed
        self._stop = stop

    # no state per device, no timer: most methods of a publisher do nothing

    def start(self) -> None: ...

    def add_device(self, name: str, device_id: int) -> None: ...

    def remove_device(self, name: str) -> None: ...

    def event(self, event: Event) -> None: ...

    def tick(self, now_ns: int) -> None: ...

    def publish(self, batch: Batch) -> None:
        """Print one line per sample."""
        self._output("".join(printable_json(sample) + "\n" for sample in batch.samples))

    def close(self) -> None:
        """Flush the output."""
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
    "unknown: a raw capture does not contain arrival times. Rate, skew, residual, error and latency are unknown. imud "
    "computes the host times of the samples from the baud rate"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="recording of imud (no options needed), raw or time-stamped capture, or for CAN a log of candump -L",
    )
    add_driver(parser, f"driver for a capture (default: {DRIVER})")
    parser.add_argument("--speed", choices=SPEEDS, help=f"speed of a capture (default: {SPEED})")
    parser.add_argument(
        "--baud", type=int, help=f"baud rate of a capture if the capture does not contain it (default: {BAUD})"
    )
    parser.add_argument(
        "--socket", type=Path, metavar="PATH", help="serve the samples of a capture on this socket, as the daemon does"
    )
    add_option(parser)
    add_interface(parser)
    parser.add_argument(
        "--fresh", action="store_true", help="start the clocks of a recording without the state of the live run"
    )
    parser.add_argument("--json", action="store_true", help="print every sample as one JSON object per line")


def run(args: argparse.Namespace) -> int:
    """Replay the file to its end. Print the ledger to standard error. Return 1 without a sample or if damaged."""
    if not args.file.is_file():
        raise ImudError(f"{args.file}: expected a recording or a capture, found no file")
    with log_to(STDERR, "warning"):
        if looks_like_recording(str(args.file)):
            return play_recording(args)
        args.driver, args.speed = args.driver or DRIVER, args.speed or SPEED
        # 0: the baud rate of the capture
        args.baud = args.baud or (0 if names_rate(args) else BAUD)
        without_times = "" if has_times(args) else NO_TIMES
        status = play(args)
    status = replace(status, condition=None)  # the condition uses the time of this host
    print(block(status, without_times, virtual=args.speed == "maximum"), file=sys.stderr)
    driver = DRIVERS[args.driver]
    if isinstance(driver, CanDriver) and (others := others_of(args, driver)):
        print("\n".join(paragraph("file: ", others)), file=sys.stderr)
    is_damaged = not isinstance(driver, CanDriver) and problem_of(args)[1]
    return 0 if status.ledger["samples"] and not is_damaged else 1


def play(args: argparse.Namespace) -> DeviceStatus:
    """Replay a capture to its end. Return the final status of the device. Raises ImudError."""
    settings = config.parse(configuration(args), str(args.file))
    check(settings.devices[0])
    printer = Printer(lambda: daemon.stop())  # noqa: PLW0108 - `daemon` does not exist yet
    daemon = Daemon(settings, extra={"print": printer} if args.json else {}, until_finished=True)
    event_loop.run(serve(daemon))
    if printer.problem is not None:
        raise printer.problem
    return daemon.status()[0]


def has_times(args: argparse.Namespace) -> bool:
    """Return whether the file contains arrival times: a time-stamped capture or a log of candump."""
    if isinstance(DRIVERS[args.driver], CanDriver):
        return True
    with open_regular(args.file) as file:
        return CaptureReader(file).stamped


def names_rate(args: argparse.Namespace) -> bool:
    """Return whether the first line of a time-stamped capture contains the baud rate."""
    if isinstance(DRIVERS[args.driver], CanDriver):
        return False
    with open_regular(args.file) as file:
        return CaptureReader(file).baud > 0


def others_of(args: argparse.Namespace, driver: CanDriver) -> str:
    """Describe the devices of a CAN log that the options do not select; empty if there are none."""
    with open_regular(args.file) as file:
        log = CandumpReader(file, args.interface or "")
        deque(log, maxlen=0)
    return driver.other_nodes(driver_settings(driver, given_options(driver, args.option)), log.identifiers.values())


def problem_of(args: argparse.Namespace) -> tuple[str, bool]:
    """Read a capture without decoding. Return the problem of the file, and whether the file is damaged.

    A truncated end is a problem, but not damage.
    """
    with open_regular(args.file) as file:
        if isinstance(DRIVERS[args.driver], CanDriver):
            log = CandumpReader(file, args.interface or "")
            deque(log, maxlen=0)
            return log.problem, False
        reader = CaptureReader(file)
        if reader.stamped:
            deque(reader, maxlen=0)
        return reader.problem, reader.is_damaged


def check(device: config.DeviceConfig) -> None:
    """Open and close the file once: the daemon would retry forever. Raises LinkError if opening fails."""
    row = LINKS[device.link]
    is_can = isinstance(DRIVERS[device.driver], CanDriver)
    link = row.make_can(device.link_settings) if is_can else row.make(device.link_settings)
    link.open()
    link.close()


async def serve(daemon: Daemon) -> None:
    """Run the daemon until the capture ends or the user presses Ctrl-C."""
    daemon.install_signals()
    await daemon.run()


def configuration(args: argparse.Namespace) -> str:
    """Return the configuration of a daemon for this replay, as JSON. Raises BadArgument for unknown driver options."""
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
                "replay": {
                    "path": str(args.file),
                    "speed": args.speed,
                    "baud": args.baud,
                    "interface": chosen_interface(driver, args.interface),
                },
            }
        },
    }
    return printable_json(tree)


REPLAY = CliCommand(add_arguments, run)
