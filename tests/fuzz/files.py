"""Capture files: raw captures, captures with time stamps, and candump logs. Readers return only data of the file."""

import io
import zlib
from collections.abc import Iterator, Sequence
from random import Random
from typing import Final

import msgspec

from imud.contracts.driver import CanDriver, StreamDriver
from imud.formats import recording as blocks
from imud.formats import records
from imud.formats.can import EXTENDED_ID_MAX, STANDARD_ID_MAX, CandumpReader
from imud.formats.capture import MAGIC, RECORD, RECORD_BYTES_MAX, CaptureReader, Chunk
from imud.formats.recording import BlockGatherer, BlockReader, RecordingReader
from imud.formats.records import DeviceRecord, Kind, PathRecord, Record, SessionRecord, records_of
from imud.model.errors import BadArgument, ImudError
from imud.model.ledger import Ledger
from imud.recording.player import Player
from tests.fuzz.drivers import row
from tests.fuzz.target import Target, check_printable
from tests.support.files import CaptureWriter, candump_line

BEGIN_NS: Final = 1_763_717_507_000_000_000
PERIOD_NS: Final = 10_000_000


class ShortReads(io.RawIOBase):
    """A file that returns fewer bytes than requested, as a pipe does."""

    def __init__(self, data: bytes, random: Random) -> None:
        self._data = data
        self._random = random

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: bytearray) -> int:  # type: ignore[override]  # any writable buffer
        size = self._random.randint(1, max(len(buffer), 1))
        part, self._data = self._data[:size], self._data[size:]
        buffer[: len(part)] = part
        return len(part)


def names() -> Sequence[str]:
    return ["capture", "candump", "recording"]


def make(name: str) -> Target:
    if name == "capture":
        return Target(run_capture, capture_seeds, words=lambda: [MAGIC, b"driver=", b"baud=", b"hold_ns=", b"1 "])
    if name == "recording":
        return Target(run_recording, recording_seeds, words=lambda: [blocks.MAGIC, b"\x01\x00\xff\xff"])
    return Target(run_candump, candump_seeds, words=lambda: [b"can0 ", b"##", b"#R", b"(0.0)", b" T\n", b"_9"])


def run_capture(data: bytes) -> None:
    """The chunks are the bytes of the file in order, also from a pipe. The time stamps do not decrease."""
    whole = _chunks(io.BytesIO(data))
    piped = _chunks(ShortReads(data, Random(zlib.crc32(data))))
    if whole is None or piped is None:
        assert whole is piped is None
        return
    content = b"".join(chunk.data for chunk in whole)
    assert content == b"".join(chunk.data for chunk in piped)
    assert len(content) <= len(data)
    assert all(len(chunk.data) <= RECORD_BYTES_MAX for chunk in whole)
    if not data.startswith(MAGIC):
        assert content == data
        return
    assert whole == piped
    times = [chunk.t_ns for chunk in whole if chunk.t_ns is not None]
    assert times == sorted(times)


def _chunks(file: io.BytesIO | io.RawIOBase) -> list[Chunk] | None:
    try:
        reader = CaptureReader(file)  # type: ignore[arg-type]  # a raw file has what is used of BinaryIO
    except ImudError as error:
        check_printable(str(error))
        return None
    chunks = list(reader)
    check_printable(reader.problem)
    assert 0 <= reader.baud < 10**19
    assert 0 <= reader.hold_ns < 10**19
    return chunks


def run_candump(data: bytes) -> None:
    """The frames are valid CAN frames, their time stamps do not decrease, and each line is counted at most once."""
    reader = CandumpReader(io.BytesIO(data))
    newest_ns, count = 0, 0
    try:
        frames = list(reader)
    except BadArgument as error:  # several interfaces
        check_printable(str(error))
        return
    for frame in frames:
        count += 1
        assert newest_ns <= frame.t_rx_ns
        assert 0 <= frame.can_id <= (EXTENDED_ID_MAX if frame.extended else STANDARD_ID_MAX)
        assert len(frame.data) <= 8
        newest_ns = frame.t_rx_ns
    assert count + reader.passed_over + reader.bad_lines <= len(data)
    assert reader.problem or not reader.bad_lines
    check_printable(reader.problem)


def run_recording(data: bytes) -> None:
    """A reader accepts or rejects the blocks of a file and the records of a block. It counts every byte."""
    # a fuzzer cannot find the CRC of a block, so records are tested separately
    reader = RecordingReader(io.BytesIO(data), "a")
    for source in (reader, _records(data)):
        try:
            Player(lambda _batch: None).play(source)
        except ImudError as error:
            check_printable(str(error))
    found = BlockReader(io.BytesIO(data))
    whole = sum(block.stored_bytes for block in found)
    assert whole + found.bytes_bad + found.bytes_cut == len(data)


def _records(data: bytes) -> Iterator[Record]:
    return records_of(data)


def recording_seeds() -> list[bytes]:
    made = [
        records.encode_object(
            Kind.SESSION, records.NO_DEVICE, SessionRecord(records.VERSION, "0", "3", "host", 1, 0, 1, 2)
        ),
        records.encode_object(Kind.DEVICE, 0, DeviceRecord("bow", "hipnuc-uart", "uart", "", {}, {}, {})),
        records.encode_object(
            Kind.PATH, 0, PathRecord("hipnuc-uart", {}, 0, Ledger().snapshot(), msgspec.msgpack.encode({}))
        ),
        records.encode_clocks(records.ClocksRecord(5, 5, 5, 1, BEGIN_NS, 0)),
        records.encode_data(0, row("hipnuc-uart", StreamDriver).example_frame(Random(1)), 10, -1),
        records.encode_data(0, b"OK\r\n", 11, 5),
        records.encode_edges(0, "sout", [(9, True, 1)]),
        records.encode_readings(0, [records.ReadingRecord(0, 1, 2, 1, b"no answer")]),
        records.encode_object(Kind.CALL, 0, records.CallRecord("path", "begin", [9])),
        records.encode_object(Kind.CHECK, 0, records.CheckRecord(12, 1, 2, 3, Ledger().snapshot())),
        records.encode_lost(records.LostRecord(1, 2, 3)),
        records.encode_object(Kind.END, records.NO_DEVICE, records.EndRecord(1, 2, "")),
    ]
    gatherer = BlockGatherer()
    whole = b"".join([*(gatherer.add(one) for one in made), gatherer.finish()])
    return [b"".join(made), *made, whole, whole[:-3], whole[:40] + b"\0" + whole[41:], whole * 2]


def capture_seeds() -> list[bytes]:
    random = Random(1)
    driver = row("hipnuc-uart", StreamDriver)
    found = [driver.example_frame(random) * count for count in (1, 3, 60)]
    for count in range(4):
        file = io.BytesIO()
        details: dict[str, str | int] = {"start_utc_ns": BEGIN_NS, "hold_ns": 1000, "note": "100 % ±"}
        writer = CaptureWriter(file, driver=driver.name, baud=115200, details=details if count % 2 else None)
        for number in range(count * 3):
            writer.write(driver.example_frame(random), BEGIN_NS + number * PERIOD_NS)
        found += [file.getvalue(), file.getvalue()[:-5]]
    head = MAGIC + b"1 baud=%s\n" % (b"9" * 30)
    record = RECORD.pack(5, 3) + b"abc"
    return [
        *found, MAGIC, MAGIC + b"2\n", head + record, head + record + RECORD.pack(4, 0),
        head + RECORD.pack(0, 1 << 31),
    ]  # fmt: skip


def candump_seeds() -> list[bytes]:
    random = Random(1)
    logs = []
    for name in ("imu61x-can", "hipnuc-j1939"):
        for count in (1, 4):
            frames = [frame for _ in range(count) for frame in row(name, CanDriver).example_frames(random)]
            timed = (frame._replace(t_rx_ns=BEGIN_NS + n * PERIOD_NS) for n, frame in enumerate(frames))
            logs.append("".join(map(candump_line, timed)))
    lines = [
        "(0.0) can0 123#", "(1.5) can0 123#R", "(1.5) can0 123#R8", "(1.5) can0 123##1001122",
        "(2.0) can0 20000004#0000",
        "(2.0) vcan0 1F334455#1122334455667788 R", "(2.0) can0 123#1122334455667788_9 T",
        "(1.0) can0 7FF#00", "nonsense",
        "(2.0) can0 FFF#00", "(999999999999999999.999999999) c 000#", "(1.0)  can0   123#00   ",
    ]  # fmt: skip
    return [text.encode() for text in (*logs, *(line + "\n" for line in lines), "\n".join(lines), "(" * 600)]
