"""History of the samples for plots: minimum and maximum of each second of the last hour, by device.

A second is one record of 184 bytes with single precision. imud adds packed slots to the open second, so no sample
object is made. The kernel in C does this work if it is installed. The lost samples of a second come from the ledger.
"""

from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import groupby, takewhile
from math import isfinite
from operator import and_, sub
from struct import Struct
from typing import Any, Final

import msgspec

from imud.attitude.published import PublishedAxes, Rotation
from imud.contracts.publisher import Batch, Devices
from imud.formats import kernel
from imud.formats.slot import (
    HAS_ACCEL,
    HAS_EULER,
    HAS_GYRO,
    HAS_MAG,
    HAS_PRESSURE,
    HAS_QUAT,
    HAS_TEMPERATURE,
    SLOT_BYTES,
    SYNC_BY_CODE,
)
from imud.model.bucket import VECTORS, Bucket, Range
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S

KEPT_S: Final = 3600
"""Maximum age of the oldest second, s."""
BYTES_MAX: Final = 64 << 20
"""Maximum memory of all devices, bytes. With more than 101 devices, the history of each is shorter."""
BATCHES_MAX: Final = 16
"""Number of batches that imud adds to a second together. The work for each wake-up is then small."""

# first t_ns, last t_ns, last utc_ns, maximum latency, last seq, count, maximum t_err_ns, present bits, last sync,
# minimum and maximum of 12 axes, last quaternion, last temperature, last pressure, lost samples, gaps of unknown size
SECOND: Final = Struct("<qqqqQIIIB3x12f12f4fffII")
_COUNT_MAX: Final = (1 << 32) - 1
_NEW: Final = bytes(SECOND.size)
# seq, t_ns, t_rx_ns, utc_ns, t_err_ns, present, sync, values
_SLOT: Final = Struct("<Qqqq16xII6xBx9d4d3ddd112x")
# bit of `present`, index of the first value in `_SLOT`, index of the first value in a second
_VECTOR_PLACES: Final = ((HAS_ACCEL, 7, 0), (HAS_GYRO, 10, 3), (HAS_MAG, 13, 6), (HAS_EULER, 20, 9))
# bit of `present`, range of the values in `_SLOT`, index of the first value in a second
_LAST_PLACES: Final = ((HAS_QUAT, 16, 20, 24), (HAS_TEMPERATURE, 23, 24, 28), (HAS_PRESSURE, 24, 25, 29))
_FLOAT_MAX: Final = (2 - 2**-23) * 2.0**127
_VECTOR_BITS: Final = (HAS_ACCEL, HAS_GYRO, HAS_MAG, HAS_EULER)


def add_slots(second: bytearray, packed: bytes, offset: int) -> int:
    """Add the slots from `offset` on to an open second. Return the offset of the first slot in another second."""
    first_ns, _, _, latency_ns, _, count, t_err_ns, present, _, *values = SECOND.unpack(second)
    slots = list(_SLOT.iter_unpack(memoryview(packed)[offset:]))
    if not count:
        first_ns, latency_ns = slots[0][1], -(1 << 63)
    number = first_ns // NS_PER_S
    slots = list(takewhile(lambda slot: slot[1] // NS_PER_S == number, slots))
    if not slots:
        return offset
    columns = list(zip(*slots, strict=True))
    waited_ns = max(map(sub, columns[2], columns[1]))
    latency_ns = max(latency_ns, min(waited_ns, (1 << 63) - 1))
    for bit, begin, to in _VECTOR_PLACES:
        axes = _usable(columns[5], bit, columns[begin : begin + 3])
        for place, axis in enumerate(axes, to):
            low, high = min(axis), max(axis)
            values[place] = min(low, values[place]) if present & bit else low
            values[place + 12] = max(high, values[place + 12]) if present & bit else high
        present |= bit if axes else 0
    for bit, begin, end, to in _LAST_PLACES:
        last = next((one[begin:end] for one in reversed(slots) if one[5] & bit and _fit_float(one[begin:end])), ())
        values[to : to + len(last)] = last
        present |= bit if last else 0
    seq, last_ns, _, utc_ns, _, _, sync, *_ = slots[-1]
    t_err_ns = max(t_err_ns, *columns[4])
    SECOND.pack_into(
        second, 0, first_ns, last_ns, utc_ns, latency_ns, seq, count + len(slots), t_err_ns, present, sync, *values
    )
    return offset + len(slots) * SLOT_BYTES


def _usable(present: Sequence[int], bit: int, axes: Sequence[Any]) -> Sequence[Any]:
    """Return the values of the axes that count; empty without values."""
    if (
        reduce(and_, present) & bit
        and isfinite(sum(map(sum, axes)))
        and all(_fit_float((min(a), max(a))) for a in axes)
    ):
        return axes  # usual case: all values count
    kept = [v for v, bits in zip(zip(*axes, strict=True), present, strict=True) if bits & bit and _fit_float(v)]
    return list(zip(*kept, strict=True))


def _fit_float(values: Sequence[float]) -> bool:
    return all(-_FLOAT_MAX <= value <= _FLOAT_MAX for value in values)  # false for NaN too


@dataclass(slots=True)
class _DeviceHistory:
    """Seconds of one device. A second without samples has no record."""

    frame: PublishedAxes  # axes and angles of the samples
    losses: tuple[int, ...]  # `Ledger.losses` at the newest slot in a second
    open: bytearray = field(default_factory=lambda: bytearray(_NEW))
    kept: bytearray = field(default_factory=bytearray)  # complete seconds, oldest first
    waiting: list[bytes] = field(default_factory=list)  # slots of the newest batches, not yet in a second

    def add_losses(self, losses: tuple[int, ...]) -> None:
        """Add the losses since the previous call to the open second."""
        *lost, gaps = (max(now - then, 0) for then, now in zip(self.losses, losses, strict=True))
        self.losses = losses
        for place, count in ((SECOND.size - 8, sum(lost)), (SECOND.size - 4, gaps)):
            known = int.from_bytes(self.open[place : place + 4], "little")
            self.open[place : place + 4] = min(known + count, _COUNT_MAX).to_bytes(4, "little")

    def end_second(self, seconds_max: int) -> None:
        """Keep the open second, and remove the seconds that are too old."""
        first_ns, kept = _first_ns(self.open), self.kept
        if kept and first_ns <= _first_ns(kept, len(kept) - SECOND.size):
            kept.clear()  # the time stamps went back: another recording
        kept += self.open
        self.open[:] = _NEW
        old = max(0, len(kept) - seconds_max * SECOND.size)
        oldest_ns = first_ns - KEPT_S * NS_PER_S
        while _first_ns(kept, old) <= oldest_ns:
            old += SECOND.size
        del kept[:old]


def _first_ns(records: bytearray, offset: int = 0) -> int:
    return int.from_bytes(records[offset : offset + 8], "little", signed=True)


class History:
    """History of all devices. Synchronization: the event loop's thread only."""

    def __init__(self, devices: Devices) -> None:
        self._owner = devices
        self._devices: dict[str, _DeviceHistory] = {}
        self._add_slots = getattr(kernel.present.module, "add_slots", add_slots)

    @property
    def kept_s(self) -> int:
        """Maximum number of seconds of each device."""
        return min(KEPT_S, BYTES_MAX // (SECOND.size * max(1, len(self._devices))))

    def add(self, batch: Batch) -> None:
        device = self._devices.get(batch.device)
        if device is None or (device.frame is not batch.frame and device.frame != batch.frame):
            device = self._devices[batch.device] = _DeviceHistory(batch.frame, self._owner.losses(batch.device))
        waiting = device.waiting
        waiting.append(batch.packed)
        if len(waiting) >= BATCHES_MAX:
            self._add_waiting(batch.device, device)

    def _add_waiting(self, name: str, device: _DeviceHistory) -> None:
        packed = b"".join(device.waiting)
        device.waiting.clear()
        offset = self._add_slots(device.open, packed, 0)
        while offset < len(packed):
            device.end_second(self.kept_s)
            offset = self._add_slots(device.open, packed, offset)
        if (losses := self._owner.losses(name)) != device.losses:
            device.add_losses(losses)

    def tick(self) -> None:
        """Add the waiting slots of the devices with a loss. Otherwise the loss of a slow device would be late."""
        for name, device in self._devices.items():
            if device.waiting and self._owner.losses(name) != device.losses:
                self._add_waiting(name, device)

    def remove(self, device: str) -> None:
        """Forget a device. Do nothing if it is unknown."""
        self._devices.pop(device, None)

    def retain(self, devices: Collection[str]) -> None:
        """Forget all other devices."""
        for name in [one for one in self._devices if one not in devices]:
            del self._devices[name]

    def frame(self, device: str) -> PublishedAxes | None:
        """Return the axes of the samples of a device; None without samples."""
        known = self._devices.get(device)
        return None if known is None else known.frame

    def seconds(self, device: str) -> bytes:
        """Return the records of a device, the open second included."""
        known = self._devices.get(device)
        if known is None:
            return b""
        if known.waiting:
            self._add_waiting(device, known)
        return bytes(known.kept) + (bytes(known.open) if known.open != _NEW else b"")


def end_ns(records: bytes) -> int | None:
    """Return the time of the newest sample; None without records."""
    return SECOND.unpack_from(records, len(records) - SECOND.size)[1] if records else None


def buckets(records: bytes, from_ns: int, to_ns: int, period_s: int, rotation: Rotation | None) -> Iterator[Bucket]:
    """Yield a bucket for each period with samples; the first period begins with the second of `from_ns`. A second is in
    a bucket if it has samples in the time range."""
    begin_s = from_ns // NS_PER_S
    places = range(0, len(records), SECOND.size)
    first = bisect_left(places, from_ns, key=lambda place: SECOND.unpack_from(records, place)[1]) * SECOND.size
    wanted = takewhile(lambda one: one[0] <= to_ns, SECOND.iter_unpack(memoryview(records)[first:]))
    for _, group in groupby(wanted, lambda one: (one[0] // NS_PER_S - begin_s) // period_s):
        bucket = _bucket(list(group))
        yield bucket if rotation is None else _rotated(bucket, rotation)


def _bucket(seconds: list[tuple[Any, ...]]) -> Bucket:
    first, last = seconds[0], seconds[-1]

    def newest(bit: int, begin: int, end: int) -> tuple[float, ...] | None:
        return next((one[33 + begin : 33 + end] for one in reversed(seconds) if one[7] & bit), None)

    ranges: dict[str, Range | None] = {}
    for place, (name, bit) in enumerate(zip(VECTORS, _VECTOR_BITS, strict=True)):
        at, having = 9 + 3 * place, [one for one in seconds if one[7] & bit]
        lows, highs = ([one[begin : begin + 3] for one in having] for begin in (at, at + 12))
        found = tuple(map(min, zip(*lows, strict=True))), tuple(map(max, zip(*highs, strict=True)))
        ranges[name] = found if having else None
    temperature, pressure = newest(HAS_TEMPERATURE, 4, 5), newest(HAS_PRESSURE, 5, 6)
    return Bucket(
        first_s=first[0] / NS_PER_S,
        last_s=last[1] / NS_PER_S,
        utc_s=last[2] / NS_PER_S,
        count=sum(one[5] for one in seconds),
        seq=last[4],
        sync=str(SYNC_BY_CODE[last[8]]),
        t_err_s=max(one[6] for one in seconds) / NS_PER_S,
        latency_s=max(one[3] for one in seconds) / NS_PER_S,
        quat_wxyz=newest(HAS_QUAT, 0, 4),
        temperature_c=None if temperature is None else temperature[0],
        pressure_pa=None if pressure is None else pressure[0],
        lost=sum(one[39] for one in seconds),
        gaps=sum(one[40] for one in seconds),
        **ranges,
    )


def _rotated(bucket: Bucket, rotation: Rotation) -> Bucket:
    """Return a bucket in another convention. A convention only exchanges axes and signs, and adds a constant to yaw, so
    the rotated limits are the limits of the rotated values."""
    ranges = [getattr(bucket, name) for name in VECTORS]
    one, other = (_turned(rotation, [found and found[side] for found in ranges]) for side in (0, 1))
    quat = rotation.sample(_sample([None] * len(VECTORS), bucket.quat_wxyz)).quat_wxyz
    made = {
        name: None if a is None or b is None else (tuple(map(min, a, b)), tuple(map(max, a, b)))
        for name, a, b in zip(VECTORS, one, other, strict=True)
    }
    return msgspec.structs.replace(bucket, quat_wxyz=quat, **made)


def _turned(rotation: Rotation, vectors: list[Any]) -> list[Any]:
    turned = rotation.sample(_sample(vectors, None))
    return [getattr(turned, name) for name in VECTORS]


def _sample(vectors: list[Any], quat: Any) -> Sample:
    accel, gyro, mag, euler = vectors
    return Sample("", 0, 0, 0, Sync.ARRIVAL, 0, 0, None, accel, gyro, mag, quat, euler)
