"""Shared memory in a folder of its own. The test controls clock and ledger of the publisher."""

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from imud.contracts.publisher import Batch
from imud.contracts.status import ClockStatus, DeviceState, DeviceStatus, KernelCounters
from imud.formats.ring import HEADER_BYTES, OFFSETS
from imud.formats.slot import CRC_OFFSET, SEQ_INVALID, SLOT_BYTES, SlotField, encode_slot, slot_crc
from imud.model.ledger import Ledger
from imud.model.sample import Position, Sample, Sync
from imud.publishers.shm import ShmOptions, ShmPublisher
from tests.support.publisher_context import publisher_context

DEVICE = "imu0"
SLOTS = 64
START_NS = 5_000_000_000


def slot_at(seq: int) -> int:
    return HEADER_BYTES + seq % SLOTS * SLOT_BYTES


def make_sample(seq: int, device: str = DEVICE) -> Sample:
    """Return a sample with values that identify it."""
    value = float(seq)
    return Sample(
        device, seq, seq * 1_000_000, 1000 + seq % 1000, Sync.REGRESSION, seq * 1_000_000 + 500, 10**18 + seq,
        accel_m_s2=(value, value + 0.25, value + 0.5), gyro_rad_s=(-value, 0.0, value), temperature_c=value / 8,
    )  # fmt: skip


def _reseal(slot: bytes, seq: int) -> bytes:
    slot = struct.pack("<Q", seq) + slot[8:]
    return slot[:CRC_OFFSET] + slot_crc(slot) + slot[CRC_OFFSET + 4 :]


WHOLE = encode_slot(make_sample(2), 3)
TORN = {
    "number invalid": struct.pack("<Q", SEQ_INVALID) + WHOLE[8:], "number not there yet": bytes(8) + WHOLE[8:],
    "payload of another sample": WHOLE[:8] + encode_slot(make_sample(66), 3)[8:],
    "payload half old": WHOLE[:128] + encode_slot(make_sample(66), 3)[128:],
    "crc wrong": WHOLE[:CRC_OFFSET] + bytes([WHOLE[CRC_OFFSET] ^ 1]) + WHOLE[CRC_OFFSET + 1 :],
    "whole, but of another round": _reseal(WHOLE, 2 + SLOTS),
    "never written": bytes(SLOT_BYTES),
}  # fmt: skip
"""Damaged slots of sample 2 that a reader must reject, by the kind of damage."""


class Board:
    def __init__(self, folder: Path, *, epoch: int = 77, slots: int = SLOTS, now_ns: int = START_NS) -> None:
        self.path = folder / f"imud.{DEVICE}"
        self.now_ns = now_ns
        self.ledger = Ledger()
        self.driver = "hipnuc-uart"
        self.settings = ShmOptions(directory=str(folder), slots=slots, group="")
        self.context = publisher_context(lambda: [self.status()], epoch, lambda: self.now_ns)
        self.publisher = ShmPublisher(self.settings, self.context)
        self.publisher.start()
        try:
            self.publisher.add_device(DEVICE, 3)
        except BaseException:
            self.publisher.close()
            raise

    def status(self) -> DeviceStatus:
        return DeviceStatus(
            DEVICE, 3, self.driver, "", DeviceState.RUNNING, "", {}, {}, 0.0, 0.0, 0, ClockStatus(),
            self.ledger.snapshot(), KernelCounters(), (), 0, None, None, 1,
        )  # fmt: skip

    def publish(self, numbers: Iterable[int]) -> None:
        self.publish_samples([make_sample(seq) for seq in numbers])

    def publish_samples(self, samples: Sequence[Sample]) -> None:
        if samples:  # a batch has at least one sample
            self.publisher.publish(Batch(DEVICE, 3, samples))

    def tick(self, later_ns: int = 1_000_000_000) -> None:
        self.now_ns += later_ns
        self.publisher.tick(self.now_ns)

    def word(self, name: str, size_bytes: int = 8) -> int:
        return int.from_bytes(self.path.read_bytes()[OFFSETS[name] :][:size_bytes], "little")

    def die(self) -> None:
        """Leave the directory in the state after a kill: the ring stays, unlocked and without a writer."""
        copy = self.path.with_name("copy")
        copy.write_bytes(self.path.read_bytes())
        copy.rename(self.path)

    def poke(self, at: int, data: bytes) -> None:
        """Overwrite bytes of the file, like an interrupted writer."""
        with self.path.open("r+b") as file:
            file.seek(at)
            file.write(data)


def check_layout(fields: Iterable[SlotField], size_bytes: int) -> None:
    """Check that each field starts at the end of the previous field, on a multiple of its size, and that the fields
    fill the record."""
    at = 0
    for field in fields:
        assert field.offset == at, field.name
        size = struct.calcsize("<" + field.code)
        assert field.offset % size == 0, f"{field.name} is not aligned to its size"
        at += size * field.count
    assert at == size_bytes


def place_sample(seq: int) -> Sample:
    """Return the sample of `make_sample` with a position and a velocity, which are after the CRC-32 of a slot."""
    place = Position(0.5, -0.25, seq + 0.125, 4, seq)
    return msgspec.structs.replace(make_sample(seq), position=place, velocity_enu_m_s=(1.0, -float(seq), 0.5))
