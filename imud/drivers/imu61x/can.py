"""Forsense IMU61x on CAN. Manual "IMU61X Interface Protocol and Instructions", chapter 4 (tables 29 … 33).

Five standard frames of eight data bytes make one sample; identifiers are decimal, all values little-endian:

    ┌─────┬───────────────────┬───────────────────┐
    │ 101 │ roll         f32  │ pitch        f32  │  °
    │ 102 │ yaw          f32  │ gyro x       f32  │  °, °/s
    │ 103 │ gyro y       f32  │ gyro z       f32  │  °/s
    │ 104 │ accel x      f32  │ accel y      f32  │  g
    │ 105 │ accel z      f32  │ temp i16 │ idx u16│  g, 0.01 °C (the manual's "100 °C" is a misprint), counter
    └─────┴───────────────────┴───────────────────┘

Frame 105 completes the sample of the frames 101 … 104 since the previous 105. Its INDEX counts samples and wraps at
65536. Rules against mixing two samples:

- A repeated identifier before a 105 means a lost 105: the codec drops the held frames. It ignores an exact copy
  immediately after the frame, which is a repetition by the bus.
- A set in another order than 101, 102, 103, 104, 105 counts only if INDEX follows the INDEX of the previous 105.
- After lost frames (`reset`), the codec drops the held frames.
- A set in order with a jump of INDEX may contain 101 … 103 of one sample and 104, 105 of a later sample. The time
  decides. A set takes S from its first to its last frame; a mixed set takes at least one period P more. The codec
  accepts a set up to S + P/2. It learns S and P from sets without a jump of INDEX, which cannot be mixed. Before
  SURE_SETS such sets, every set in order counts. If a stalled host or adapter compresses the arrival times, the codec
  cannot decide.

Frames of an incomplete set are valid and ignored (`frames_ignored`). The jump of INDEX to the next complete set is the
number of lost samples. The device accepts no commands over CAN.
"""

import struct
from collections.abc import Sequence
from random import Random
from typing import Annotated, ClassVar, Final

from msgspec import Meta

from imud.attitude.conventions import FLU_LEVEL
from imud.attitude.rotation import quat_from_euler_zyx
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, count_unknown, wrong_length
from imud.contracts.driver import SAMPLE_COUNTER, CanDriver, Identity, random_vector
from imud.contracts.script import says_nothing
from imud.drivers.imu61x.common import (
    EULER_CONVENTION,
    M_S2_PER_G,
    NAVIGATION_FRAME,
    RAD_S_PER_DEG_S,
    SHEET,
    relative_heading,
)
from imud.drivers.state import COUNT, DAEMON, OPTIONS, TIME, UNKNOWN
from imud.drivers.value_limits import (
    ACCEL_LIMIT_G,
    GYRO_LIMIT_DEG_S,
    TURN_DEG,
    are_within,
    possible_temperature_c,
    scaled,
)
from imud.formats.can import STANDARD_ID_MAX, CanFilter, CanFrame
from imud.formats.state import Data, Field, Integer, Items, Map, Maybe, StateTable
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Vector3
from imud.model.units import RAD_PER_DEG

BASE_ID: Final = 101  # factory identifier of the first frame (decimal)
# Data of all five frames: roll, pitch, yaw; gyro x, y, z; accel x, y, z; temperature; INDEX
SET: Final = struct.Struct("<9fhH")
SET_FRAMES: Final = 5
FRAME_BYTES: Final = 8
INDEX_MODULUS: Final = 1 << 16
C_PER_COUNT: Final = 0.01

DOWN: Final = 4
UP: Final = 16  # Divisors: part of a difference by which the learned times decrease or increase
SURE_SETS: Final = 8  # number of sets before the learned times count: a late set would have too much weight
_NEVER_NS: Final = 1 << 63
ALTERNATIONS: Final = 32  # number of changes to another known series after which devices have the same identifiers
STEADY: Final = 256  # number of consecutive INDEX values after which there is one device again
SERIES_MAX: Final = 8  # maximum number of known series
STEP_MOST: Final = 16  # maximum step of INDEX within a series: some samples can be lost

_LIMITS: Final = (*[TURN_DEG] * 3, *[GYRO_LIMIT_DEG_S] * 3, *[ACCEL_LIMIT_G] * 3)  # of the nine floats of a set
_CLOSING: Final = SET_FRAMES - 1
_FLOATS: Final = tuple(struct.Struct(layout) for layout in ("<2f", "<2f", "<2f", "<2f", "<f4x"))
_IN_ORDER: Final = (0, 1, 2, 3)


class Imu61xCanOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an IMU61x on CAN."""

    base_id: Annotated[int, Meta(ge=0, le=STANDARD_ID_MAX - _CLOSING)] = BASE_ID
    """Identifier of the first of the five frames, decimal; the other identifiers follow."""


_INDEX: Final = Integer(0, INDEX_MODULUS - 1)


class _Pace:
    """Duration of a set on the bus, and of a sample, learned from sets that are certainly complete."""

    __slots__ = ("_period_ns", "_sets", "_span_ns", "longest_ns")
    STATE: ClassVar = StateTable(
        (
            Field(1, "_period_ns", TIME),
            Field(2, "_sets", COUNT),
            Field(3, "_span_ns", TIME),
            Field(4, "longest_ns", Integer(0, _NEVER_NS)),
        )
    )

    def __init__(self) -> None:
        self.longest_ns = _NEVER_NS  # maximum duration of a set of one sample, ns
        self._span_ns = 0
        self._period_ns = 0
        self._sets = 0

    def learn(self, span_ns: int, period_ns: int) -> None:
        """Add a complete set: duration from its first to its last frame, and time since the end of the previous set."""
        # fast decrease, slow increase: a small value costs one sample next to a loss, a large value could mix two
        self._span_ns = _moved(self._span_ns, span_ns)
        self._period_ns = _moved(self._period_ns, period_ns)
        self._sets += 1
        if self._period_ns and self._sets >= SURE_SETS:
            self.longest_ns = self._span_ns + self._period_ns // 2


def _moved(mean_ns: int, new_ns: int) -> int:
    if not mean_ns:
        return max(0, new_ns)
    if new_ns < mean_ns:
        return mean_ns - (mean_ns - max(0, new_ns)) // DOWN
    return mean_ns + (min(new_ns, 2 * mean_ns) - mean_ns) // UP


class _Series:
    """Series of INDEX. Each device continues a series of its own. Synchronization: one thread."""

    __slots__ = ("_alternations", "_newest", "_steady")
    STATE: ClassVar = StateTable(
        (
            Field(1, "_newest", Items(_INDEX, SERIES_MAX)),
            Field(2, "_steady", COUNT),
            Field(3, "_alternations", COUNT),
        )
    )

    def __init__(self) -> None:
        self._newest: list[int] = []  # newest INDEX of each series, the series with the newest frame last
        self._steady = 0  # number of consecutive 105 that follow their predecessor
        self._alternations = 0  # number of changes to a known series since the start of the newest series

    @property
    def are_several(self) -> bool:
        """Whether INDEX alternates between series."""
        return self._alternations >= ALTERNATIONS

    def add(self, index: int) -> None:
        """Add the INDEX of a 105."""
        known = self._newest
        if known and (index - known[-1]) % INDEX_MODULUS == 1:
            known[-1] = index
            self._steady += 1
            if self._steady >= STEADY:
                self._alternations = 0
                del known[:-1]
            return
        self._steady = 0
        steps = [(index - newest) % INDEX_MODULUS for newest in known]
        step = min((one for one in steps if one), default=STEP_MOST + 1)
        if step <= STEP_MOST:
            known.pop(steps.index(step))
            self._alternations += step == 1
        elif 0 not in steps:
            self._alternations = 0
        del known[: 1 - SERIES_MAX]
        known.append(index)


class Imu61xCanCodec:
    """Decoder of the frames of one device. Synchronization: one thread."""

    counts_losses = False
    STATE: ClassVar = StateTable(
        (
            Field(1, "unknown", UNKNOWN),
            Field(2, "_held", Map(Integer(0, _CLOSING - 1), Data(FRAME_BYTES, FRAME_BYTES), _CLOSING)),
            Field(3, "_newest", Integer(-1, _CLOSING - 1)),
            Field(4, "_first_ns", TIME),
            Field(5, "_index", Maybe(_INDEX)),
            Field(6, "_closed_ns", TIME),
            Field(7, "_pace", _Pace.STATE),
            Field(8, "_closing", Data(FRAME_BYTES)),
            Field(9, "_series", _Series.STATE),
        ),
        {"ledger": DAEMON, "_slots": OPTIONS},
    )

    def __init__(self, ledger: Ledger, settings: Imu61xCanOptions) -> None:
        self.ledger = ledger
        self.unknown: dict[int, int] = {}  # number of frames by standard identifier outside base_id … base_id + 4
        self._slots = {settings.base_id + slot: slot for slot in range(SET_FRAMES)}
        self._held: dict[int, bytes] = {}  # data of 101 … 104 by index, in the order of arrival
        self._newest = -1  # index of the newest held frame
        self._first_ns = 0  # arrival of the first frame of the set, ns
        self._index: int | None = None  # INDEX of the newest 105
        self._closed_ns = 0  # arrival of the newest 105, ns
        self._pace = _Pace()
        self._closing = b""  # data of the newest 105
        self._series = _Series()

    @property
    def problem(self) -> str:
        """Return the conflict of devices with the same identifiers; empty without a conflict."""
        if not self._series.are_several:
            return ""
        return "INDEX alternates between series; do two or more devices on the bus have this base_id?"

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Decode one frame. Return the completed events. Never raises an exception."""
        ledger, size = self.ledger, len(data)
        ledger.bytes_in += size
        slot = self._slots.get(can_id)
        if slot is None or extended:
            ledger.bytes_skipped += size
            if not extended:
                count_unknown(self.unknown, can_id)
            return ()
        if size != FRAME_BYTES:
            return wrong_length(ledger, can_id, data)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        if slot == _CLOSING:
            return self._close(data, t_rx_ns)
        held = self._held
        if slot in held:
            if slot == self._newest and held[slot] == data:
                ledger.frames_ignored += 1
                return ()
            self.reset()
        if not held:
            self._first_ns = t_rx_ns
        held[slot] = data
        self._newest = slot
        ledger.frames_pending += 1
        return ()

    def flush(self) -> Sequence[CodecEvent]:
        """Return no event, because only a 105 completes a set. Count the held frames."""
        self.reset()
        return ()

    def reset(self) -> None:
        """Drop the held frames after lost frames."""
        held, ledger = self._held, self.ledger
        ledger.frames_ignored += len(held)
        ledger.frames_pending -= len(held)
        held.clear()
        self._newest = -1

    def _close(self, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Return the sample of a set with its 105; no event for an incomplete set."""
        held, ledger, before, pace = self._held, self.ledger, self._index, self._pace
        self._index = index = data[6] | data[7] << 8
        before_ns, self._closed_ns = self._closed_ns, t_rx_ns
        span_ns = t_rx_ns - self._first_ns
        follows = before is not None and (index - before) % INDEX_MODULUS == 1
        if data != self._closing:
            self._series.add(index)
        self._closing = data
        places = tuple(held)
        in_time = places == _IN_ORDER and span_ns <= pace.longest_ns
        is_whole = in_time or (follows and len(places) == _CLOSING)
        if not is_whole:
            self.reset()
            ledger.frames_ignored += 1
            return ()
        if follows:
            pace.learn(span_ns, t_rx_ns - before_ns)
        raw, first_ns = b"".join([*map(held.__getitem__, _IN_ORDER), data]), self._first_ns
        held.clear()
        self._newest = -1
        ledger.frames_pending -= _CLOSING
        ledger.frames_in_samples += SET_FRAMES
        *values, temperature, _ = SET.unpack(raw)
        measurement = _measurement(values, temperature, index, first_ns)
        if None not in (
            measurement.euler_rad, measurement.gyro_rad_s, measurement.accel_m_s2, measurement.temperature_c
        ):  # fmt: skip
            return (measurement,)
        return (*self._not_finite(raw), measurement)

    def _not_finite(self, raw: bytes) -> list[CodecEvent]:
        """Return a `BadFrame` for every frame with a value that is not possible."""
        events: list[CodecEvent] = []
        for slot, layout in enumerate(_FLOATS):
            data = raw[slot * FRAME_BYTES : (slot + 1) * FRAME_BYTES]
            limits = _LIMITS[2 * slot :]
            is_good = all(are_within([value], limit) for value, limit in zip(layout.unpack(data), limits, strict=False))
            if slot == _CLOSING:
                is_good = is_good and possible_temperature_c(SET.unpack(raw)[9] * C_PER_COUNT) is not None
            if not is_good:
                self.ledger.frames_not_finite += 1
                events.append(BadFrame(BadReason.NOT_FINITE, data))
        return events


def _measurement(values: Sequence[float], temperature: int, index: int, first_ns: int) -> Measurement:
    """Return the measurement of a complete set, without groups with a value that is not possible."""
    roll, pitch, yaw, gx, gy, gz, ax, ay, az = values
    euler = scaled((roll, pitch, yaw), RAD_PER_DEG, TURN_DEG)
    return Measurement(
        SET.size, 0, index, scaled((ax, ay, az), M_S2_PER_G, ACCEL_LIMIT_G),
        scaled((gx, gy, gz), RAD_S_PER_DEG_S, GYRO_LIMIT_DEG_S), None,
        None if euler is None else quat_from_euler_zyx(euler), euler,
        possible_temperature_c(temperature * C_PER_COUNT), t_first_ns=first_ns,
    )  # fmt: skip


# --- encoder for simulated devices ------------------------------------------------------------------------------


def encode_set(
    *,
    index: int,
    accel_m_s2: Vector3,
    gyro_rad_s: Vector3,
    euler_rad: Vector3,
    temperature_c: float,
    base_id: int = BASE_ID,
) -> list[tuple[int, bytes]]:
    """Return the five frames (identifier, data) of a sample. `euler_rad` is roll, pitch, yaw; INDEX wraps.

    Raises OverflowError beyond f32 and struct.error for a temperature beyond ±327 °C.
    """
    raw = SET.pack(
        *(angle / RAD_PER_DEG for angle in euler_rad),
        *(w / RAD_S_PER_DEG_S for w in gyro_rad_s),
        *(a / M_S2_PER_G for a in accel_m_s2),
        round(temperature_c / C_PER_COUNT),
        index % INDEX_MODULUS,
    )
    return [(base_id + slot, raw[slot * FRAME_BYTES : (slot + 1) * FRAME_BYTES]) for slot in range(SET_FRAMES)]


def _example_frames(random: Random) -> list[CanFrame]:
    frames = encode_set(
        index=random.randrange(INDEX_MODULUS),
        accel_m_s2=random_vector(random, 9.8),
        gyro_rad_s=random_vector(random, 2),
        euler_rad=(random.uniform(-3, 3), random.uniform(-1.5, 1.5), random.uniform(-3, 3)),
        temperature_c=random.uniform(-40, 85),
    )
    return [CanFrame(can_id, False, data, 0) for can_id, data in frames]


def _filters(settings: Imu61xCanOptions) -> list[CanFilter]:
    """Return one filter for each identifier, because other devices may use the adjacent identifiers."""
    return [CanFilter(settings.base_id + slot, STANDARD_ID_MAX, False) for slot in range(SET_FRAMES)]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    """Return BASE_ID for a frame with a factory identifier. imud cannot recognize other identifiers."""
    slot = can_id - BASE_ID
    return BASE_ID if 0 <= slot < SET_FRAMES and not extended and len(data) == FRAME_BYTES else None


DRIVER: Final = CanDriver(
    name="imu61x-can",
    title="Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B (CAN)",
    settings=Imu61xCanOptions,
    make_codec=Imu61xCanCodec,
    filters=_filters,
    sent_by=lambda _settings: [CanFilter(0, 0, False)],  # each identifier is a setting of the device
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=INDEX_MODULUS,
    euler_convention=EULER_CONVENTION,
    navigation_frame=NAVIGATION_FRAME,
    data_sheet=SHEET,
    axes=FLU_LEVEL,
    heading=relative_heading,
    node_of=_node_of,
    node_settings=lambda base_id: Imu61xCanOptions(base_id=base_id),
    node_title=lambda base_id: f"base_id {base_id}",
    identify=lambda _settings: says_nothing(Identity()),
    sample_frames=SET_FRAMES,
    example_frames=_example_frames,
    unknown_name=lambda can_id: f"identifier {can_id}",
    decoded="imud decodes the identifiers base_id to base_id + 4: configure options.base_id of the device",
)
