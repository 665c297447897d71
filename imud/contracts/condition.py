"""Condition of a device: one word for all views, with reasons and next steps (docs/views.md)."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from imud.model.options import Options
from imud.model.units import NS_PER_S


class Condition(StrEnum):
    """Condition of a device, the worst first."""

    MISSING = "missing"  # no samples arrive
    ATTENTION = "attention"  # the user must repair or decide something
    DEGRADED = "degraded"  # samples arrive, but not all or not as precise as expected
    OK = "ok"


class Section(StrEnum):
    """Section of the page of a device that shows the details of a reason."""

    LIVE = "live"
    TIME = "time"
    LEDGER = "ledger"
    SETTINGS = "settings"
    CALIBRATION = "calibration"
    EVENTS = "events"
    ABOUT = "about"


class ReasonCode(StrEnum):
    """Cause of a condition. Readers must accept unknown codes."""

    NO_PORT = "no-port"
    NO_DATA = "no-data"
    SEARCHING = "searching"
    NO_SAMPLES = "no-samples"  # data arrives, or the device replies, but no sample
    STOPPED = "stopped"
    FAILED = "failed"
    SETTING = "setting"
    UNSAVED = "unsaved"
    DECLINATION = "declination"
    ALARM = "alarm"
    GRAVITY = "gravity"
    AXES = "axes"
    LEDGER = "ledger"
    RESTARTS = "restarts"
    LINE = "line"
    SETTINGS_PROBLEM = "settings-problem"
    UTC = "utc"
    LOST = "lost"
    GAPS = "gaps"
    RATE = "rate"
    TIME_ERROR = "time-error"
    DEVICE_TIME = "device-time"  # the device time does not show lost samples
    LINK = "link"
    NONE_LOST = "none-lost"
    LOST_BEFORE = "lost-before"
    FINISHED = "finished"

    @classmethod
    def _missing_(cls, value: object) -> "ReasonCode | None":
        """Return the code of another version of imud; None if `value` is not a string."""
        if not isinstance(value, str):
            return None
        code = str.__new__(cls, value)
        code._name_ = code._value_ = value
        return code


MISSING: Final = frozenset((
    ReasonCode.NO_PORT, ReasonCode.NO_DATA, ReasonCode.SEARCHING, ReasonCode.NO_SAMPLES, ReasonCode.STOPPED,
    ReasonCode.FAILED,
))  # fmt: skip
DEGRADED: Final = frozenset((
    ReasonCode.LOST, ReasonCode.GAPS, ReasonCode.RATE, ReasonCode.TIME_ERROR, ReasonCode.DEVICE_TIME, ReasonCode.LINK,
))  # fmt: skip
OK: Final = frozenset((ReasonCode.NONE_LOST, ReasonCode.LOST_BEFORE, ReasonCode.FINISHED))


def condition_of(code: ReasonCode) -> Condition:
    """Return the condition that a reason causes."""
    if code in MISSING:
        return Condition.MISSING
    if code in DEGRADED:
        return Condition.DEGRADED
    return Condition.OK if code in OK else Condition.ATTENTION


DOCTOR: Final = "Run `sudo imud doctor`."
"""Next step of a reason for which `imud doctor` has the details."""


class Reason(msgspec.Struct, frozen=True):
    """Reason of a condition."""

    code: ReasonCode
    message: str  # one or two sentences
    next: str = ""  # next step of the user; empty if no step is necessary
    section: Section = Section.LIVE
    setting: str = ""  # name of the device setting; empty for other reasons


class DeviceCondition(msgspec.Struct, frozen=True):
    """Condition of a device with its reasons, the worst first."""

    condition: Condition
    since_ns: int  # CLOCK_MONOTONIC of the last change of `condition`, ns
    reasons: tuple[Reason, ...] = ()

    @property
    def is_ok(self) -> bool:
        return self.condition is Condition.OK

    @property
    def steps(self) -> str:
        """Different next steps of the reasons as one text; empty without a step."""
        return " ".join(dict.fromkeys(reason.next for reason in self.reasons if reason.next))

    def __str__(self) -> str:
        """Return the condition with its reasons as one text."""
        return f"{self.condition}: {' '.join(reason.message for reason in self.reasons)}".removesuffix(": ")


def signature(condition: DeviceCondition | None) -> frozenset[tuple[str, str]]:
    """Return the codes and settings of the reasons. The texts contain times that change each second."""
    reasons = condition.reasons if condition is not None else ()
    return frozenset((reason.code, reason.setting) for reason in reasons if reason.code not in OK)


class ConditionLimits(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of the conditions `attention` and `degraded`."""

    lost_percent: Annotated[float, Meta(ge=0, le=100)] = 0.1
    """Maximum share of lost samples in one minute, percent."""
    rate_percent: Annotated[float, Meta(gt=0, le=100)] = 2.0
    """Maximum deviation of the sample rate from the rate by the device time, percent."""
    t_err_ms: Annotated[float, Meta(gt=0)] | None = None
    """Maximum time stamp error, ms; null: no limit."""
    restarts: Annotated[int, Meta(ge=1, le=60)] = 3
    """Number of restarts of the device in one hour, without a request of imud, that needs attention."""
    begin_s: Annotated[float, Meta(ge=0, le=60)] = 5.0
    """Time from the cause of a reason to the reason, s."""
    end_s: Annotated[float, Meta(ge=0, le=3600)] = 60.0
    """Time from the end of a cause to the end of its reason, s."""


NAMES_SHOWN: Final = 5  # maximum number of device names in a summary


def summary(conditions: Mapping[str, Condition]) -> str:
    """Return the number of devices with a problem and their names, for example `All 5 devices are OK.`"""
    if not conditions:
        return "The configuration has no devices."
    bad = [f"{name} ({condition})" for name, condition in conditions.items() if condition is not Condition.OK]
    count = len(conditions)
    if not bad:
        return f"All {count} devices are OK." if count > 1 else "1 device is OK."
    more = f" and {len(bad) - NAMES_SHOWN} more" if len(bad) > NAMES_SHOWN else ""
    of_all = f"{len(bad)} of {count} devices" if count > 1 else "1 device"
    return f"{of_all} {'have' if len(bad) > 1 else 'has'} a problem: {', '.join(bad[:NAMES_SHOWN])}{more}."


def duration(span_ns: int) -> str:
    """Return a duration in its largest unit, for example `14 min`."""
    seconds = max(span_ns, 0) // NS_PER_S
    for unit, unit_s, below_s in (("s", 1, 120), ("min", 60, 7200), ("h", 3600, 172_800)):
        if seconds < below_s:
            return f"{seconds // unit_s} {unit}"
    return f"{seconds // 86_400} days"
