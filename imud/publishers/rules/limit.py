"""Limit of one value of one device, evaluated on packed slots.

    slot ─▶ field ─▶ band filter ─▶ magnitude ─▶ peak or RMS of a window ─▶ limit, hysteresis, hold ─▶ change

A `LimitState` is also a record of `STATE` bytes for the kernel. `evaluate` processes slots up to the first change. The
kernel in C has equal results in every bit (`Limit` in imud/_kernel.c).

**Hold.** A change needs samples on the new side of the limit for the hold time. The time between two samples counts
with at most `STEP_MAX_NS`, so a gap does not complete a hold.

**Band filter.** A Butterworth band-pass of order `ORDER` per edge from the bilinear transform with pre-warped edges, as
`scipy.signal.butter(ORDER, edges, "bandpass", output="sos")`. Its `SECTIONS` biquads have the numerator g (1 - z⁻²).
The sample period is the mean of `PERIOD_STEPS` or more steps in `PERIOD_NS` or more. The filter starts again after a
gap (a step longer than 1.5 periods), after a non-finite value, and with a new design after the period changed by more
than 5 %. It starts in the steady state of its first value, and its values count after the settling time.
"""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from math import acos, cos, fabs, inf, isfinite, pi, sqrt, tan
from struct import Struct
from typing import Final

from imud.formats import kernel
from imud.formats.slot import SLOT_BYTES, SLOT_FIELDS
from imud.model.units import NS_PER_S

ORDER: Final = 4  # of the Butterworth prototype: 24 dB per octave at each edge
SECTIONS: Final = ORDER
AXES: Final = 3
STEP_MAX_NS: Final = NS_PER_S  # maximum part of a hold between two samples, ns
PERIOD_NS: Final = NS_PER_S  # minimum time of a measurement of the sample period, ns
PERIOD_STEPS: Final = 16  # minimum number of steps of this measurement
LATE_MAX: Final = 16  # number of successive gaps after which imud measures the sample period again
GAP_PERIODS: Final = 1.5  # a longer step of the time stamps is a gap
PERIOD_CHANGE: Final = 0.05  # relative change of the sample period after which imud designs the filter again


class Reduction(IntEnum):
    """Value of one sample from its components."""

    MAGNITUDE = 0  # absolute value of one component, or norm of three
    SIGNED = 1  # the only component
    TILT = 2  # angle between the z axes of body and navigation frame from roll and pitch: cos = cos(roll) cos(pitch)
    INTEGER = 3  # the only component, an unsigned integer of 32 bits


class Statistic(IntEnum):
    """Value of a window of samples."""

    SAMPLE = 0  # no window: each sample
    PEAK = 1  # maximum of the present and the previous window
    RMS = 2  # of each complete window, around its mean (without a band filter) or around zero


class Change(IntEnum):
    """Reason why `evaluate` stopped after a slot."""

    NONE = 0
    BEGIN = 1  # the value is beyond its limit
    END = 2  # the value is back
    PERIOD = 3  # the sample period is known or differs: the band filter needs a design


_SCALARS: Final = (
    # parameters: limits (infinite without a limit), limits with hysteresis, factor from the unit of the slot
    "above", "below", "above_end", "below_end", "scale",
    "value",  # newest value
    "period_ns",  # sample period for the band filter; 0: unknown
    "peak", "peak_before",  # maximum of the present and the previous window
)  # fmt: skip
_INTEGERS: Final = (
    "hold_ns", "end_hold_ns", "window_ns",
    "settle_ns",  # time after a start of the filter without values
    "last_ns",  # time stamp of the newest used sample
    "held_ns",  # time of the newest samples on the new side; -1: the newest sample is not on the new side
    "begin_ns", "number",  # first sample and number of samples of the window
    "measured_ns", "measured",  # measurement of the sample period: first sample, number of steps
    "late",  # number of successive gaps
    "filter_ns",  # first sample of the filter
    "used", "absent", "not_finite",  # number of samples with the field, without it, and with a non-finite value
    "evaluated",  # number of comparisons with the limit
    "restarts",  # number of starts of the filter after a gap
)  # fmt: skip
_SMALL: Final = (
    "count",  # number of components
    "reduction", "statistic",
    "has_band",
    "designed",  # whether the coefficients belong to `period_ns`
    "active", "change",
    "is_old",  # whether a sample was used before
    "is_filtering",  # whether the memory of the filter is valid
    "has_window",  # whether the window has its first sample
)  # fmt: skip
STATE: Final = Struct(
    f"<{len(_SCALARS)}d{len(_INTEGERS)}qIH{len(_SMALL)}B{2 * AXES}d{3 * SECTIONS}d{AXES * SECTIONS * 2}d"
)
_ARRAYS_AT: Final = len(_SCALARS) + len(_INTEGERS) + 2 + len(_SMALL)
_PRESENT: Final = next(field.offset for field in SLOT_FIELDS if field.name == "present")
_U32: Final = Struct("<I")
_TIME: Final = Struct("<8xq")
_FIELDS: Final = {1: Struct("<d"), 2: Struct("<2d"), 3: Struct("<3d")}
_TIME_MOST_NS: Final = 1 << 60  # maximum magnitude of a usable time stamp, 36 years


class LimitState:
    """State of a limit as attributes."""

    __slots__ = (*_SCALARS, *_INTEGERS, "bit", "offset", *_SMALL, "sums", "squares", "gains", "a1", "a2", "memory")

    above: float
    below: float
    above_end: float
    below_end: float
    scale: float
    value: float
    period_ns: float
    peak: float
    peak_before: float
    hold_ns: int
    end_hold_ns: int
    window_ns: int
    settle_ns: int
    last_ns: int
    held_ns: int
    begin_ns: int
    number: int
    measured_ns: int
    measured: int
    late: int
    filter_ns: int
    used: int
    absent: int
    not_finite: int
    evaluated: int
    restarts: int
    bit: int  # bit of the field in `present`; 0: always present
    offset: int  # place of the first component in the slot
    count: int
    reduction: int
    statistic: int
    has_band: int
    designed: int
    active: int
    change: int
    is_old: int
    is_filtering: int
    has_window: int
    sums: list[float]  # of the window, by axis
    squares: list[float]
    gains: list[float]  # of each biquad
    a1: list[float]
    a2: list[float]
    memory: list[float]  # two values of each biquad of each axis

    def __init__(self) -> None:
        self.load(bytes(STATE.size))

    def load(self, packed: bytes | bytearray) -> None:
        """Set all attributes to the values of a record."""
        values = STATE.unpack(packed)
        for name, value in zip(self.__slots__, values[:_ARRAYS_AT], strict=False):
            setattr(self, name, value)
        arrays, at = list(values[_ARRAYS_AT:]), 0
        for name, size in (*_ARRAYS, ("memory", AXES * SECTIONS * 2)):
            setattr(self, name, arrays[at : at + size])
            at += size

    def pack_into(self, packed: bytearray) -> None:
        scalars = [getattr(self, name) for name in self.__slots__[:_ARRAYS_AT]]
        arrays = (self.sums, self.squares, self.gains, self.a1, self.a2, self.memory)
        STATE.pack_into(packed, 0, *scalars, *(value for array in arrays for value in array))

    def is_beyond(self, value: float) -> bool:
        return value > self.above or value < self.below

    def compare(self, value: float, step_ns: int) -> Change:
        """Compare a value with the limit, `step_ns` after the previous value. Return the change."""
        self.value = value
        self.evaluated += 1
        is_new_side = (
            value <= self.above_end and value >= self.below_end if self.active else self.is_beyond(value)
        )  # fmt: skip
        if not is_new_side:
            self.held_ns = -1
            return Change.NONE
        self.held_ns = 0 if self.held_ns < 0 else self.held_ns + min(step_ns, STEP_MAX_NS)
        if self.held_ns < (self.end_hold_ns if self.active else self.hold_ns):
            return Change.NONE
        self.active, self.held_ns = 1 - self.active, -1
        return Change.BEGIN if self.active else Change.END

    def design(self, low_hz: float, high_hz: float) -> str:
        """Compute the filter for the measured period. Return why this is not possible, or an empty text."""
        self.designed = 0
        half_hz = NS_PER_S / self.period_ns / 2
        if high_hz >= half_hz:
            return (
                f"expected band_hz below half the sample rate ({half_hz:.6g} Hz), got {high_hz:g} Hz; "
                "reduce band_hz or raise the sample rate of the device"
            )
        sections = band_pass(low_hz, high_hz, NS_PER_S / self.period_ns)
        self.gains, self.a1, self.a2 = ([getattr(one, name) for one in sections] for name in ("gain", "a1", "a2"))
        self.settle_ns = round(settle_s(low_hz, high_hz) * NS_PER_S)
        self.designed, self.is_filtering = 1, 0
        return ""


_ARRAYS: Final = (("sums", AXES), ("squares", AXES), ("gains", SECTIONS), ("a1", SECTIONS), ("a2", SECTIONS))


@dataclass(frozen=True, slots=True)
class Biquad:
    """Biquad gain (1 - z⁻²) / (1 + a1 z⁻¹ + a2 z⁻²)."""

    gain: float
    a1: float
    a2: float


def settle_s(low_hz: float, high_hz: float) -> float:
    """Return the settling time of the filter: two periods of the lower edge or of the width of the band, s."""
    return 2 / min(low_hz, high_hz - low_hz)


def band_pass(low_hz: float, high_hz: float, rate_hz: float) -> list[Biquad]:
    """Return the biquads of the Butterworth band-pass with -3 dB at both edges. Each has the gain 1 at the center."""
    low, high = (2 * rate_hz * tan(pi * edge / rate_hz) for edge in (low_hz, high_hz))
    width, center = high - low, sqrt(low * high)
    z_center = cmath.exp(2j * math.atan(center / (2 * rate_hz)))
    found = []
    for number in range(ORDER // 2):
        # pole of the prototype in the upper half plane, and the two poles that replace it in the band-pass
        half = cmath.exp(1j * pi * (2 * number + 1 + ORDER) / (2 * ORDER)) * width / 2
        root = cmath.sqrt(half * half - center * center)
        for pole in (half + root, half - root):
            z = (2 * rate_hz + pole) / (2 * rate_hz - pole)
            a1, a2 = -2 * z.real, abs(z) ** 2
            there = (1 - z_center**-2) / (1 + a1 / z_center + a2 / z_center**2)
            found.append(Biquad(1 / abs(there), a1, a2))
    return found


def evaluate(state: LimitState, packed: bytes, offset: int) -> int:
    """Evaluate the slots from `offset` on, up to the first change. Return the offset after the slot of the change; -1
    if the slots contain no change."""
    for at in range(offset, len(packed) - SLOT_BYTES + 1, SLOT_BYTES):
        state.change = _add(state, packed, at)
        if state.change:
            return at + SLOT_BYTES
    return -1


class Limit:
    """Limit with its state: in the memory of the kernel, or as attributes for the Python code."""

    def __init__(self, state: LimitState) -> None:
        self._state = state
        module = kernel.present.module
        self._packed = bytearray(STATE.size) if module is not None else None
        self.store()
        # Evaluates packed slots from an offset on, as the function `evaluate`
        self.evaluate: Callable[[bytes, int], int] = (
            partial(evaluate, state) if module is None else partial(module.evaluate, self._packed)
        )

    def load(self) -> LimitState:
        """Return the present state. Call `store` after a change of the state."""
        if self._packed is not None:
            self._state.load(self._packed)
        return self._state

    def store(self) -> None:
        """Use the changed state of `load` in the next evaluation."""
        if self._packed is not None:
            self._state.pack_into(self._packed)


def _add(state: LimitState, packed: bytes, at: int) -> Change:
    """Add a slot. Return the change."""
    (t_ns,) = _TIME.unpack_from(packed, at)
    if state.bit and not _U32.unpack_from(packed, at + _PRESENT)[0] & state.bit:
        state.absent += 1
        return Change.NONE
    if state.reduction == Reduction.INTEGER:
        x: list[float] = [float(_U32.unpack_from(packed, at + state.offset)[0])]
    else:
        x = list(_FIELDS[state.count].unpack_from(packed, at + state.offset))
    if not _are_usable(state, [*x, inf if abs(t_ns) > _TIME_MOST_NS else 0.0]):
        return Change.NONE
    step_ns = t_ns - state.last_ns if state.is_old else 0
    if not state.is_old or step_ns < 0:  # the first sample, or the time stamps went back
        state.is_old, state.measured_ns, state.measured, state.late = 1, t_ns, 0, 0
        state.is_filtering, state.has_window, state.held_ns, step_ns = 0, 0, -1, 0
    state.last_ns = t_ns
    state.used += 1
    if state.has_band:
        if _follow_period(state, t_ns, step_ns):
            return Change.PERIOD
        if not state.designed:
            return Change.NONE
        x = _filtered(state, t_ns, x)
        if not _are_usable(state, x) or t_ns - state.filter_ns < state.settle_ns:
            return Change.NONE
    value = _value(state, t_ns, step_ns, x)
    is_value = value is not None and isfinite(value)
    state.not_finite += value is not None and not is_value
    return state.compare(value, step_ns) if value is not None and is_value else Change.NONE


def _are_usable(state: LimitState, x: list[float]) -> bool:
    """Return whether all components are finite; otherwise count them, and start the filter again."""
    if all(map(isfinite, x)):
        return True
    state.not_finite += 1
    state.is_filtering = 0
    return False


def _value(state: LimitState, t_ns: int, step_ns: int, x: list[float]) -> float | None:
    """Return the value of the sample or of its window; None before the first complete window."""
    if state.statistic == Statistic.RMS:
        return _rms(state, t_ns, step_ns, x)
    if state.reduction == Reduction.TILT:
        value = state.scale * acos(cos(x[0]) * cos(x[1]))
    elif state.reduction != Reduction.MAGNITUDE:
        value = state.scale * x[0]
    elif state.count == 1:
        value = state.scale * fabs(x[0])
    else:
        value = state.scale * sqrt((x[0] * x[0] + x[1] * x[1]) + x[2] * x[2])
    if state.statistic == Statistic.SAMPLE or not isfinite(value):
        return value
    if not state.has_window or t_ns - state.begin_ns >= state.window_ns:
        is_next = state.has_window and t_ns - state.begin_ns < 2 * state.window_ns
        state.peak_before = state.peak if is_next else 0.0
        state.peak, state.begin_ns, state.has_window = value, t_ns, 1
    elif value > state.peak:
        state.peak = value
    return max(state.peak_before, state.peak)


def _rms(state: LimitState, t_ns: int, step_ns: int, x: list[float]) -> float | None:
    """Add a sample to its window. Return the value of the newest complete window; None without such a window."""
    if state.has_window and step_ns >= state.window_ns:
        state.has_window = 0  # a gap as long as the window
    if not state.has_window:
        state.value = inf
    if not state.has_window or t_ns - state.begin_ns >= state.window_ns:
        if state.has_window:
            total = 0.0
            for square, one in zip(state.squares, state.sums, strict=True):
                mean = 0.0 if state.has_band else one / state.number
                total += max(square / state.number - mean * mean, 0.0)
            state.value = state.scale * sqrt(total)
        state.begin_ns, state.number, state.has_window = t_ns, 0, 1
        state.sums, state.squares = [0.0] * AXES, [0.0] * AXES
    state.number += 1
    for axis, one in enumerate(x):
        state.sums[axis] += one
        state.squares[axis] += one * one
    return None if state.value == inf else state.value


def _follow_period(state: LimitState, t_ns: int, step_ns: int) -> bool:
    """Find gaps and measure the sample period. Return whether it is known for the first time or differs."""
    if state.period_ns > 0 and float(step_ns) > GAP_PERIODS * state.period_ns:
        state.measured_ns, state.measured, state.is_filtering = t_ns, 0, 0
        state.late += 1
        state.restarts += 1
        if state.late >= LATE_MAX:
            state.period_ns, state.designed, state.late = 0.0, 0, 0
        return False
    state.late = 0
    state.measured += step_ns > 0
    if state.measured < PERIOD_STEPS or t_ns - state.measured_ns < PERIOD_NS:
        return False
    mean_ns = float(t_ns - state.measured_ns) / float(state.measured)
    state.measured_ns, state.measured = t_ns, 0
    if state.period_ns > 0 and fabs(mean_ns - state.period_ns) <= PERIOD_CHANGE * state.period_ns:
        return False
    state.period_ns, state.designed = mean_ns, 0
    return True


def _filtered(state: LimitState, t_ns: int, x: list[float]) -> list[float]:
    """Return the filtered components (direct form II, transposed)."""
    memory, found = state.memory, []
    if not state.is_filtering:
        state.is_filtering, state.filter_ns, state.has_window, state.held_ns = 1, t_ns, 0, -1
        memory[:] = [0.0] * len(memory)
        for axis, one in enumerate(x):  # steady state of the first biquad; its output is 0
            memory[2 * SECTIONS * axis] = memory[2 * SECTIONS * axis + 1] = -(state.gains[0] * one)
    for axis, one in enumerate(x):
        at = 2 * SECTIONS * axis
        for gain, a1, a2 in zip(state.gains, state.a1, state.a2, strict=True):
            fed = gain * one
            out = fed + memory[at]
            memory[at] = memory[at + 1] - a1 * out
            memory[at + 1] = -fed - a2 * out
            one, at = out, at + 2  # noqa: PLW2901 - output of a biquad is the input of the next
        found.append(one)
    return found
