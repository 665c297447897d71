"""`imud record`: write a recording or a snapshot to a file. `imud info`: print the content of a recording.

The daemon sends the recording through a descriptor, and this command writes the file. The file therefore belongs to the
user, and the daemon opens no file. The command decodes the data to count samples and to check the recording.
"""

import argparse
import os
import select
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import Any, BinaryIO, Final

from imud.cli.arguments import CliCommand, add_duration, add_socket, connect
from imud.cli.output import discard_output, paragraph
from imud.client.connection import Client
from imud.formats import records
from imud.formats.recording import RecordingReader
from imud.formats.records import (
    CheckRecord,
    DeviceRecord,
    EndRecord,
    Kind,
    PathRecord,
    Record,
    SessionRecord,
    decode_object,
)
from imud.host.files import open_regular
from imud.host.log import printable_json
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.model.ledger import LOST_FIELDS, lost
from imud.model.units import NS_PER_S
from imud.recording.player import RecordedClock

INPUTS: Final = (Kind.DATA, Kind.FRAMES, Kind.READINGS)


@dataclass
class DeviceContents:
    """Content of a recording for one device."""

    name: str = ""
    where: str = ""
    driver: str = ""
    identity: dict[str, str] = field(default_factory=dict)
    reads: int = 0  # number of data records: one read of a port, or one group of frames or transfers
    input_bytes: int = 0
    edges: int = 0
    events: int = 0
    # Initial ledger, first and last check of each interval without a restart of the ledger. A device that the user
    # removed and added again restarts it.
    spans: list[tuple[Mapping[str, int], CheckRecord, CheckRecord]] = field(default_factory=list)
    begun: Mapping[str, int] | None = None  # ledger before the first input of the next span
    is_earlier: bool = False  # whether the newest span belongs to an earlier run of imud

    def check(self, found: CheckRecord) -> None:
        """Add a check record of the live run."""
        newest = self.spans[-1][2] if self.spans else None
        # a smaller sequence number: the device or the daemon restarted
        if self.begun is not None or newest is None or found.seq < newest.seq:
            self.spans.append((self.begun or found.ledger, found, found))
            self.begun = None
        else:
            self.spans[-1] = (*self.spans[-1][:2], found)

    def begin_path(self, ledger: Mapping[str, int]) -> None:
        """Compare the initial ledger of a new codec with the newest ledger."""
        newest = self.begun or (self.spans[-1][2].ledger if self.spans else None)
        if newest is None or self.is_earlier or ledger.get("samples", 0) < newest.get("samples", 0):
            self.is_earlier = False
            self.begun = dict.fromkeys(LOST_FIELDS, 0) | dict(ledger)

    @property
    def samples(self) -> int:
        """Number of samples from the start to the last check of all spans."""
        return sum(last.ledger.get("samples", 0) - begun.get("samples", 0) for begun, _, last in self.spans)

    @property
    def rate_hz(self) -> float:
        """Samples per second between the checks; 0 if unknown."""
        spent_ns = sum(last.t_ns - first.t_ns for _, first, last in self.spans)
        samples = sum(last.seq - first.seq for _, first, last in self.spans)
        return samples * NS_PER_S / spent_ns if spent_ns > 0 else 0.0

    @property
    def lost(self) -> int:
        """Number of lost samples, all causes."""
        return sum(lost(last.ledger) - lost(begun) for begun, _, last in self.spans)


class Contents:
    """Content of a recording."""

    def __init__(self) -> None:
        self.session: SessionRecord | None = None
        self.end: EndRecord | None = None
        self.devices: dict[int, DeviceContents] = {}
        self.dropped = 0  # number of records that the recorder dropped
        self.newest_ns = 0
        self.clock = RecordedClock()
        self._run: SessionRecord | None = None  # first session of the newest run: joined files can have several runs
        self._earlier_ns = 0  # duration of the earlier runs, ns

    def add(self, record: Record) -> None:
        """Add one record. Raises ImudError if the content of the record is invalid."""
        self.clock.read(record)
        device = self.devices.setdefault(record.device, DeviceContents())
        if record.kind in INPUTS:
            device.reads += 1
            device.input_bytes += len(record.body)
        elif record.kind == Kind.EDGES:
            device.edges += len(records.decode_edges(record.body).edges)
        elif record.kind == Kind.EVENT:
            device.events += 1
        elif record.kind == Kind.LOST:
            self.dropped += records.decode_lost(record.body).records
        elif record.kind == Kind.CLOCKS:
            self.newest_ns = records.decode_clocks(record.body).monotonic_ns
        else:
            self._add_object(record, device)

    def _add_object(self, record: Record, device: DeviceContents) -> None:
        if record.kind == Kind.SESSION:
            # later blocks repeat the session record
            session = decode_object(record, SessionRecord)
            self.session = self.session or session
            if self._run is None or session.epoch != self._run.epoch:
                self._earlier_ns, self._run, self.newest_ns = self.duration_ns, session, 0
                for earlier in self.devices.values():
                    earlier.is_earlier = True
        elif record.kind == Kind.END:
            self.end = decode_object(record, EndRecord)
            self.newest_ns = self.end.t_ns if self.end is not None else 0
        elif record.kind == Kind.DEVICE:
            described = decode_object(record, DeviceRecord)
            device.name, device.where, device.identity = described.name, described.where, described.identity
            device.driver = device.driver or described.driver
        elif record.kind == Kind.PATH:
            path = decode_object(record, PathRecord)
            device.driver = path.driver
            device.begin_path(path.ledger)
        elif record.kind == Kind.CHECK:
            device.check(decode_object(record, CheckRecord))

    @property
    def duration_ns(self) -> int:
        """Time from the start to the newest record with a time, ns, without the time between two runs."""
        return self._earlier_ns + (max(0, self.newest_ns - self._run.t_ns) if self._run is not None else 0)

    @property
    def duration_s(self) -> float:
        """Duration in seconds; 0 if unknown."""
        return self.duration_ns / NS_PER_S

    @property
    def begun_utc_ns(self) -> int | None:
        """CLOCK_REALTIME of the start, with the last offset of the first run; None if unknown."""
        if self.session is None:
            return None
        self.clock.begin(self.session.epoch)
        return self.clock.utc_ns(self.session.t_ns, self.session.utc_ns)


def add_info_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="recording")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run_info(args: argparse.Namespace) -> int:
    """Print the content of the file. Return 1 if the file is damaged or the recorder dropped records."""
    contents = Contents()
    try:
        with open_regular(args.file) as file:
            reader = RecordingReader(file, str(args.file))
            for record in reader:
                contents.add(record)
    except OSError as error:
        raise ImudError(f"cannot read {args.file}: {error.strerror}") from error
    report = summary(contents, reader)
    print(printable_json(report) if args.json else page(report))
    return 1 if report["damage"] or report["records_dropped"] else 0


def summary(contents: Contents, reader: RecordingReader) -> dict[str, Any]:
    """Return the content for `--json`."""
    session = contents.session
    return {
        "begun_utc_ns": contents.begun_utc_ns,
        "imud": session.imud if session is not None else "",
        "host": session.host if session is not None else "",
        "file_number": session.number if session is not None else None,
        "duration_s": contents.duration_s,
        "stored_bytes": reader.stored_bytes,
        "plain_bytes": reader.plain_bytes,
        "blocks": reader.blocks_read,
        "damage": reader.is_damaged,
        "problems": reader.problems,
        "records_dropped": contents.dropped,
        "devices": [
            {
                "name": one.name, "driver": one.driver, "link": one.where, "identity": one.identity,
                "samples": one.samples, "rate_hz": one.rate_hz, "lost": one.lost, "reads": one.reads,
                "input_bytes": one.input_bytes, "edges": one.edges, "events": one.events,
            }
            for one in contents.devices.values() if one.name
        ],
    }  # fmt: skip


def page(report: dict[str, Any]) -> str:
    """Format the content as text in 80 columns."""
    begun, duration = "unknown: the block with the start time and the device names is damaged or missing", "unknown"
    if report["begun_utc_ns"] is not None:
        time = datetime.fromtimestamp(report["begun_utc_ns"] // NS_PER_S, UTC)
        begun = (
            f"{time:%Y-%m-%d %H:%M:%S} UTC, by imud {report['imud']} on {report['host']}, file {report['file_number']}"
        )
        duration = f"{report['duration_s']:.1f} s"
    stored, plain = report["stored_bytes"], report["plain_bytes"]
    samples = sum(device["samples"] for device in report["devices"])
    size = f"{stored} bytes in {report['blocks']} blocks, {plain} unpacked"
    if samples:
        size += f"; {stored / samples:.1f} bytes per sample"
    dropped = f"{report['records_dropped']} records, because the disk was too slow"
    rows = [
        ("start", begun),
        ("duration", duration),
        ("size", size),
        ("dropped", dropped if report["records_dropped"] else "0 records"),
        ("integrity", "; ".join(report["problems"]) or "complete"),
    ]
    lines = [line for name, text in rows for line in paragraph(f"{name:<11}", text)]
    for device in report["devices"]:
        identity = ", ".join(f"{name} {value}" for name, value in device["identity"].items()) or "unknown"
        lines += ["", *paragraph(f"{device['name']}: ", f"{device['link']}, driver {device['driver']}")]
        parts = [
            ("identity", identity),
            ("samples", f"{device['samples']}, {device['rate_hz']:.1f} Hz; lost {device['lost']}"),
            ("input", f"{device['input_bytes']} bytes in {device['reads']} records; {device['edges']} GPIO edges"),
            ("events", str(device["events"])),
        ]
        lines += [line for name, text in parts for line in paragraph(f"  {name:<9}", text)]
    return "\n".join(lines)


INFO = CliCommand(add_info_arguments, run_info)

LOOK_S: Final = 0.2  # time between two checks for Ctrl-C, the end of `--for` and the progress line, s
PROGRESS_S: Final = 1.0
GIVE_UP_S: Final = 10.0  # maximum silence of the daemon after the request to stop the recording, s
CHUNK_BYTES: Final = 1 << 16
CLEAR_LINE: Final = "\r\x1b[2K"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument(
        "--device", action="append", metavar="NAME", help="record this device; repeat for more devices (default: all)"
    )
    add_duration(parser, "stop after this time (default: at Ctrl-C)")
    parser.add_argument(
        "--snapshot", action="store_true", help="save the last minutes of the flight recorder, then stop"
    )
    parser.add_argument(
        "file",
        nargs="?",
        metavar="FILE",
        help="new file, or - for standard output (default: a name with the current time)",
    )


def run(args: argparse.Namespace) -> int:
    """Record. Return 1 if the recording is incomplete or ended early. Requires the right to control devices.

    Raises ImudError if the recording cannot start or the file cannot be written.
    """
    if args.snapshot and (args.device or args.duration):
        raise BadArgument("--snapshot saves the complete flight recorder; omit --device and --for")
    if args.file == "-" and sys.stdout.isatty():
        raise BadArgument("cannot write a recording to a terminal; name a file, or use a pipe")
    with connect(args) as client, interrupts(are_noted=not args.snapshot) as interrupt:
        descriptor = client.snapshot()[0] if args.snapshot else client.record(args.device)
        with open(descriptor, "rb", buffering=0) as stream, output(args.file) as (name, out):
            copy = Copy(stream, out, name)
            found = follow(copy, client, interrupt, args.duration)
    return account(copy, found, name, asked=args.snapshot or copy.stopped)


class Interrupt:
    """Request to stop, from SIGINT or SIGTERM."""

    def __init__(self) -> None:
        self.asked = False

    def ask(self, _number: int, _frame: FrameType | None) -> None:
        """Handle a signal: store the first request. Raises KeyboardInterrupt on the second request."""
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def interrupts(*, are_noted: bool) -> Iterator[Interrupt]:
    """Store SIGINT and SIGTERM in the returned object during the context, if `are_noted` is set."""
    interrupt = Interrupt()
    numbers = (signal.SIGINT, signal.SIGTERM) if are_noted else ()
    before = {number: signal.signal(number, interrupt.ask) for number in numbers}
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def output(file: str | None) -> Iterator[tuple[str, BinaryIO]]:
    """Create the file during the context. Yield its name and the open file. Raises ImudError if the file exists."""
    if file == "-":
        yield "standard output", sys.stdout.buffer
        return
    # UTC: names sort by time, also in winter
    name = file or f"imud-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.imudrec"
    try:
        made = open(name, "xb", buffering=0)  # noqa: SIM115 - closed below; this `try` must not catch write errors
    except FileExistsError:
        raise ImudError(f"{name} exists; name a new file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ImudError(f"cannot create {name}: {reason}") from None
    with made:
        yield name, made
        os.fsync(made.fileno())


class Copy:
    """Readable stream of the recording from the daemon. A read also writes the data to the output file."""

    def __init__(self, stream: BinaryIO, out: BinaryIO, name: str) -> None:
        self.bytes = 0
        self.stopped = False  # whether this command requested the end of the recording
        self.look: Callable[[], None] = lambda: None  # callback that `read` calls at least once per LOOK_S
        self._stream = stream
        self._out = out
        self._name = name
        self._moved_s = monotonic()

    def read(self, size: int, /) -> bytes:
        """Return the next data; empty at the end. Raises ImudError if writing fails."""
        while True:
            self.look()
            if select.select((self._stream,), (), (), LOOK_S)[0]:
                break
            # the daemon does not end the recording
            if self.stopped and monotonic() - self._moved_s > GIVE_UP_S:
                return b""
        data = self._stream.read(min(size, CHUNK_BYTES))
        self._moved_s = monotonic()
        self.bytes += len(data)
        self._write(data)
        return data

    def stop(self) -> None:
        """Mark the end of the recording as requested."""
        self.stopped, self._moved_s = True, monotonic()

    def _write(self, data: bytes) -> None:
        try:
            rest = memoryview(data)
            # a write to a pipe can be partial
            while rest:
                rest = rest[self._out.write(rest) :]
            self._out.flush()
        except BrokenPipeError:  # an error, unlike `imud watch | head`: the recording is incomplete
            discard_output()
            raise ImudError(
                f"{self._name}: the reader closed the pipe; the recording ended before its planned end"
            ) from None
        except OSError as error:
            raise ImudError(f"cannot write {self._name}: {reason_of(error)}; the data before is complete") from None


def follow(copy: Copy, client: Client, interrupt: Interrupt, for_s: float | None) -> tuple[Contents, RecordingReader]:
    """Copy the recording to its end. Request the end after `for_s` or Ctrl-C. Return the content and the reader."""
    contents, begun_s = Contents(), monotonic()
    shown_s = begun_s

    def look() -> None:
        nonlocal shown_s
        now_s = monotonic()
        if not copy.stopped and (interrupt.asked or (for_s is not None and now_s - begun_s >= for_s)):
            copy.stop()
            with suppress(ImudError, OSError):  # a stopped daemon has already ended the recording
                client.stop_recording()
        if sys.stderr.isatty() and now_s - shown_s >= PROGRESS_S:
            shown_s = now_s
            sys.stderr.write(f"{CLEAR_LINE}{now_s - begun_s:.0f} s: {figures(copy, contents)}")
            sys.stderr.flush()

    copy.look = look
    reader = RecordingReader(copy, "data from the daemon")
    try:
        for record in reader:
            contents.add(record)
    finally:
        if sys.stderr.isatty():
            sys.stderr.write(CLEAR_LINE)
    return contents, reader


def figures(copy: Copy, contents: Contents) -> str:
    """Format size, samples and dropped records so far."""
    devices = [one for one in contents.devices.values() if one.name]
    samples = sum(one.samples for one in devices)
    return (
        f"{copy.bytes / 1e6:.2f} MB, {samples} samples of {len(devices)} device{'' if len(devices) == 1 else 's'}, "
        f"{contents.dropped or 'no'} record{'' if contents.dropped == 1 else 's'} dropped"
    )


def account(copy: Copy, found: tuple[Contents, RecordingReader], name: str, *, asked: bool) -> int:
    """Print a summary and the problems of the recording. Return the exit status."""
    contents, reader = found
    problems = list(reader.problems)
    if reader.ended and not asked and contents.end is not None:
        problems.append(f"the recording ended before its planned end: {contents.end.reason}")
    if contents.dropped:
        problems.append(f"{contents.dropped} records are missing because imud record was too slow")
    print(f"{name}: {contents.duration_s:.1f} s, {figures(copy, contents)}", file=sys.stderr)
    for problem in problems:
        print(f"imud record: {problem}", file=sys.stderr)
    return 1 if problems else 0


RECORD = CliCommand(add_arguments, run)
