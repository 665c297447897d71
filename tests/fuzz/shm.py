"""Readers of shared memory: one slot, and a ring with a file that changes during the read.

An input for a ring is a program. Byte 0: number of steps before the reader opens the file. Byte 1: number of missing
CUT_BYTES at the end of the file. Each further byte is a step. Its three low bits select the operation:

    0 read  1 latest  2 ledger  3 health  7 replace the file by a copy, and open it again
    4 write: offset u16, modulo the size; length u8, modulo 32; bytes    5 correct the CRC-32 of a slot: number u8
    6 correct the CRC-32 of the ledger

`ring.c` runs the same programs with imud.h.
"""

import atexit
import os
import re
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from random import Random
from typing import Final

from imud.client.ring import Ring
from imud.formats import ring as formats_ring
from imud.formats.slot import CRC_OFFSET, SLOT_BYTES, SYNC_CODES, decode_slot, encode_slot, slot_crc
from imud.model.errors import ServerError
from imud.model.ledger import LEDGER_FIELDS
from imud.model.sample import Sample
from tests.fuzz.target import Target, check_printable
from tests.support.rings import DEVICE, START_NS, make_sample

SLOTS: Final = 8  # slots of the ring
NEWEST: Final = 20  # newest sequence number
PID: Final = 4242
BYTES: Final = formats_ring.HEADER_BYTES + SLOTS * SLOT_BYTES
CUT_BYTES: Final = 64
WRITE_BYTES_MAX: Final = 31
READ, LATEST, LEDGER, HEALTH, WRITE, MEND_SLOT, MEND_LEDGER, REPLACE = range(8)


def names() -> Sequence[str]:
    return ["slot", "ring"]


def make(name: str) -> Target:
    if name == "slot":
        return Target(run_slot, slot_seeds, mend_slot, bytes_max=2 * SLOT_BYTES)
    return Target(run_ring, ring_seeds, bytes_max=512)


# --- a slot -----------------------------------------------------------------------------------------------------------


def run_slot(data: bytes) -> None:
    """The result is a ValueError, or a sample that is equal after it was encoded and decoded again."""
    try:
        sample = decode_slot(data, DEVICE)
    except ValueError:
        return
    again = encode_slot(sample, 3)
    assert _comparable(decode_slot(again, DEVICE)) == _comparable(sample)


def _comparable(sample: Sample) -> str:
    """Return a sample as text, because NaN is then equal to itself. Remove the sign of zero."""
    return re.sub(r"-0\.0\b", "0.0", repr(sample))


def mend_slot(data: bytes, _random: Random) -> bytes:
    slot = data[:SLOT_BYTES].ljust(SLOT_BYTES, b"\0")
    return slot[:CRC_OFFSET] + slot_crc(slot) + slot[CRC_OFFSET + 4 :]


def slot_seeds() -> list[bytes]:
    slots = [encode_slot(make_sample(seq), 3) for seq in (1, 2, 1 << 40, (1 << 64) - 1)]
    random = Random(1)
    bodies = [random.randbytes(62) + bytes([code]) + random.randbytes(257) for code in (*range(len(SYNC_CODES)), 9)]
    return [*slots, slots[0][:-1], slots[0] + b"\0", b"", *(mend_slot(body, random) for body in bodies)]


# --- a ring -----------------------------------------------------------------------------------------------------------


@cache
def base() -> bytes:
    """Return a ring in use: eight slots, twenty samples."""
    header = formats_ring.encode_header(formats_ring.RingHeader(77, PID, 1, DEVICE, 3, SLOTS, NEWEST, 1, START_NS))
    image = bytearray(header + bytes(SLOTS * SLOT_BYTES))
    block = formats_ring.encode_ledger_block(5, "hipnuc-uart", [7] * len(LEDGER_FIELDS))
    image[formats_ring.LEDGER_BLOCK_OFFSET : formats_ring.LEDGER_BLOCK_OFFSET + formats_ring.LEDGER_BLOCK_BYTES] = block
    for seq in range(NEWEST - SLOTS + 1, NEWEST + 1):
        at = _slot_at(seq)
        image[at : at + SLOT_BYTES] = encode_slot(make_sample(seq), 3)
    return bytes(image)


def _slot_at(number: int) -> int:
    return formats_ring.HEADER_BYTES + number % SLOTS * SLOT_BYTES


class RingFile:
    def __init__(self, path: Path, size_bytes: int) -> None:
        self.path = path
        self.image = bytearray(base()[:size_bytes])
        path.write_bytes(self.image)
        self._fd = os.open(path, os.O_RDWR)

    def write(self, at: int, data: bytes) -> None:
        data = data[: max(len(self.image) - at, 0)]
        self.image[at : at + len(data)] = data
        os.pwrite(self._fd, data, at)

    def mend_slot(self, number: int) -> None:
        at = _slot_at(number)
        if len(slot := self.image[at : at + SLOT_BYTES]) == SLOT_BYTES:
            self.write(at + CRC_OFFSET, slot_crc(bytes(slot)))

    def mend_ledger(self) -> None:
        block = self.image[formats_ring.LEDGER_BLOCK_OFFSET : formats_ring.LEDGER_CRC_OFFSET]
        self.write(formats_ring.LEDGER_CRC_OFFSET, zlib.crc32(block).to_bytes(4, "little"))

    def replace(self) -> None:
        other = self.path.with_suffix(".new")
        other.write_bytes(self.image)
        os.replace(other, self.path)
        os.close(self._fd)
        self._fd = os.open(self.path, os.O_RDWR)

    def close(self) -> None:
        os.close(self._fd)


def run_ring(data: bytes) -> None:
    """Run a program. It may raise only ServerError. Samples are in order, at most as many as slots."""
    if len(data) < 2:
        return
    file = RingFile(_folder() / f"imud.{DEVICE}", max(BYTES - data[1] * CUT_BYTES, 0))
    ring: Ring | None = None
    try:
        at, steps = 2, 0
        while at < len(data):
            if ring is None and steps >= data[0]:
                ring = Ring(file.path, now_ns=lambda: START_NS)
            at = _step(file, ring, data, at)
            steps += 1
    except ServerError as error:
        check_printable(str(error))
    finally:
        file.close()
        if ring is not None:
            ring.close()


def _step(file: RingFile, ring: Ring | None, data: bytes, at: int) -> int:
    kind = data[at] % 8
    if kind == WRITE:
        if at + 4 > len(data):
            return len(data)
        (offset,) = struct.unpack_from("<H", data, at + 1)
        end = at + 4 + data[at + 3] % (WRITE_BYTES_MAX + 1)
        file.write(offset % BYTES, data[at + 4 : end])
        return end
    if kind == MEND_SLOT:
        file.mend_slot(data[at + 1] if at + 1 < len(data) else 0)
        return at + 2
    if kind == MEND_LEDGER:
        file.mend_ledger()
    elif kind == REPLACE:
        file.replace()
    if ring is not None and kind in _READINGS:
        _READINGS[kind](ring)
    return at + 1


def _read(ring: Ring) -> None:
    before = ring.missed
    found = ring.read()
    numbers = [sample.seq for sample in found.samples]
    assert numbers == sorted(set(numbers))
    assert len(numbers) <= ring.header.slot_count
    assert found.missed >= 0
    assert ring.missed == before + found.missed


def _latest(ring: Ring) -> None:
    sample = ring.latest()
    assert sample is None or sample.seq == ring.newest_seq


_READINGS: Final[dict[int, Callable[[Ring], object]]] = {
    READ: _read, LATEST: _latest, LEDGER: Ring.ledger, HEALTH: lambda ring: ring.alive(START_NS), REPLACE: Ring.reopen,
}  # fmt: skip


@cache
def _folder() -> Path:
    parent = Path("/dev/shm")
    folder = tempfile.mkdtemp(prefix="imud-fuzz-", dir=parent if os.access(parent, os.W_OK) else None)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def ring_seeds() -> list[bytes]:
    readings = bytes([READ, LATEST, LEDGER, HEALTH, REPLACE, READ])
    plain = [bytes([0, 0]) + readings, bytes([0, 1]) + readings, bytes([0, 97]) + readings]
    found = [*plain, bytes([0, 0, REPLACE, READ, LATEST])]
    fields = {"slot_count": 4, "ledger_count": 4, "state": 4, "newest_seq": 8, "first_seq": 8, "heartbeat_ns": 8}
    for name, size in fields.items():
        for value in (0, 1, 0x80 << (8 * size - 8), (1 << (8 * size)) - 1):
            write = written(formats_ring.OFFSETS[name], value.to_bytes(size, "little"))
            found.append(bytes([1, 0]) + write + readings + readings)
            found.append(bytes([0, 0]) + bytes([READ]) + write + readings + bytes([READ]))
    newer = written(_slot_at(NEWEST + 1), encode_slot(make_sample(NEWEST + 1), 3)[:WRITE_BYTES_MAX])
    newest = written(formats_ring.OFFSETS["newest_seq"], (NEWEST + 1).to_bytes(8, "little"))
    mended = bytes([MEND_SLOT, (NEWEST + 1) % SLOTS])
    found.append(bytes([0, 0, READ]) + newer + newest + bytes([READ]) + mended + readings)
    found.append(bytes([0, 0, READ]) + newer + mended + newest + readings)
    found.append(
        bytes([1, 0]) + written(formats_ring.OFFSETS["device"], b"\xff\x1b[31m\n") + bytes([MEND_LEDGER]) + readings
    )
    return found


def written(at: int, data: bytes) -> bytes:
    return struct.pack("<BHB", WRITE, at, len(data)) + data
