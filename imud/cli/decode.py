"""`imud decode`: a capture in, one JSON object per message out, as gpsdecode does for GNSS receivers.

A capture is bytes, raw or time-stamped, or for CAN drivers a log of `candump -L`. Objects: a measurement with the field
names of a sample (`t_dev_ns` unwrapped, or `index` of a device that numbers its samples; no host time),
`{"text": …}` for a line of text, `{"reply": kind, "payload": hex}` for a binary reply,
`{"bad_frame": reason, "raw": hex}` for a damaged frame.
"""

import argparse
import sys
from collections.abc import Iterator
from typing import BinaryIO

import msgspec

from imud.cli.arguments import CliCommand, add_option, driver_settings, given_options
from imud.contracts.codec import BadFrame, CodecEvent
from imud.contracts.driver import SAMPLE_COUNTER, CanDriver, Driver, StreamDriver
from imud.contracts.script import ReplyFrame, TextLine
from imud.drivers import DRIVERS
from imud.formats.can import CandumpReader
from imud.formats.capture import CaptureReader
from imud.host.files import NotRegularFile, open_stream
from imud.model.errors import ImudError
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement

FIFO_WAIT_MS = 5000
"""Time for the first bytes of a FIFO."""
NOT_SHOWN = {"trailing_bytes", "dev_ticks"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud decode`."""
    parser.add_argument("--driver", required=True, choices=sorted(DRIVERS), help="wire protocol of the capture")
    parser.add_argument("file", metavar="FILE", help="capture file, or - for standard input")
    add_option(parser)


def run(args: argparse.Namespace) -> int:
    """Decode to standard output, the ledger to standard error; 1 when no message was found."""
    driver = DRIVERS[args.driver]
    settings = driver_settings(driver, given_options(driver, args.option))
    ledger = Ledger()
    write = sys.stdout.write
    with open_capture(args.file) as file:
        for line in decode(file, driver, ledger, settings):
            write(line)
    sys.stdout.flush()
    shown = {name: value for name, value in ledger.snapshot().items() if value}
    print(msgspec.json.encode(shown).decode(), file=sys.stderr)
    return 0 if ledger.frames_good else 1


def open_capture(name: str) -> BinaryIO:
    """Open the file or FIFO, or standard input for `-`. Raises ImudError."""
    try:
        return sys.stdin.buffer if name == "-" else open_stream(name, FIFO_WAIT_MS)
    except NotRegularFile as error:
        raise ImudError(f"{name} {error.strerror}; `-` reads standard input") from error
    except OSError as error:
        raise ImudError(f"{name}: {error.strerror}") from error


def decode(file: BinaryIO, driver: Driver, ledger: Ledger, settings: Options | None = None) -> Iterator[str]:
    """Decode `file` to JSON lines; `settings` default to the driver's own defaults.

    Raises ImudError for a driver without captures, or a file that is no capture.
    """
    times = UnwrappedTime(driver)
    for event in events_in(file, driver, ledger, settings or driver.settings()):
        yield msgspec.json.encode(as_object(event, times)).decode() + "\n"


def events_in(file: BinaryIO, driver: Driver, ledger: Ledger, settings: Options) -> Iterator[CodecEvent]:
    """Decode a capture to the events of the driver's codec."""
    if isinstance(driver, StreamDriver):
        codec = driver.make_codec(ledger, settings)
        for _, data in CaptureReader(file):
            yield from codec.feed(data)
        yield from codec.flush()
    elif isinstance(driver, CanDriver):
        frame_codec = driver.make_codec(ledger, settings)
        log = CandumpReader(file)
        for frame in log:
            yield from frame_codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns)
        yield from frame_codec.flush()
        if log.problem:
            print(log.problem, file=sys.stderr)
    else:
        raise ImudError(f"{driver.name} has no captures: a device on a polled bus sends nothing by itself")


def as_object(event: CodecEvent, times: "UnwrappedTime") -> dict[str, object]:
    """Convert a codec event to the object that is printed."""
    if isinstance(event, TextLine):
        return {"text": event.text}
    if isinstance(event, ReplyFrame):
        return {"reply": event.frame_id, "payload": event.payload.hex()}
    if isinstance(event, BadFrame):
        return {"bad_frame": str(event.reason), "raw": event.raw.hex()}
    shown: dict[str, object] = {}
    if event.dev_ticks is not None:
        shown[times.key] = times.unwrap(event.dev_ticks)
    for name in Measurement.__struct_fields__:
        value = getattr(event, name)
        if value is not None and name not in NOT_SHOWN:
            shown[name] = value
    return shown


class UnwrappedTime:
    """Unwrapped device time without a host clock: a step back by more than half the range is a rollover."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._tick = 1 if driver.tick_ns == SAMPLE_COUNTER else driver.tick_ns
        self.key = "index" if driver.tick_ns == SAMPLE_COUNTER else "t_dev_ns"
        """Field name of the unwrapped ticks: device time in ns, or the number of the sample."""
        self._last: int | None = None
        self._turns = 0

    def unwrap(self, ticks: int) -> int:
        """Device time in ns since the device's zero, or the sample's number."""
        modulus = self._driver.tick_modulus
        if self._last is not None and self._last - ticks > modulus // 2:
            self._turns += 1
        self._last = ticks
        return (self._turns * modulus + ticks) * self._tick


DECODE = CliCommand(add_arguments, run)
