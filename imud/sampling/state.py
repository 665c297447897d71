"""State of clocks and paths: the only description of the values that a recording stores and restores.

A replay creates path, codec and clock with their constructors, from the rows of imud's own registries. Then it loads
these values. Each range keeps later computations safe: no division by zero, no infinite number, no list without a
limit, and no time so far away that a difference leaves 64 bits. `finish` functions compare values with each other.

Increment REVISION after a change of an algorithm in `imud.sampling` or in a codec: with the state of another revision,
a replay would continue with other results.
"""

from math import hypot, isnan
from typing import Any, Final

import msgspec

from imud.contracts.lines import Edge
from imud.formats.slot import decode_slots
from imud.formats.state import (
    CodecState,
    Field,
    Flag,
    Integer,
    Items,
    Maybe,
    New,
    Present,
    Real,
    Row,
    StateError,
    StateTable,
    decode_state,
    encode_state,
)
from imud.host.clock import PAIRS_MOST, SteadyTime
from imud.model.sample import T_ERR_MOST, Position, Sample
from imud.model.units import NS_PER_S
from imud.sampling import arrival_fit, gaps
from imud.sampling.aiding_state import AIDING, HOLDOVER, SLEW
from imud.sampling.fit_state import (
    ARRIVAL_TIME,
    CONSTRUCTOR,
    COUNT,
    COUNTER_LINE,
    DAEMON,
    DELAY,
    DERIVED,
    DEVICE_TIME,
    JUMP,
    NEW_FIT,
    NS,
    NUMBER,
    SIGNED,
    SMALL,
    STAMP_TIME,
    SYNC,
    TIME,
    TIME_MAX_NS,
    expect_rising,
)
from imud.sampling.path import KEPT, CanPath, PolledPath, SamplePath, StreamPath
from imud.sampling.steering import Holdover

REVISION: Final = 1  # revision of the algorithms that continue from a state

# --- samples -----------------------------------------------------------------------------------------------------


class _Component:
    """A component of a vector; NaN if the device does not send it (NMEA 2000)."""

    def save(self, value: Any, owner: Any) -> Any:
        """Return the number; None if it is NaN."""
        return None if isnan(value) else NUMBER.save(value, owner)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the number."""
        return float("nan") if saved is None else NUMBER.load(saved, current, owner)


_POSITION: Final = Row(NUMBER, NUMBER, Maybe(NUMBER), Maybe(SMALL), Maybe(SMALL), make=Position)
_VECTOR: Final = Maybe(Row(_Component(), _Component(), _Component()))
# members of a sample after the name of the device, in their order
_MEMBERS: Final = Row(
    COUNT, TIME, Integer(0, T_ERR_MOST), SYNC, TIME, Integer(-(1 << 63), (1 << 63) - 1), Maybe(TIME),
    _VECTOR, _VECTOR, _VECTOR, Maybe(Row(NUMBER, NUMBER, NUMBER, NUMBER)), _VECTOR,
    Maybe(NUMBER), Maybe(NUMBER), Maybe(Row(NUMBER, NUMBER)), Maybe(COUNT), Maybe(COUNT), Maybe(COUNT),
    _VECTOR, Maybe(_POSITION), Maybe(NUMBER), Maybe(TIME),
)  # fmt: skip


class _SampleType:
    """A sample of the device of the path. The state does not contain the name of the device."""

    def save(self, value: Any, owner: Any) -> Any:
        """Return the members of the sample after its name."""
        return _MEMBERS.save(msgspec.structs.astuple(value)[1:], owner)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the sample."""
        return Sample(owner._device, *_MEMBERS.load(saved, current, owner))


class _HeldSamples:
    """The samples that a path holds: slots of the kernel and samples. They become samples."""

    def save(self, value: Any, owner: Any) -> Any:
        """Return a list of samples."""
        samples: list[Sample] = []
        for held in value:
            samples += decode_slots(held, owner._device) if isinstance(held, bytes) else [held]
        return _HELD.save(samples, owner)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the list of the path with the samples."""
        return _HELD.load(saved, current, owner)


HELD_MAX: Final = 4096  # maximum number of samples that a path holds: 4 s at 1 kHz, more than the maximum latency
SAMPLE: Final = _SampleType()
_HELD: Final = Items(SAMPLE, HELD_MAX)

# --- host clock --------------------------------------------------------------------------------------------------


def _finish_steady(steady: Any) -> None:
    times, offsets, even = steady._steady, steady._offsets, steady._even
    if len(times) != len(offsets) or not 0 <= even < max(len(times), 1):
        raise StateError("expected the same number of times and offsets, and the index of one of them")
    steady._monotonic[:] = [time + offset for time, offset in zip(times, offsets, strict=True)]
    for readings in (times, steady._monotonic):
        expect_rising(readings, "readings of the host clocks")
    if times:
        steady.offset_ns = offsets[-1]
        steady.even_from_ns = times[even]


STEADY: Final = StateTable(
    (
        Field(1, "_base_ns", TIME),
        Field(2, "_steady", Items(TIME, PAIRS_MOST)),
        Field(3, "_offsets", Items(TIME, PAIRS_MOST)),
        Field(4, "_even", COUNT),
    ),
    {"_monotonic": DERIVED, "even_from_ns": DERIVED, "offset_ns": DERIVED},
    _finish_steady,
)

# --- clock -------------------------------------------------------------------------------------------------------

_NEW_LINE: Final = New(COUNTER_LINE, lambda _clock: gaps.CounterLine(arrival_fit.ArrivalFit(0, 0), 0.0))

CLOCK: Final = StateTable(
    (
        Field(1, "_aiding", Maybe(New(AIDING, lambda clock: clock._make_aiding()))),
        Field(2, "_arrivals", ARRIVAL_TIME),
        Field(3, "_delay", DELAY),
        Field(4, "_error_ns", NS),
        Field(5, "_fit", Maybe(NEW_FIT)),
        Field(6, "_fit_begin_ns", TIME),
        Field(7, "_fit_bias_ns", NS),
        Field(8, "_fit_error_ns", NS),
        Field(9, "_fit_sync", SYNC),
        Field(10, "_holdover", Maybe(New(HOLDOVER, lambda _clock: Holdover(0, 0, 0.0, 0)))),
        Field(11, "_jump", JUMP),
        Field(12, "_known", Flag()),
        Field(13, "_line", Maybe(_NEW_LINE)),
        Field(14, "_own_status", Maybe(COUNT)),
        Field(15, "_resets", COUNT),
        Field(16, "_seq", COUNT),
        Field(17, "_slew", SLEW),
        Field(18, "_stamps", Present(STAMP_TIME)),
        Field(19, "_sync", SYNC),
        Field(20, "_t_err_ns", Integer(0, T_ERR_MOST)),
        Field(21, "_t_ns", TIME),
        Field(22, "_t_rx_ns", TIME),
        Field(23, "_time", DEVICE_TIME),
        Field(24, "missed", COUNT),
        Field(25, "waited_ns", Integer(0, TIME_MAX_NS)),
    ),
    {
        "_device": CONSTRUCTOR, "_host": DAEMON, "_make_aiding": CONSTRUCTOR, "_on_unknown_gap": DAEMON,
        "_run": "settled before", "observer": DAEMON,
    },
)  # fmt: skip

# --- attitude of the host ----------------------------------------------------------------------------------------


class _FilterState:
    """State of the filter of vqf: booleans, numbers, and lists of numbers, by the names of the installed version. The
    library ends the process for a list of another length."""

    def save(self, value: Any, owner: Any) -> Any:
        """Return the state. None stands for NaN: a low-pass filter without a value."""
        return {name: _without_nan(item) for name, item in value.items()}

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return a state with the names, types and lengths of the state of a new filter."""
        new = owner.filter_state()
        if type(saved) is not dict or saved.keys() != new.keys():
            raise StateError("expected the state of an attitude filter of the installed vqf, got another state")
        state = {name: _filter_value(name, saved[name], item, owner) for name, item in new.items()}
        for name in _ROTATIONS:
            _expect_rotation(state.get(name))
        return state


def _without_nan(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if value != value else value  # noqa: PLR0124 - only NaN differs from itself


def _filter_value(name: str, saved: Any, new: Any, owner: Any) -> Any:
    if isinstance(new, list):
        if type(saved) is not list or len(saved) != len(new):
            raise StateError(f"{name}: expected {len(new)} values")
        return [_filter_value(name, item, new_item, owner) for item, new_item in zip(saved, new, strict=True)]
    if type(new) is bool:
        return Flag().load(saved, new, owner)
    if saved is None and _LOW_PASS in name:
        return float("nan")
    return float(_FILTER_NUMBER.load(saved, new, owner))


def _expect_rotation(quat: Any) -> None:
    if quat is not None and not 1 - _NORM_ERROR < hypot(*quat) < 1 + _NORM_ERROR:
        raise StateError("expected a quaternion of length 1")


_FILTER_NUMBER: Final = Real(-1e12, 1e12)  # numbers, variances and counts of the filter
# PERIOD_MAX_NS and BLOCK - 1 of `imud.sampling.attitude`, which a daemon without `attitude: host` does not import
FILTER_PERIOD_MAX_NS: Final = NS_PER_S
INTERVALS_MAX: Final = 31
_ROTATIONS: Final = ("gyrQuat", "accQuat")  # names of quaternions
_NORM_ERROR: Final = 0.01  # maximum error of the length of a quaternion
_LOW_PASS: Final = "LpState"  # part of the names of low-pass filters, whose state starts with NaN


def _finish_attitude(host_attitude: Any) -> None:
    _expect_rotation(host_attitude._turn)
    host_attitude.resume()


ATTITUDE: Final = StateTable(
    (
        Field(1, "_period_ns", Integer(1, FILTER_PERIOD_MAX_NS)),
        Field(2, "_started_ns", TIME),
        Field(3, "_newest_ns", Maybe(TIME)),
        Field(4, "_intervals_ns", Items(TIME, INTERVALS_MAX)),
        Field(5, "_settled", Flag()),
        Field(6, "_bias", Row(_FILTER_NUMBER, _FILTER_NUMBER, _FILTER_NUMBER)),
        Field(7, "_yaw_rad", _FILTER_NUMBER),
        Field(8, "_turn", Maybe(Row(NUMBER, NUMBER, NUMBER, NUMBER))),
        Field(9, "saved", _FilterState()),
    ),
    {"_array": CONSTRUCTOR, "_filter": "`saved`", "_from_up": CONSTRUCTOR, "_to_euler": CONSTRUCTOR},
    _finish_attitude,
)

# --- paths -------------------------------------------------------------------------------------------------------

LOSS: Final = StateTable((Field(1, "bad_frames", COUNT), Field(2, "_overruns_seen", COUNT)), {"_ledger": DAEMON})

_COMMON: Final = (
    Field(1, "clock", CLOCK),
    Field(2, "codec", CodecState()),
    Field(3, "loss", LOSS),
    Field(4, "_newest", Maybe(SAMPLE)),
    Field(5, "begun_ns", TIME),
    Field(6, "last_data_ns", TIME),
    Field(7, "last_sample_ns", TIME),
    Field(8, "_begun_samples", COUNT),
    Field(9, "_frame_ns", Integer(0, NS_PER_S)),
    Field(10, "attitude", Present(ATTITUDE)),
)
_COMMON_OTHER: Final = {
    **dict.fromkeys(("_device", "_device_id", "frame", "_changes"), CONSTRUCTOR),
    **dict.fromkeys(
        ("_ledger", "_publish", "_on_message", "_on_bad_frame", "_overruns", "_now_ns", "_utc_offset_ns", "observer"),
        DAEMON,
    ),
    **dict.fromkeys(("latency", "_status_mask", "_status_seen"), "statistics"),
}

STREAM_PATH: Final = StateTable(
    (*_COMMON, Field(20, "gathered", _HeldSamples())),
    {**_COMMON_OTHER, "_listener": DAEMON, "_drain_edges": DAEMON, "_start_run": CONSTRUCTOR},
)
CAN_PATH: Final = StateTable((*_COMMON, Field(20, "_idle_ns", TIME)), _COMMON_OTHER)

READY_EDGES: Final = StateTable(
    (
        Field(1, "missed", COUNT),
        Field(2, "interval_ns", Integer(1, TIME_MAX_NS)),
        Field(3, "_edges", Items(Row(TIME, Flag(), SIGNED, make=Edge), KEPT)),
        Field(4, "_newest", Maybe(Row(TIME, Flag(), SIGNED, make=Edge))),
        Field(5, "_read", Maybe(SIGNED)),
    ),
    {"observer": DAEMON, "_offset_ns": CONSTRUCTOR, "_error_ns": CONSTRUCTOR},
)
POLLED_PATH: Final = StateTable(
    (
        *_COMMON,
        Field(20, "failed", COUNT),
        Field(21, "edges", Present(READY_EDGES)),
        Field(22, "_interval_ns", TIME),
        Field(23, "_before_ns", TIME),
        Field(24, "_faults", COUNT),
        Field(25, "_read_ns", TIME),
        Field(26, "_is_back", Flag()),
        Field(27, "_gap_unknown", Flag()),
    ),
    {**_COMMON_OTHER, "_period_ns": CONSTRUCTOR, "_update_ns": CONSTRUCTOR},
)
PATHS: Final = {StreamPath: STREAM_PATH, CanPath: CAN_PATH, PolledPath: POLLED_PATH}


def save_path(path: SamplePath) -> bytes:
    """Return the state of a path with its codec and clock. Raises StateError."""
    path.clock.settle()
    if path.attitude is not None:
        path.attitude.save()
    _ = path.newest  # decodes the slots of the kernel
    return encode_state(REVISION, PATHS[type(path)].save(path))


def load_path(path: SamplePath, state: bytes) -> None:
    """Continue from the state of a path. Do not use the path after a StateError."""
    PATHS[type(path)].load(decode_state(REVISION, state), path)


def save_steady(steady: SteadyTime) -> bytes:
    """Return the state of the steady time of a host. Raises StateError."""
    return encode_state(REVISION, STEADY.save(steady))


def load_steady(steady: SteadyTime, state: bytes) -> None:
    """Continue from the state of the steady time of a host. Do not use it after a StateError."""
    STEADY.load(decode_state(REVISION, state), steady)
