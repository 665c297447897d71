"""`imud decode`: decode a capture to one JSON object per frame.

A capture contains bytes, raw or time-stamped. For CAN drivers, the capture is a log of `candump -L`. The objects are:
a measurement with the field names of a sample (`t_dev_ns` unwrapped, or `index` if the device numbers its samples; no
host time), `{"text": …}` for a line of text, `{"reply": kind, "payload": hex}` for a binary reply,
`{"bad_frame": reason, "raw": hex}` for a damaged frame, with `can_id` for a CAN frame of a wrong length.
"""

import argparse
import sys
from collections.abc import Iterator
from typing import BinaryIO

from imud.cli.arguments import (
    CliCommand,
    add_driver,
    add_interface,
    add_option,
    chosen_interface,
    driver_settings,
    given_options,
)
from imud.contracts.codec import BadFrame, CodecEvent
from imud.contracts.driver import SAMPLE_COUNTER, CanDriver, Driver, StreamDriver
from imud.contracts.script import ReplyFrame, TextLine
from imud.drivers import DRIVERS
from imud.formats.can import CandumpReader
from imud.formats.capture import CaptureReader
from imud.host.files import NotRegularFile, open_stream
from imud.host.log import printable_json
from imud.model.errors import ImudError
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement
from imud.sampling.device_time import ticks_over_day

FIFO_WAIT_MS = 5000  # time limit for the first bytes of a FIFO, ms
NOT_SHOWN = {"trailing_bytes", "dev_ticks", "t_first_ns"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_driver(parser, "driver of the captured device", required=True)
    parser.add_argument("file", metavar="FILE", help="capture file, or - for standard input")
    add_option(parser)
    add_interface(parser)


def run(args: argparse.Namespace) -> int:
    """Print the objects to standard output and the ledger to standard error.

    Return 1 without samples, unless the capture contains only replies.
    """
    driver = DRIVERS[args.driver]
    settings = driver_settings(driver, given_options(driver, args.option))
    ledger = Ledger()
    write = sys.stdout.write
    with open_capture(args.file) as file:
        for line in decode(file, driver, ledger, settings, chosen_interface(driver, args.interface)):
            write(line)
    sys.stdout.flush()
    shown = {name: value for name, value in ledger.snapshot().items() if value}
    # standard error: standard output contains only JSON lines
    print(printable_json(shown), file=sys.stderr)
    return 0 if ledger.frames_in_samples or (ledger.frames_in_replies and not ledger.frames_ignored) else 1


def open_capture(name: str) -> BinaryIO:
    """Open the file or FIFO, or standard input for `-`. Raises ImudError if this fails."""
    try:
        return sys.stdin.buffer if name == "-" else open_stream(name, FIFO_WAIT_MS)
    except NotRegularFile as error:
        raise ImudError(f"{name} {error.strerror}; to read standard input, use -") from error
    except OSError as error:
        raise ImudError(f"cannot open {name}: {error.strerror}") from error


def decode(
    file: BinaryIO, driver: Driver, ledger: Ledger, settings: Options | None = None, interface: str = ""
) -> Iterator[str]:
    """Decode `file` to JSON lines. Without `settings`, use the default options of the driver.

    Raises ImudError if the driver does not support captures, or if the file is not a capture.
    """
    times = UnwrappedTime(driver)
    for event in events_in(file, driver, ledger, settings or driver.settings(), interface):
        yield printable_json(as_object(event, times)) + "\n"


def events_in(
    file: BinaryIO, driver: Driver, ledger: Ledger, settings: Options, interface: str
) -> Iterator[CodecEvent]:
    """Yield the events of the driver's codec for a capture."""
    if isinstance(driver, StreamDriver):
        codec = driver.make_codec(ledger, settings)
        for _, data in CaptureReader(file):
            yield from codec.feed(data)
        # complete frames at the end of the capture
        yield from codec.flush()
        unknown = codec.unknown
    elif isinstance(driver, CanDriver):
        frame_codec = driver.make_codec(ledger, settings)
        log = CandumpReader(file, interface)
        for frame in log:
            if frame.after_loss:
                yield from frame_codec.flush()
                frame_codec.reset()
            yield from frame_codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns)
        yield from frame_codec.flush()
        others = driver.other_nodes(settings, log.identifiers.values())
        for problem in filter(None, (log.problem, frame_codec.problem, others)):
            print(problem, file=sys.stderr)
        unknown = frame_codec.unknown
    else:
        raise ImudError(f"cannot decode a capture of {driver.name}: its devices reply only to requests on a polled bus")
    if unknown and not ledger.frames_in_samples:
        print(f"found {driver.unknown_words(unknown, counted=True)}", file=sys.stderr)


def as_object(event: CodecEvent, times: "UnwrappedTime") -> dict[str, object]:
    """Convert a codec event to the printed object."""
    if isinstance(event, TextLine):
        return {"text": event.text}
    if isinstance(event, ReplyFrame):
        return {"reply": event.frame_id, "payload": event.payload.hex()}
    if isinstance(event, BadFrame):
        shown_bad: dict[str, object] = {"bad_frame": str(event.reason), "raw": event.raw.hex()}
        return shown_bad if event.can_id is None else shown_bad | {"can_id": f"{event.can_id:03X}"}
    shown: dict[str, object] = {}
    if event.dev_ticks is not None:
        shown[times.key] = times.unwrap(event.dev_ticks)
    for name in Measurement.__struct_fields__:
        value = getattr(event, name)
        if value is not None and name not in NOT_SHOWN:
            shown[name] = value
    return shown


class UnwrappedTime:
    """Unwrapped device time without a host clock. A step back by more than half of the range is a rollover,
    and a step back by nearly 24 h is the end of a day."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._tick = 1 if driver.tick_ns == SAMPLE_COUNTER else driver.tick_ns
        # Field name of the unwrapped counter: `t_dev_ns` for device time, `index` for a sample counter
        self.key = "index" if driver.tick_ns == SAMPLE_COUNTER else "t_dev_ns"
        self._last: int | None = None
        self._rolled = 0  # ticks of all rollovers

    def unwrap(self, ticks: int) -> int:
        """Return the device time since the zero of the counter, ns, or the index of the sample."""
        if self._last is not None:
            modulus = self._driver.tick_modulus
            # a smaller step back is a duplicate or a restart, not a rollover
            if self._last - ticks > modulus // 2:
                self._rolled += modulus
            elif step := ticks_over_day(self._last, ticks, self._driver.tick_ns):
                self._rolled += self._last + step - ticks
        self._last = ticks
        return (self._rolled + ticks) * self._tick


DECODE = CliCommand(add_arguments, run)
