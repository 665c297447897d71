"""State of a clock's fit, arrivals and device time, with the ranges of all states of clocks (`imud.sampling.state`)."""

from collections.abc import Sequence
from itertools import pairwise
from math import isfinite
from typing import Any, Final

from imud.formats.state import (
    Extreme,
    Field,
    Flag,
    Integer,
    Items,
    Maybe,
    New,
    Present,
    Real,
    StateError,
    StateTable,
    member_of,
)
from imud.model.sample import Sync
from imud.model.units import NS_PER_S
from imud.sampling import arrival_fit, device_time, gaps, stamp_time
from imud.sampling.arrival_time import LinkDelay

# --- ranges ------------------------------------------------------------------------------------------------------

TIME_MAX_NS: Final = 1 << 61  # 73 years: sums and differences of two times stay in 64 bits
BEFORE_ALL_NS: Final = -(1 << 62)  # time stamp before the first sample, as in `SampleClock`
NS_MAX: Final = float(1 << 62)
_COUNT_MAX: Final = 1 << 53
_PERIOD_LEAST_NS: Final = 1e-3  # minimum of a measured period, ns: the quotient of a time and the period stays finite
_TICKS_LEAST: Final = 1e-6  # minimum of a measured period in ticks
_SPAN_MAX_NS: Final = 1 << 52  # maximum span of a fit: a float then distinguishes two ns

TIME: Final = Integer(BEFORE_ALL_NS, TIME_MAX_NS)  # host or device time, ns
COUNT: Final = Integer(0, _COUNT_MAX)
SIGNED: Final = Integer(-_COUNT_MAX, _COUNT_MAX)
TICKS: Final = Integer(0, _COUNT_MAX)
NS: Final = Real(-NS_MAX, NS_MAX)  # difference of two times, ns
NUMBER: Final = Real(-NS_MAX, NS_MAX)
SLOPE: Final = Real(0.9 * arrival_fit.SLOPE_LOWEST, 1.1 * arrival_fit.SLOPE_HIGHEST)
SLOPE_ERROR: Final = Real(0.0, 1e6)
HOLD: Final = Integer(0, NS_PER_S)
SYNC: Final = member_of(Sync)
SMALL: Final = Integer(0, 0xFF)

DERIVED: Final = "computed by `finish`"
CONSTRUCTOR: Final = "set by the constructor"
DAEMON: Final = "part of the daemon"


def expect_rising(times: Sequence[int], name: str) -> None:
    if any(after <= before for before, after in pairwise(times)):
        raise StateError(f"expected {name} in rising order")


# --- fit of arrivals ---------------------------------------------------------------------------------------------

_BIN: Final = StateTable(
    (
        Field(1, "begin_ns", TIME),
        Field(2, "device_ns", TIME),
        Field(3, "arrival_ns", TIME),
        Field(4, "lowest", NS),
        Field(5, "wait", NUMBER),
        Field(6, "wait_least", NS),
        Field(7, "wait_most", NS),
        Field(8, "count", Integer(1, _COUNT_MAX)),
        Field(9, "late", COUNT),
        Field(10, "late_ns", NUMBER),
    )
)


def _finish_fit(fit: Any) -> None:
    bins = fit._bins
    if not bins or bins[-1].device_ns - bins[0].device_ns > _SPAN_MAX_NS:
        raise StateError(f"expected at least one bin, and a span of at most {_SPAN_MAX_NS} ns")
    expect_rising([bin_.device_ns for bin_ in bins], "the device times of the bins")
    fit._open = bins[-1]
    # the next bin computes the hull again, with the same result
    fit._hull = []
    fit._hull_bins = 0


FIT: Final = StateTable(
    (
        Field(1, "_begin_ns", TIME),
        Field(2, "_bins", Items(New(_BIN, lambda _fit: arrival_fit._Bin(0, 0, 0.0, 0.0)), arrival_fit.BINS)),
        Field(3, "_pause_count", COUNT),
        Field(4, "_pause_ns", NS),
        Field(5, "_slope_known", SLOPE),
        Field(6, "_slope_known_error", SLOPE_ERROR),
        Field(7, "_width_ns", Integer(0, arrival_fit.BIN_LONGEST_NS)),
        Field(8, "count", Integer(1, _COUNT_MAX)),
        Field(9, "error_ns", NS),
        Field(10, "fitted_ns", TIME),
        Field(11, "hidden_ns", NS),
        Field(12, "hold_ns", HOLD),
        Field(13, "measured_hold_ns", HOLD),
        Field(14, "recent_ns", NS),
        Field(15, "ref_arrival_ns", TIME),
        Field(16, "ref_device_ns", TIME),
        Field(17, "residual_ns", NS),
        Field(18, "shift_ns", NS),
        Field(19, "slope", SLOPE),
        Field(20, "slope_error", SLOPE_ERROR),
        Field(21, "until_ns", TIME),
        Field(22, "wait_most", NS),
    ),
    {"_open": DERIVED, "_hull": DERIVED, "_hull_bins": DERIVED},
    _finish_fit,
)
NEW_FIT: Final = New(FIT, lambda _owner: arrival_fit.ArrivalFit(0, 0))

COUNTER_LINE: Final = StateTable(
    (
        Field(1, "_device_ns", TIME),
        Field(2, "_error_ns", NS),
        Field(3, "_fitted_ns", TIME),
        Field(4, "_host_ns", TIME),
        Field(5, "_slope_error", SLOPE_ERROR),
        Field(6, "slope", SLOPE),
    )
)

# --- arrivals ----------------------------------------------------------------------------------------------------

LINK_DELAY: Final = StateTable((Field(1, "byte_ns", HOLD), Field(2, "hold_ns", HOLD)))
DELAY: Final = New(LINK_DELAY, lambda _owner: LinkDelay(0, 0))

_PERIOD_NS: Final = Real(-NS_MAX, NS_MAX, _PERIOD_LEAST_NS)

SPREAD: Final = StateTable(
    (
        Field(1, "_last_ns", TIME),
        Field(2, "_spread", NS),
        Field(3, "_still", COUNT),
        Field(4, "period_ns", _PERIOD_NS),
    )
)


def _finish_even(even: Any) -> None:
    if even.fit is not None and even._period_ns <= 0:
        raise StateError("expected a period of the fitted arrivals above 0")


EVEN_ARRIVALS: Final = StateTable(
    (
        Field(1, "_above_mean", NS),
        Field(2, "_agreeing", COUNT),
        Field(3, "_arrival_ns", TIME),
        Field(4, "_begin_ns", TIME),
        Field(5, "_device_ns", TIME),
        Field(6, "_late_periods", SIGNED),
        Field(7, "_learned", COUNT),
        Field(8, "_period_ns", _PERIOD_NS),
        Field(9, "_undecided", COUNT),
        Field(10, "error_ns", NS),
        Field(11, "fit", Maybe(NEW_FIT)),
        Field(12, "t_ns", TIME),
    ),
    finish=_finish_even,
)


def _finish_pace(pace: Any) -> None:
    if pace._until_ns != pace._begin_ns + gaps.WINDOW_NS:
        raise StateError(f"expected a window of {gaps.WINDOW_NS} ns")
    if (pace.is_known or pace.period_ns) and pace.period_ns <= 0:
        raise StateError("expected a period of the arrivals above 0")
    if bool(pace._count) is not (isfinite(pace._least_ns) and isfinite(pace._most_ns)):
        raise StateError("expected the lateness of the frames of a window")


PACE: Final = StateTable(
    (
        Field(1, "_begin_ns", TIME),
        Field(2, "_count", COUNT),
        Field(3, "_due_ns", NS),
        Field(4, "_error", Real(0.0, 1e6)),
        Field(5, "_has_phase", Flag()),
        Field(6, "_least_ns", Extreme(-NS_MAX, NS_MAX)),
        Field(7, "_most_ns", Extreme(-NS_MAX, NS_MAX)),
        Field(8, "_off_ns", NS),
        Field(9, "_off_windows", COUNT),
        Field(10, "_steps", COUNT),
        Field(11, "_unjudged", COUNT),
        Field(12, "_until_ns", TIME),
        Field(13, "period_ns", _PERIOD_NS),
    ),
    {"_turn": CONSTRUCTOR},
    _finish_pace,
)

SAMPLE_NUMBER: Final = StateTable(
    (
        Field(1, "_arrival_ns", TIME),
        Field(2, "_number", COUNT),
        Field(3, "_pace", PACE),
        Field(4, "_was_known", Flag()),
        Field(5, "known", Flag()),
    ),
    {"_modulus": CONSTRUCTOR},
)

LOSSES: Final = StateTable(
    (
        Field(1, "_number", Present(SAMPLE_NUMBER)),
        Field(2, "_pace", Maybe(New(PACE, lambda _losses: gaps.ArrivalPace()))),
        Field(3, "missed", COUNT),
        Field(4, "resets", COUNT),
    ),
    {"_on_unknown_gap": DAEMON},
)

ARRIVAL_TIME: Final = StateTable(
    (
        Field(1, "_even", EVEN_ARRIVALS),
        Field(2, "_losses", LOSSES),
        Field(3, "delay", DELAY),
        Field(4, "error_ns", NS),
        Field(5, "missed", COUNT),
        Field(6, "spread", SPREAD),
    ),
    {"_numbered": CONSTRUCTOR},
)

# --- device time -------------------------------------------------------------------------------------------------


def _finish_period(period: Any) -> None:
    if period.period_ticks and period._count + period._even < _TICKS_LEAST:
        raise StateError("expected the number of steps of a known period")


PERIOD: Final = StateTable(
    (
        Field(1, "_before", Integer(-1, _COUNT_MAX)),
        Field(2, "_candidate", COUNT),
        Field(3, "_count", Real(0.0, _COUNT_MAX)),
        Field(4, "_even", COUNT),
        Field(5, "_high", Real(-_COUNT_MAX, _COUNT_MAX)),
        Field(6, "_low", Real(-_COUNT_MAX, _COUNT_MAX)),
        Field(7, "_odd_at", Real(-_COUNT_MAX, _COUNT_MAX)),
        Field(8, "_outside", Real(0.0, _COUNT_MAX)),
        Field(9, "_regular", COUNT),
        Field(10, "_run", COUNT),
        Field(11, "_run_sum", COUNT),
        Field(12, "_scatter", Real(0.0, device_time.SCATTERED_MOST)),
        Field(13, "_spacing", Real(-_COUNT_MAX, _COUNT_MAX)),
        Field(14, "_steady", Flag()),
        Field(15, "_sum", NUMBER),
        Field(16, "_uneven", Integer(0, device_time.CONSISTENT_LONGER - 1)),
        Field(17, "_uneven_sum", COUNT),
        Field(18, "_unjudged", Items(COUNT, device_time.UNJUDGED_MOST)),
        Field(19, "changes", COUNT),
        Field(20, "is_new", Flag()),
        Field(21, "period_ticks", Real(0.0, _COUNT_MAX, _TICKS_LEAST)),
        Field(22, "_owed", COUNT),
        Field(23, "is_late", Flag()),
    ),
    {"_on_unknown_gap": DAEMON, "_least": CONSTRUCTOR},
    _finish_period,
)

EXPECTED_RATE: Final = StateTable(
    (
        Field(1, "_until_ns", TIME),
        Field(2, "steps", Items(SIGNED, gaps.LONGER_MOST)),
    )
)


def _finish_time(time: Any) -> None:
    if time.change.steps and not time.period.period_ticks:
        raise StateError("expected a known period for steps without a decision")


DEVICE_TIME: Final = StateTable(
    (
        Field(1, "_even_for", COUNT),
        Field(2, "_gap", SIGNED),
        Field(3, "_phase_ns", NS),
        Field(4, "_shift_ns", NS),
        Field(5, "_step_ns", TIME),
        Field(6, "_unsettled", COUNT),
        Field(7, "_unsure_ns", NS),
        Field(8, "change", EXPECTED_RATE),
        Field(9, "doubt_ns", NS),
        Field(10, "even_ns", TIME),
        Field(11, "missed", COUNT),
        Field(12, "period", PERIOD),
        Field(13, "raw_ns", TIME),
        Field(14, "rephased", Flag()),
        Field(15, "ticks", TICKS),
        Field(16, "uneven", Flag()),
        Field(17, "watched", Integer(0, device_time.WATCHED)),
        Field(18, "_open", COUNT),
        Field(19, "missed_before", COUNT),
    ),
    {"modulus": CONSTRUCTOR, "tick_ns": CONSTRUCTOR},
    _finish_time,
)

JUMP: Final = StateTable(
    (
        Field(1, "first_step_ns", TIME),
        Field(2, "_since_ns", TIME),
        Field(3, "late_reads", COUNT),
    )
)

STAMP_TIME: Final = StateTable(
    (
        Field(1, "_arrival_ns", TIME),
        Field(2, "_foreign_since_ns", TIME),
        Field(3, "_foreign_ticks", Maybe(TICKS)),
        Field(4, "_live_arrival_ns", TIME),
        Field(5, "_live_ticks", SIGNED),
        Field(6, "_lowest_ns", NS),
        Field(7, "_origin_ns", TIME),
        Field(8, "_pulsed", Flag()),
        Field(9, "_stamp", Integer(-1, _COUNT_MAX)),
        Field(10, "_stuck", COUNT),
        Field(11, "_ticks", SIGNED),
        Field(12, "before", Integer(0, stamp_time.WRAP - 1)),
        Field(13, "in_use", Flag()),
    ),
    {"_modulus": CONSTRUCTOR},
)
