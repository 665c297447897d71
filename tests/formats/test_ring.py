import struct
import zlib
from dataclasses import replace

import pytest

from imud.formats import ring
from imud.model.errors import ServerError
from imud.model.ledger import LEDGER_FIELDS
from tests.support.rings import check_layout

HEADER = ring.RingHeader(0x0102_0304_0506_0708, 4711, 1, "front-imu", 3, 4096, 10, 2, -5)
LEDGER = {name: 100 + i for i, name in enumerate(LEDGER_FIELDS)}

GOLDEN = (
    b"imudshm\0"
    + bytes.fromhex("02000000 02000000 00100000 40010000 00100000 18000000")  # 2, 2, 4096, 320, 4096, 24 counters
    + bytes.fromhex("0807060504030201 67120000 01000000 03000000")
    + bytes(12)
    + b"front-imu".ljust(64, b"\0")
    + bytes(64)
    + bytes.fromhex("0a00000000000000 0200000000000000 fbffffffffffffff")
)


def test_header() -> None:
    check_layout(ring.HEADER_FIELDS, ring.HEADER_BYTES)
    lively = {"newest_seq", "first_seq", "heartbeat_ns"}
    lines = {ring.OFFSETS[name] // 64 for name in lively}
    others = {f.offset // 64 for f in ring.HEADER_FIELDS if f.name not in lively and not f.name.startswith("reserved")}
    assert len(lines) == 1
    assert not lines & others
    raw = ring.encode_header(HEADER)
    assert len(raw) == ring.HEADER_BYTES
    assert raw[: len(GOLDEN)].hex(" ", 8) == GOLDEN.hex(" ", 8)
    assert not any(raw[len(GOLDEN) :])
    assert ring.decode_header(GOLDEN.ljust(ring.HEADER_BYTES, b"\0"), "x") == HEADER
    full = replace(HEADER, ledger_count=59)
    assert ring.decode_header(ring.encode_header(full), "x") == full
    words, half_words = memoryview(raw).cast("Q"), memoryview(raw).cast("I")
    places = ring.NEWEST_WORD, ring.FIRST_WORD, ring.HEARTBEAT_WORD
    assert [words[place] for place in places] == [10, 2, (1 << 64) - 5]
    assert half_words[ring.STATE_HALF_WORD] == ring.STATE_LIVE == 1
    assert (ring.LEDGER_UPDATE_WORD, ring.STATE_CLOSED, ring.HEARTBEAT_LIMIT_NS) == (32, 2, 1_000_000_000)


@pytest.mark.parametrize(
    "raw", [b"", bytes(ring.HEADER_BYTES), ring.encode_header(HEADER)[:-1], b"x" * ring.HEADER_BYTES]
)
def test_no_ring_at_all(raw: bytes) -> None:
    with pytest.raises(ServerError, match=r"/x is not a ring"):
        ring.decode_header(raw, "/x")


VERSIONS = [("layout_version", 1), ("slot_layout_version", 3), ("header_bytes", 4098), ("slot_bytes", 258)]
COUNTS = [("slot_count", 0), ("slot_count", 4095), ("ledger_count", 60)]


@pytest.mark.parametrize(
    ("name", "value", "words"), [(*one, "the same version") for one in VERSIONS] + [(*one, "damaged") for one in COUNTS]
)
def test_another_version_and_impossible_counts_are_refused(name: str, value: int, words: str) -> None:
    raw = bytearray(ring.encode_header(HEADER))
    struct.pack_into("<I", raw, ring.OFFSETS[name], value)
    with pytest.raises(ServerError, match=words):
        ring.decode_header(bytes(raw), "/x")


def test_ledger_block_also_of_a_writer_with_other_counters() -> None:
    body = struct.pack("<Q", 6) + b"hipnuc-uart".ljust(32, b"\0")
    body += b"".join(struct.pack("<Q", 100 + i) for i in range(24)) + bytes(8 * (ring.LEDGER_ROOM - 24))
    expected = body + zlib.crc32(body).to_bytes(4, "little")
    assert ring.encode_ledger_block(6, "hipnuc-uart", tuple(LEDGER.values())) == expected
    assert len(expected) == ring.LEDGER_BLOCK_BYTES
    block = ring.decode_ledger_block(expected, len(LEDGER_FIELDS))
    assert block == ring.LedgerBlock(6, "hipnuc-uart", LEDGER)
    block = ring.decode_ledger_block(ring.encode_ledger_block(1, "", tuple(LEDGER.values())), 2)
    assert block == ring.LedgerBlock(1, "", {"bytes_in": 100, "bytes_in_good_frames": 101})
    block = ring.decode_ledger_block(ring.encode_ledger_block(1, "", tuple(LEDGER.values())), ring.LEDGER_ROOM)
    assert block == ring.LedgerBlock(1, "", LEDGER)
    block = ring.decode_ledger_block(ring.encode_ledger_block(1, "d" * 40, [5] * 24), 1)
    assert block == ring.LedgerBlock(1, "d" * 31, {"bytes_in": 5})


@pytest.mark.parametrize("at", [0, 8, 40, 300, ring.LEDGER_BLOCK_BYTES - 1])
def test_torn_ledger_block_is_refused(at: int) -> None:
    raw = bytearray(ring.encode_ledger_block(6, "hipnuc-uart", tuple(LEDGER.values())))
    raw[at] ^= 1
    assert ring.decode_ledger_block(bytes(raw), len(LEDGER_FIELDS)) is None
    raw[at] ^= 1
    assert ring.decode_ledger_block(bytes(raw[:-1]), len(LEDGER_FIELDS)) is None


@pytest.mark.parametrize("device", ["", "a/b", "../x", "a\0b", "x" * 64, "ü" * 32])
def test_default_directories_and_names_that_cannot_be_files(device: str) -> None:
    assert str(ring.ring_path("/run/imud/shm", "imu0")) == "/run/imud/shm/imud.imu0"
    with pytest.raises(ServerError, match="expected a name"):
        ring.ring_path("/dev/shm", device)
    assert ring.default_directories({"XDG_RUNTIME_DIR": "/run/user/9"}) == ["/run/imud/shm", "/run/user/9/imud/shm"]
    for environment in ({"XDG_RUNTIME_DIR": "relative"}, {}):
        assert ring.default_directories(environment) == ["/run/imud/shm"]
