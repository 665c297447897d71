"""Raw frames of the Forsense IMU61x on a UART (id 0x0666), with a layout from the configuration.

No source states the layout. The vendor's program AG_DATA_PARSE (main.cpp, main.h) uses the same id for a frame of a
steering sensor: time, angle of a front wheel, attitude, position, velocity. imud therefore decodes these frames only if
the option `raw_frame` declares the layout of the payload:

    accelerations X, Y, Z at `accel_at` | angular rates X, Y, Z at `gyro_at` | timer µs u32 at `timer_at`, optional

A device has one stream of samples. With `raw_frame`, AHRS frames are frames of an ignored type.
"""

from collections.abc import Mapping
from itertools import pairwise
from struct import Struct
from typing import Annotated, ClassVar, Final, Literal

from msgspec import Meta

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.drivers.imu61x.common import M_S2_PER_G, RAD_S_PER_DEG_S
from imud.drivers.imu61x.uart.codec import (
    HEADER_BYTES,
    PAYLOAD_BYTES_MAX,
    RAW_FRAME,
    TIMER_MODULUS,
    Frame,
    Imu61xCodec,
)
from imud.drivers.state import OPTIONS
from imud.drivers.value_limits import ACCEL_LIMIT_G, GYRO_LIMIT_DEG_S, scaled
from imud.formats.state import StateTable
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Vector3

ElementType = Literal["f32", "i16", "i32"]
_VECTORS: Final[Mapping[ElementType, Struct]] = {"f32": Struct("<3f"), "i16": Struct("<3h"), "i32": Struct("<3i")}
_TIMER: Final = Struct("<I")
Offset = Annotated[int, Meta(ge=0, le=PAYLOAD_BYTES_MAX - 1)]


class RawFrame(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Layout of the payload of raw frames, little-endian. Offsets are in bytes from the start of the payload."""

    type: ElementType
    """Type of the accelerations and angular rates: float, or signed integer of 16 or 32 bits."""
    accel_at: Offset
    """Offset of the accelerations X, Y, Z in the payload, bytes."""
    gyro_at: Offset
    """Offset of the angular rates X, Y, Z in the payload, bytes."""
    # A larger scale makes every value except zero impossible
    accel_g_per_lsb: Annotated[float, Meta(gt=0, le=ACCEL_LIMIT_G)]
    """Acceleration of the value 1, g."""
    gyro_deg_s_per_lsb: Annotated[float, Meta(gt=0, le=GYRO_LIMIT_DEG_S)]
    """Angular rate of the value 1, °/s."""
    timer_at: Offset | None = None
    """Offset of the device time (unsigned, 32 bits, µs) in the payload, bytes; null: samples without device time."""

    def __post_init__(self) -> None:
        places = self._places()
        for (_, end, name), (begin, _, other) in pairwise(places):
            if begin < end:
                raise ValueError(f"{other}: expected {end} or more, the end of the field at {name}, got {begin}")
        _, end, name = places[-1]
        if end > PAYLOAD_BYTES_MAX:
            raise ValueError(f"{name}: expected a field that ends in a payload of {PAYLOAD_BYTES_MAX} bytes, got {end}")

    @property
    def size_bytes(self) -> int:
        """Minimum length of the payload, bytes."""
        return self._places()[-1][1]

    def _places(self) -> list[tuple[int, int, str]]:
        """Return start, end and key of each field in the order of the payload."""
        size = _VECTORS[self.type].size
        sizes = {"accel_at": size, "gyro_at": size, "timer_at": _TIMER.size}
        starts = ((name, getattr(self, name)) for name in sizes)
        return sorted((at, at + sizes[name], name) for name, at in starts if at is not None)


class RawCodec(Imu61xCodec):
    """Decoder of raw frames into measurements, and of reply frames. It ignores AHRS frames and counts them."""

    sample_frame: ClassVar = RAW_FRAME
    STATE: ClassVar = StateTable(Imu61xCodec.STATE.fields, {**Imu61xCodec.STATE.other, "_layout": OPTIONS})

    def __init__(self, ledger: Ledger, layout: RawFrame) -> None:
        super().__init__(ledger)
        self._layout = layout
        self._payload_bytes_min[RAW_FRAME] = layout.size_bytes

    def usual_frames(self, data: bytes) -> bytes:
        """Return no bytes: the kernel decodes only AHRS frames."""
        return b""

    def _measure(self, frame: Frame, events: list[CodecEvent]) -> None:
        layout, raw = self._layout, frame.raw
        vector = _VECTORS[layout.type]
        accel_lsb = vector.unpack_from(raw, HEADER_BYTES + layout.accel_at)
        gyro_lsb = vector.unpack_from(raw, HEADER_BYTES + layout.gyro_at)
        us = None if layout.timer_at is None else _TIMER.unpack_from(raw, HEADER_BYTES + layout.timer_at)[0]
        g_per_lsb, deg_s_per_lsb = layout.accel_g_per_lsb, layout.gyro_deg_s_per_lsb
        accel = scaled(accel_lsb, g_per_lsb * M_S2_PER_G, ACCEL_LIMIT_G / g_per_lsb)
        gyro = scaled(gyro_lsb, deg_s_per_lsb * RAD_S_PER_DEG_S, GYRO_LIMIT_DEG_S / deg_s_per_lsb)
        if accel is None or gyro is None:
            self.ledger.frames_not_finite += 1
            events.append(BadFrame(BadReason.NOT_FINITE, raw))
        events.append(Measurement(len(raw), frame.trailing_bytes, us, accel, gyro))


def make_codec(ledger: Ledger, settings: Options) -> Imu61xCodec:
    """Return the codec for the options of the driver: of raw frames with `raw_frame`, otherwise of AHRS frames."""
    layout = getattr(settings, "raw_frame", None)
    return Imu61xCodec(ledger, settings) if layout is None else RawCodec(ledger, layout)


# --- encoder for simulated devices ------------------------------------------------------------------------------


def pack_raw(layout: RawFrame, *, timer_us: int, accel_m_s2: Vector3, gyro_rad_s: Vector3) -> bytes:
    """Return the payload of a raw frame from SI values, zero outside the fields. Raises OverflowError or `struct.error`
    beyond the range of the type."""
    payload, vector = bytearray(layout.size_bytes), _VECTORS[layout.type]
    fields = (
        (layout.accel_at, accel_m_s2, layout.accel_g_per_lsb * M_S2_PER_G),
        (layout.gyro_at, gyro_rad_s, layout.gyro_deg_s_per_lsb * RAD_S_PER_DEG_S),
    )
    for at, values, si_per_lsb in fields:
        counts = (value / si_per_lsb for value in values)
        vector.pack_into(payload, at, *(counts if layout.type == "f32" else map(round, counts)))
    if layout.timer_at is not None:
        _TIMER.pack_into(payload, layout.timer_at, timer_us % TIMER_MODULUS)
    return bytes(payload)
