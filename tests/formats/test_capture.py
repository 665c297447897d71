"""Raw and stamped captures."""

import io
import re
import struct
from pathlib import Path
from typing import BinaryIO, cast

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from imud.formats.capture import MAGIC, CaptureReader
from imud.model.errors import ImudError
from tests.support.files import ROOT, CaptureWriter

RECORD_BYTES_MAX = 1_048_576
GOLDEN = (
    b"#imud-capture 1 driver=hipnuc-uart baud=115200\n"
    b"\x02\x01\x00\x00\x00\x00\x00\x00\x03\x00\x00\x00abc"
    b"\x03\x01\x00\x00\x00\x00\x00\x00\x01\x00\x00\x00d"
)
"""Two reads at 258 and 259 ns, written by hand from the description of the format."""


class Dripping(io.RawIOBase):
    """Pipe that returns one byte at a time and cannot seek."""

    def __init__(self, data: bytes) -> None:
        self._data = io.BytesIO(data)

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        return self._data.read(min(size, 1) if size > 0 else size)

    def readline(self, size: int | None = -1) -> bytes:
        return self._data.readline(-1 if size is None else size)


def chunks(data: bytes) -> list[tuple[int | None, bytes]]:
    return [(chunk.t_ns, chunk.data) for chunk in CaptureReader(io.BytesIO(data))]


def written(**details: str | int) -> bytes:
    file = io.BytesIO()
    writer = CaptureWriter(file, driver="hipnuc-uart", baud=115200, details=details)
    writer.write(b"abc", 258)
    writer.write(b"d", 259)
    return file.getvalue()


def test_the_golden_capture_is_read_and_written() -> None:
    reader = CaptureReader(io.BytesIO(GOLDEN))
    assert (reader.stamped, reader.details["driver"], reader.baud, reader.hold_ns) == (True, "hipnuc-uart", 115200, 0)
    assert (list(reader), reader.problem) == ([(258, b"abc"), (259, b"d")], "")
    assert written() == GOLDEN
    reader = CaptureReader(io.BytesIO(written(note="20 °C, 5 = five %\n", hold_ns=16_000_000)))
    assert (reader.details["note"], reader.hold_ns) == ("20 °C, 5 = five %\n", 16_000_000)
    assert list(reader) == [(258, b"abc"), (259, b"d")]


@example(bytes(8193))
@given(st.binary(max_size=100).filter(lambda data: not data.startswith(MAGIC)))
def test_everything_else_is_raw(data: bytes) -> None:
    reader = CaptureReader(io.BytesIO(data))
    pieces = list(reader)
    assert not reader.stamped
    assert b"".join(piece for _, piece in pieces) == data
    sizes = [4096] * (len(data) // 4096) + [len(data) % 4096] * (len(data) % 4096 > 0)
    assert [(t_ns, len(piece)) for t_ns, piece in pieces] == [(None, size) for size in sizes]


@pytest.mark.parametrize("data", [GOLDEN, b"#imud", b"", b"#imud-capture", bytes(100)])
def test_a_pipe_gives_the_same(data: bytes) -> None:
    from_pipe = list(CaptureReader(cast(BinaryIO, Dripping(data))))
    assert b"".join(piece for _, piece in from_pipe) == b"".join(piece for _, piece in chunks(data))


def test_a_cut_at_any_byte_loses_only_the_cut_record() -> None:
    records_at = GOLDEN.index(b"\n") + 1
    ends = {records_at: 0, records_at + 15: 1, len(GOLDEN): 2}
    for cut in range(records_at, len(GOLDEN) + 1):
        reader = CaptureReader(io.BytesIO(GOLDEN[:cut]))
        whole = [(258, b"abc"), (259, b"d")][: max(number for end, number in ends.items() if end <= cut)]
        assert list(reader) == whole
        assert ("incomplete" in reader.problem) == (cut not in ends)


def test_damage_is_named_with_its_place() -> None:
    for record in (struct.pack("<qI", 300, RECORD_BYTES_MAX + 1), struct.pack("<qI", 100, 1) + b"x"):
        reader = CaptureReader(io.BytesIO(GOLDEN + record + b"more"))
        assert list(reader) == [(258, b"abc"), (259, b"d")]
        assert reader.problem.startswith(f"damaged at byte {len(GOLDEN)}:")


@pytest.mark.parametrize("line", [b"2 driver=x\n", b"1 driver=x", b"\n", b"\xff\xff\n", b"1 note=%s\n" % (b"x" * 4089)])
def test_other_versions_and_broken_first_lines_are_refused(line: bytes) -> None:
    with pytest.raises(ImudError, match="expected version 1, got"):
        CaptureReader(io.BytesIO(MAGIC + line))


@pytest.mark.parametrize("text", [b"5A A5 4C 00 02 9D 91", b"aa5502002c00f8ff", b"5a,a5,4c,00,02,9d"])
def test_hexadecimal_text_is_refused(text: bytes) -> None:
    with pytest.raises(ImudError, match="got them as hexadecimal text"):
        CaptureReader(io.BytesIO(text))


@pytest.mark.parametrize("baud", ["", "fast", "-1", "²", "9" * 19])
def test_an_invalid_baud_rate_is_unknown(baud: str) -> None:
    file = io.BytesIO()
    CaptureWriter(file, details={"note": baud})
    header = file.getvalue().replace(b"note=", b"baud=")
    assert CaptureReader(io.BytesIO(header)).baud == 0


@given(st.lists(st.tuples(st.binary(max_size=50), st.integers(-(1 << 62), 1 << 62))))
def test_round_trip_with_times_that_never_decrease(reads: list[tuple[bytes, int]]) -> None:
    file = io.BytesIO()
    writer = CaptureWriter(file)
    for data, t_ns in reads:
        writer.write(data, t_ns)
    back = chunks(file.getvalue())
    assert [data for _, data in back] == [data for data, _ in reads if data]
    times = [t_ns for t_ns, _ in back if t_ns is not None]
    assert times == sorted(times)
    if times:
        assert times[-1] == max(t_ns for data, t_ns in reads if data)


def test_a_read_of_more_bytes_than_a_record_is_two_chunks() -> None:
    file = io.BytesIO()
    CaptureWriter(file).write(bytes(RECORD_BYTES_MAX + 1), 1)
    assert [(t_ns, len(data)) for t_ns, data in chunks(file.getvalue())] == [(1, RECORD_BYTES_MAX), (1, 1)]


def test_the_example_of_the_document(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_bytes(GOLDEN)
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/captures.md").read_text(), re.DOTALL)
    exec(f"{code}        print(t_ns, data)\n", {})
    assert capsys.readouterr().out.splitlines()[1:] == ["258 b'abc'", "259 b'd'"]
