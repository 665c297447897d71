"""`imud decode`: a raw capture in, one JSON object per message out, as gpsdecode does for GNSS receivers.

Objects: a measurement with the field names of a sample (`t_dev_ns` unwrapped; no host time, a capture of bytes has
none), `{"text": …}` for a line of text, `{"bad_frame": reason, "raw": hex}` for a damaged frame.
"""

import argparse
import sys
from collections.abc import Iterator
from typing import BinaryIO

import msgspec

from imud.devices import DRIVERS
from imud.errors import ImudError
from imud.kit.capture import read_capture
from imud.kit.codec import BadFrame, CodecEvent, TextLine
from imud.kit.driver import StreamDriver
from imud.ledger import Ledger
from imud.sample import Measurement

NOT_SHOWN = {"trailing_bytes", "dev_ticks"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud decode`."""
    parser.add_argument("--driver", required=True, choices=sorted(DRIVERS), help="wire protocol of the capture")
    parser.add_argument("file", metavar="FILE", help="capture file, or - for standard input")


def run(args: argparse.Namespace) -> int:
    """Decode to standard output, the ledger to standard error; 1 when no message was found."""
    driver = DRIVERS[args.driver]
    ledger = Ledger()
    write = sys.stdout.write
    with open_capture(args.file) as file:
        for line in decode(file, driver, ledger):
            write(line)
    sys.stdout.flush()
    shown = {name: value for name, value in ledger.snapshot().items() if value}
    print(msgspec.json.encode(shown).decode(), file=sys.stderr)
    return 0 if ledger.frames_good else 1


def open_capture(name: str) -> BinaryIO:
    """The file, or standard input for `-`. Raises ImudError."""
    try:
        return sys.stdin.buffer if name == "-" else open(name, "rb")
    except OSError as error:
        raise ImudError(f"{name}: {error.strerror}") from error


def decode(file: BinaryIO, driver: StreamDriver, ledger: Ledger) -> Iterator[str]:
    """JSON lines of everything in `file`, which is a raw or a time-stamped capture."""
    codec = driver.make_codec(ledger, driver.settings())
    times = DeviceTime(driver)
    encode = msgspec.json.encode
    for _, data in read_capture(file):
        for event in codec.feed(data):
            yield encode(as_object(event, times)).decode() + "\n"
    for event in codec.flush():
        yield encode(as_object(event, times)).decode() + "\n"


def as_object(event: CodecEvent, times: "DeviceTime") -> dict[str, object]:
    """One codec event as the object that is printed."""
    if isinstance(event, TextLine):
        return {"text": event.text}
    if isinstance(event, BadFrame):
        return {"bad_frame": str(event.reason), "raw": event.raw.hex()}
    shown: dict[str, object] = {}
    if event.dev_ticks is not None:
        shown["t_dev_ns"] = times.unwrap(event.dev_ticks)
    for name in Measurement.__struct_fields__:
        value = getattr(event, name)
        if value is not None and name not in NOT_SHOWN:
            shown[name] = value
    return shown


class DeviceTime:
    """Unwraps device ticks without a host clock: a step back by more than half the range is a rollover."""

    def __init__(self, driver: StreamDriver) -> None:
        self._driver = driver
        self._last: int | None = None
        self._turns = 0

    def unwrap(self, ticks: int) -> int:
        """Device time in ns since the device's zero."""
        modulus = self._driver.tick_modulus
        if self._last is not None and self._last - ticks > modulus // 2:
            self._turns += 1
        self._last = ticks
        return (self._turns * modulus + ticks) * self._driver.tick_ns
