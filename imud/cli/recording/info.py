"""`imud info`: what is in a recording, and whether it is whole. Nothing is decoded: it is read as fast as the disk."""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec

from imud.cli.arguments import CliCommand
from imud.cli.output import paragraph
from imud.errors import ImudError
from imud.files import open_regular
from imud.formats.recording import records
from imud.formats.recording.file import RecordingReader
from imud.formats.recording.records import (
    CheckRecord,
    DeviceRecord,
    EndRecord,
    Kind,
    PathRecord,
    Record,
    SessionRecord,
    decode_object,
)
from imud.ledger import lost
from imud.units import NS_PER_S

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
