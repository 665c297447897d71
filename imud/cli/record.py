"""`imud record`: a recording of what devices deliver from now on, or of the last minutes, into a file of the user's.

The daemon sends the recording through a descriptor, this command writes it: the file belongs to who asked, and the
daemon opens none. What comes is looked at on the way, which gives the figures, and shows that it is whole.
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

import msgspec

from imud.cli.arguments import CliCommand, add_socket, connect, duration_s
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
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.model.ledger import lost
from imud.model.units import NS_PER_S

INPUTS: Final = (Kind.DATA, Kind.FRAMES, Kind.READINGS)


@dataclass
class DeviceContents:
    """What a recording has of one device."""

    name: str = ""
    where: str = ""
    driver: str = ""
    identity: dict[str, str] = field(default_factory=dict)
    reads: int = 0
    """Records of data: reads of a port, or groups of frames or transfers that were read together."""
    input_bytes: int = 0
    edges: int = 0
    events: int = 0
    spans: list[tuple[CheckRecord, CheckRecord]] = field(default_factory=list)
    """First and last check of each time in which numbers and ledger went on: a device that was removed and added begins
    both anew."""
    begins_anew: bool = False
    """Whether the next check begins a span."""

    def check(self, found: CheckRecord) -> None:
        """Take what the live run had at one place."""
        if self.begins_anew or not self.spans or found.seq < self.spans[-1][1].seq:
            self.spans.append((found, found))
            self.begins_anew = False
        else:
            self.spans[-1] = (self.spans[-1][0], found)

    def begin_path(self, ledger: Mapping[str, int]) -> None:
        """Take the ledger with which a codec and its clock were made."""
        before = self.spans[-1][1].ledger if self.spans else {}
        self.begins_anew = ledger.get("samples", 0) < before.get("samples", 0)

    @property
    def samples(self) -> int:
        """Samples between the first check and the last of each span."""
        return sum(last.seq - first.seq for first, last in self.spans)

    @property
    def rate_hz(self) -> float:
        """Samples per second between them; 0 for not known."""
        spent_ns = sum(last.t_ns - first.t_ns for first, last in self.spans)
        return self.samples * NS_PER_S / spent_ns if spent_ns > 0 else 0.0

    @property
    def lost(self) -> int:
        """Samples lost between them, by every cause."""
        return sum(lost(last.ledger) - lost(first.ledger) for first, last in self.spans)


class Contents:
    """What a recording has."""

    def __init__(self) -> None:
        self.session: SessionRecord | None = None
        self.end: EndRecord | None = None
        self.devices: dict[int, DeviceContents] = {}
        self.dropped = 0
        """Records that the recorder dropped."""
        self.newest_ns = 0

    def add(self, record: Record) -> None:
        """Look at one record. Raises ImudError for one that cannot be what a recorder wrote."""
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
            self.session = self.session or decode_object(record, SessionRecord)
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
    def duration_s(self) -> float:
        """From the begin to the newest record with a time; 0 for not known."""
        begun_ns = self.session.t_ns if self.session is not None else 0
        return max(0, self.newest_ns - begun_ns) / NS_PER_S if begun_ns else 0.0


def add_info_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud info`."""
    parser.add_argument("file", type=Path, metavar="FILE", help="recording")
    parser.add_argument("--json", action="store_true", help="one JSON object")


def run_info(args: argparse.Namespace) -> int:
    """Print what is in the file; 1 where something of it is damaged, missing or was dropped."""
    contents = Contents()
    try:
        with open_regular(args.file) as file:
            reader = RecordingReader(file, str(args.file))
            for record in reader:
                contents.add(record)
    except OSError as error:
        raise ImudError(f"{args.file}: {error.strerror}") from error
    report = summary(contents, reader)
    print(msgspec.json.encode(report).decode() if args.json else page(report))
    return 1 if report["damage"] or report["records_dropped"] else 0


def summary(contents: Contents, reader: RecordingReader) -> dict[str, Any]:
    """What is printed, as JSON has it."""
    session = contents.session
    return {
        "begun_utc_ns": session.utc_ns if session is not None else None,
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
    """Format it for people, in 80 columns."""
    begun, duration = "not known: the block that says it and names the devices is damaged or missing", "not known"
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
    dropped = f"{report['records_dropped']} records, the disk was too slow"
    rows = [
        ("begun", begun),
        ("duration", duration),
        ("size", size),
        ("dropped", dropped if report["records_dropped"] else "nothing"),
        ("integrity", "; ".join(report["problems"]) or "whole"),
    ]
    lines = [line for name, text in rows for line in paragraph(f"{name:<11}", text)]
    for device in report["devices"]:
        identity = ", ".join(f"{name} {value}" for name, value in device["identity"].items()) or "not known"
        lines += ["", *paragraph(f"{device['name']}: ", f"{device['link']}, driver {device['driver']}")]
        parts = [
            ("identity", identity),
            ("samples", f"{device['samples']}, {device['rate_hz']:.1f} Hz; lost {device['lost']}"),
            ("input", f"{device['input_bytes']} bytes in {device['reads']} records; {device['edges']} edges of lines"),
            ("events", str(device["events"])),
        ]
        lines += [line for name, text in parts for line in paragraph(f"  {name:<9}", text)]
    return "\n".join(lines)


INFO = CliCommand(add_info_arguments, run_info)

LOOK_S: Final = 0.2
"""Interrupts, the end of `--for` and the line of progress are looked after so often."""
PROGRESS_S: Final = 1.0
GIVE_UP_S: Final = 10.0
"""How long the daemon may send nothing after it was asked to end the recording."""
CHUNK_BYTES: Final = 1 << 16
CLEAR_LINE: Final = "\r\x1b[2K"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud record`."""
    add_socket(parser)
    parser.add_argument(
        "--device", action="append", metavar="NAME", help="record this one; may be given several times (default: all)"
    )
    parser.add_argument(
        "--for", dest="for_s", type=duration_s, metavar="DURATION", help="end after 90s, 10min, 2h (default: Ctrl-C)"
    )
    parser.add_argument(
        "--snapshot", action="store_true", help="save what the flight recorder has of the last minutes, and end"
    )
    parser.add_argument(
        "file",
        nargs="?",
        metavar="FILE",
        help="a file that does not exist yet, or - for standard output (default: by time)",
    )


def run(args: argparse.Namespace) -> int:
    """Record; 1 where the recording lost something, or ended otherwise than asked for. Needs permission to control.

    Raises ImudError where nothing can be recorded, or the file cannot be written.
    """
    if args.snapshot and (args.device or args.for_s):
        raise BadArgument("--snapshot: expected neither --device nor --for: it has what the flight recorder has")
    if args.file == "-" and sys.stdout.isatty():
        raise BadArgument("standard output is a terminal: expected a file, or a program that reads the recording")
    with connect(args) as client, interrupts(are_noted=not args.snapshot) as interrupt:
        descriptor = client.snapshot()[0] if args.snapshot else client.record(args.device)
        with open(descriptor, "rb", buffering=0) as stream, output(args.file) as (name, out):
            copy = Copy(stream, out, name)
            found = follow(copy, client, interrupt, args.for_s)
    return account(copy, found, name, asked=args.snapshot or copy.stopped)


class Interrupt:
    """Whether the user, or who started the command, wants it to end."""

    def __init__(self) -> None:
        self.asked = False

    def ask(self, _number: int, _frame: FrameType | None) -> None:
        """Note it; the second time end at once. Raises KeyboardInterrupt."""
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def interrupts(*, are_noted: bool) -> Iterator[Interrupt]:
    """Note SIGINT and SIGTERM in place of ending by them, if `are_noted`."""
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
    """Make the file; its name, and what to write to. Raises ImudError, also for one that exists."""
    if file == "-":
        yield "standard output", sys.stdout.buffer
        return
    name = file or f"imud-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.imudrec"
    try:
        made = open(name, "xb", buffering=0)  # noqa: SIM115 - closed below, and errors of opening are not those of writing
    except FileExistsError:
        raise ImudError(f"{name} exists already: expected the name of a new file") from None
    except (OSError, ValueError) as error:
        raise ImudError(f"{name}: {error.strerror if isinstance(error, OSError) else error}") from None
    with made:
        yield name, made
        os.fsync(made.fileno())


class Copy:
    """What comes from the daemon, written on while it is read. It is read as a file is."""

    def __init__(self, stream: BinaryIO, out: BinaryIO, name: str) -> None:
        self.bytes = 0
        self.stopped = False
        """Whether this side asked for the end."""
        self.look: Callable[[], None] = lambda: None
        """Called at least once in LOOK_S."""
        self._stream = stream
        self._out = out
        self._name = name
        self._moved_s = monotonic()

    def read(self, size: int, /) -> bytes:
        """Return what is there, or comes next; nothing at the end. Raises ImudError."""
        while True:
            self.look()
            if select.select((self._stream,), (), (), LOOK_S)[0]:
                break
            if self.stopped and monotonic() - self._moved_s > GIVE_UP_S:
                return b""
        data = self._stream.read(min(size, CHUNK_BYTES))
        self._moved_s = monotonic()
        self.bytes += len(data)
        self._write(data)
        return data

    def stop(self) -> None:
        """Note that the end was asked for."""
        self.stopped, self._moved_s = True, monotonic()

    def _write(self, data: bytes) -> None:
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[self._out.write(rest) :]
            self._out.flush()
        except BrokenPipeError:  # no `imud watch | head`: who asked for the recording does not have it
            discard_output()
            raise ImudError(f"{self._name}: nobody reads it any more; the recording ended before it was to") from None
        except OSError as error:
            raise ImudError(f"{self._name}: {reason_of(error)}; what was written before is whole") from None


def follow(copy: Copy, client: Client, interrupt: Interrupt, for_s: float | None) -> tuple[Contents, RecordingReader]:
    """Copy to the end of the recording, which is asked for when it is time; return what was in it."""
    contents, begun_s = Contents(), monotonic()
    shown_s = begun_s

    def look() -> None:
        nonlocal shown_s
        now_s = monotonic()
        if not copy.stopped and (interrupt.asked or (for_s is not None and now_s - begun_s >= for_s)):
            copy.stop()
            with suppress(ImudError, OSError):  # a daemon that has gone has ended the recording
                client.stop_recording()
        if sys.stderr.isatty() and now_s - shown_s >= PROGRESS_S:
            shown_s = now_s
            sys.stderr.write(f"{CLEAR_LINE}{now_s - begun_s:.0f} s: {figures(copy, contents)}")
            sys.stderr.flush()

    copy.look = look
    reader = RecordingReader(copy, "what the daemon sent")
    try:
        for record in reader:
            contents.add(record)
    finally:
        if sys.stderr.isatty():
            sys.stderr.write(CLEAR_LINE)
    return contents, reader


def figures(copy: Copy, contents: Contents) -> str:
    """Format what was recorded so far."""
    devices = [one for one in contents.devices.values() if one.name]
    samples = sum(one.samples for one in devices)
    return (
        f"{copy.bytes / 1e6:.2f} MB, {samples} samples of {len(devices)} device{'' if len(devices) == 1 else 's'}, "
        f"{contents.dropped or 'no'} record{'' if contents.dropped == 1 else 's'} dropped"
    )


def account(copy: Copy, found: tuple[Contents, RecordingReader], name: str, *, asked: bool) -> int:
    """Say what was recorded, and what is wrong with it; return the exit status."""
    contents, reader = found
    problems = list(reader.problems)
    if reader.ended and not asked and contents.end is not None:
        problems.append(f"the recording ended before it was to: {contents.end.reason}")
    if contents.dropped:
        problems.append(f"{contents.dropped} records are missing: this command was too slow")
    print(f"{name}: {contents.duration_s:.1f} s, {figures(copy, contents)}", file=sys.stderr)
    for problem in problems:
        print(f"imud record: {problem}", file=sys.stderr)
    return 1 if problems else 0


RECORD = CliCommand(add_arguments, run)
