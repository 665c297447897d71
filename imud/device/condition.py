"""Condition of one device: reasons from a few facts, with hysteresis, and counts of the last minute.

Facts ──▶ causes_of (RULES) ──▶ ConditionWatch (begins after 5 s, ends after 60 s) ──▶ event
                                      └──▶ sentences, if the condition changes or a client requests them
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.condition import (
    DOCTOR,
    MISSING,
    OK,
    Condition,
    ConditionLimits,
    DeviceCondition,
    Reason,
    ReasonCode,
    Section,
    condition_of,
    duration,
)
from imud.contracts.setting import SettingDifference, SettingsState, SettingsStatus, title_of, value_text
from imud.contracts.status import DeviceState, FrameProblem, LinesStatus, RecentStatus
from imud.device.health import NO_SAMPLE, SEARCH_BEGUN, DeviceEvents
from imud.links.serial_port import list_ports
from imud.model.event import EventKind
from imud.model.ledger import LOST_FIELDS, Ledger, counters_of
from imud.model.units import NS_PER_MS, NS_PER_S

MINUTE_NS: Final = 60 * NS_PER_S

# Reasons that end immediately with their cause. Only the user or a new start of the samples ends these causes, so that
# the reasons do not flicker.
ENDS_AT_ONCE: Final = frozenset((*MISSING, *OK, ReasonCode.SETTING, ReasonCode.UNSAVED, ReasonCode.DECLINATION))


@dataclass(frozen=True, slots=True)
class ConfiguredPort:
    """Port of a device in its configuration."""

    port: str  # for example `/dev/ttyUSB0`
    key: str  # key of the configuration, for example `uart.port`
    is_serial: bool  # whether the port is a serial port of this host
    others: Callable[[], Sequence[str]]  # returns the serial ports of this host


class LossCause(NamedTuple):
    """Words about lost samples of one cause."""

    present: str
    past: str
    next: str


LESS_LOAD: Final = "Reduce the load of this host, or use a lower rate."
LOSSES: Final[Mapping[str, LossCause]] = {
    "crc": LossCause(
        "because frames are damaged", "because frames were damaged",
        "Check the cable, its length and its ground. If they are correct, use a lower bit rate.",
    ),
    "gap_device": LossCause(
        "before they reach this host", "before they reached this host",
        "Use a lower output rate or a higher bit rate of the device.",
    ),
    "overrun": LossCause("in kernel buffer overruns", "in a kernel buffer overrun", LESS_LOAD),
    "queue": LossCause("because imud is too late", "because imud was too late", LESS_LOAD),
}  # fmt: skip


class Facts(msgspec.Struct, kw_only=True):
    """Facts of a device at one moment that its condition depends on. The properties are words for sentences."""

    now_ns: int
    state: DeviceState
    problem: str
    place: ConfiguredPort
    recent: RecentStatus
    is_polled: bool = False
    declared: SettingsStatus | None = None  # None if the settings cannot cause a reason
    axes: FrameProblem | None = None  # kind of the contradiction in axes, angles or heading
    axes_problem: str = ""  # text of this contradiction
    lines: LinesStatus | None = None
    has_scattered_time: bool = False  # whether the device time does not show lost samples
    utc_problem: str = ""
    open_bytes: int = 0  # bytes and frames that the ledger does not account for
    open_frames: int = 0
    rate_hz: float | None = None  # as in `RecentStatus`
    expected_rate_hz: float = 0.0
    t_err_ns: int = 0  # 0 if the time stamp error has no limit

    @property
    def lost_percent(self) -> float:
        lost = sum(self.recent.lost.values())
        return 100 * lost / (lost + self.recent.samples) if lost else 0.0

    @property
    def cause(self) -> LossCause:
        """Largest cause of the losses in the last minute."""
        return LOSSES[max(self.recent.lost, key=lambda name: self.recent.lost[name])]

    def ago(self, t_ns: int) -> str:
        """Return the time since `t_ns`."""
        return f"{duration(self.now_ns - t_ns)} ago"


class Rule(NamedTuple):
    """Rule for a reason: the test whether the reason holds, and the sentences for the user."""

    code: ReasonCode
    section: Section
    # Returns whether the reason holds, or the values for which it holds by name (`Reason.setting`)
    holds: Callable[[Facts, ConditionLimits], bool | Mapping[str, Any]]
    message: str | Callable[[Facts, str, Any], str]  # text, or function of the facts, the name and the value
    next: str | Callable[[Facts, str, Any], str] = ""


class Cause(NamedTuple):
    """Present cause of a reason. The sentences are made on request."""

    rule: Rule
    facts: Facts
    setting: str = ""
    value: Any = None

    def reason(self) -> Reason:
        """Return the reason with its sentences."""
        rule, known = self.rule, (self.facts, self.setting, self.value)
        message, step = (one if isinstance(one, str) else one(*known) for one in (rule.message, rule.next))
        return Reason(rule.code, message, step, rule.section, self.setting)


def causes_of(facts: Facts, limits: ConditionLimits) -> list[Cause]:
    """Return the present causes, without hysteresis. The last cause of a device with samples has the condition ok."""
    if facts.state is not DeviceState.RUNNING:
        return [next(Cause(rule, facts) for rule in RULES_WITHOUT_SAMPLES if rule.holds(facts, limits))]
    causes = []
    for rule in RULES:
        if found := rule.holds(facts, limits):
            values = {"": None} if isinstance(found, bool) else found
            causes += [Cause(rule, facts, name, value) for name, value in values.items()]
    return causes


def sentence(problem: str) -> str:
    """Return a problem as a sentence."""
    first, _, rest = problem.partition(" ")
    if first.isalpha() and first.islower() and first != "imud":
        first = first.capitalize()
    text = f"{first} {rest}".strip() or "The reason is not known"
    return text if text.endswith((".", "?", "!")) else f"{text}."


# --- a device without samples: the first rule that holds --------------------------------------------------------------


def _problem(facts: Facts, _name: str, _value: Any) -> str:
    return sentence(facts.problem)


def _stopped(facts: Facts, _name: str, _value: Any) -> str:
    last_ns = facts.recent.last_sample_ns
    return f"The device stopped sending {facts.ago(last_ns) if last_ns else 'some time ago'}. Its port still exists."


def _gets_no_data(facts: Facts, _limits: ConditionLimits) -> bool:
    if facts.state is DeviceState.MISSING:  # the port is not checked yet
        return False
    has_reply = facts.is_polled or facts.problem.startswith(("it replies", SEARCH_BEGUN))
    return not facts.recent.bytes_in and not has_reply


def _has_no_port(facts: Facts, _limits: ConditionLimits) -> bool:
    return facts.state is DeviceState.MISSING and bool(facts.problem)


def _wires(facts: Facts, _name: str, _value: Any) -> str:
    on_bus = "check the wires and the bit rate of the bus"
    return f"Check the power supply, and {'check that TX and RX are not swapped' if facts.place.is_serial else on_bus}."


RULES_WITHOUT_SAMPLES: Final = (
    Rule(
        ReasonCode.FINISHED, Section.LIVE, lambda f, _: f.state is DeviceState.FINISHED,
        lambda f, *_: f"The replay is at its end. {sentence(f.problem) if f.problem else ''}".rstrip(),
    ),
    Rule(
        ReasonCode.NO_PORT, Section.ABOUT, lambda f, limits: _has_no_port(f, limits) and f.place.is_serial,
        lambda f, *_: f"The port {f.place.port} does not exist.",
        lambda f, *_: f"Plug in the cable, or correct {f.place.key} in the configuration. "
                      f"Ports on this host: {', '.join(f.place.others()) or 'none'}.",
    ),
    Rule(
        ReasonCode.STOPPED, Section.ABOUT,
        lambda f, _: f.state is DeviceState.SILENT and f.problem.startswith(NO_SAMPLE), _stopped,
        "Check the power supply and the connector.",
    ),
    Rule(ReasonCode.FAILED, Section.ABOUT, lambda f, _: f.state is DeviceState.FAILED, _problem, DOCTOR),
    Rule(ReasonCode.NO_PORT, Section.ABOUT, _has_no_port, _problem, DOCTOR),
    Rule(ReasonCode.NO_DATA, Section.ABOUT, _gets_no_data, lambda f, *_: f"No data arrives at {f.place.port}.", _wires),
    Rule(
        ReasonCode.SEARCHING, Section.LIVE, lambda f, _: f.problem in ("", SEARCH_BEGUN),
        lambda f, *_: f"imud searches for the device at {f.place.port}.", "Wait for the search.",
    ),
    Rule(ReasonCode.NO_SAMPLES, Section.ABOUT, lambda _f, _: True, _problem, DOCTOR),
)  # fmt: skip


# --- a device with samples: all rules that hold -----------------------------------------------------------------------


def _differs(_facts: Facts, name: str, one: SettingDifference) -> str:
    actual = "not known" if one.actual is None else f"“{value_text(one.actual)}”"
    return f"{title_of(name)} is {actual} on the device, but “{value_text(one.declared)}” in the configuration."


def _unsaved(_facts: Facts, name: str, value: Any) -> str:
    what = f"{title_of(name)} “{value_text(value)}”" if name else "A change"
    return f"{what} is lost at power-off because it is not saved."


def _ledger(facts: Facts, _name: str, _value: Any) -> str:
    count = f"{facts.open_bytes} bytes" if facts.open_bytes else f"{facts.open_frames} frames"
    return f"The ledger does not balance: {count}."


def _lost(facts: Facts, _name: str, _value: Any) -> str:
    percent = facts.lost_percent
    return f"{percent:.{1 if percent >= 1 else 2}f} % of the samples are lost {facts.cause.present}."


RATE_WINDOW_NS: Final = 10 * NS_PER_S  # time over which imud measures the rate, ns
SHORT_NS: Final = 2 * NS_PER_S  # time of the rate in the status, ns: two samples of a device at 1 Hz
RATE_SAMPLES: Final = 2  # deviation that the start and the end of the window can cause, samples


def _has_other_rate(facts: Facts, limits: ConditionLimits) -> bool:
    rate_hz, expected_hz = facts.rate_hz, facts.expected_rate_hz
    if rate_hz is None or not expected_hz:
        return False
    tolerance_hz = max(limits.rate_percent / 100 * expected_hz, RATE_SAMPLES * NS_PER_S / RATE_WINDOW_NS)
    return abs(rate_hz - expected_hz) > tolerance_hz


def _rate(facts: Facts, _name: str, _value: Any) -> str:
    rates = (f"{one:.1f}".removesuffix(".0") for one in (facts.rate_hz or 0.0, facts.expected_rate_hz))
    return "The device sends {} samples per second instead of {}.".format(*rates)


def _lost_before(facts: Facts, _name: str, _value: Any) -> str:
    recent, count = facts.recent, facts.recent.loss_samples
    what = f"{count} sample{'s were' if count != 1 else ' was'} lost" if count else "Samples were lost"
    cause = f" {LOSSES[recent.loss_cause].past}" if recent.loss_cause else ""
    return f"{what} {facts.ago(recent.loss_ns)}{cause}. No sample was lost after that."


RULES: Final = (
    Rule(
        ReasonCode.SETTING, Section.SETTINGS,
        lambda f, _: f.declared is not None and f.declared.state is SettingsState.DIFFER and f.declared.differences,
        _differs, "Apply the declared value, or change the configuration.",
    ),
    Rule(
        ReasonCode.UNSAVED, Section.SETTINGS,
        lambda f, _: f.declared is not None and f.declared.unsaved and (f.declared.lost_at_power_off or True),
        _unsaved, "Save the settings to the device's flash.",
    ),
    Rule(
        ReasonCode.SETTINGS_PROBLEM, Section.SETTINGS,
        lambda f, _: {"": f.declared.problem} if f.declared is not None and f.declared.problem else False,
        lambda _f, _, problem: sentence(problem), "Run `imud settings` with the name of the device.",
    ),
    Rule(
        ReasonCode.DECLINATION, Section.CALIBRATION, lambda f, _: f.axes is FrameProblem.DECLINATION,
        lambda f, *_: f"{f.axes_problem}.",
        lambda f, *_: ("Calibrate the magnetometer, or remove" if "power-on" in f.axes_problem else "Remove")
                      + " declination_deg from the configuration.",
    ),
    Rule(
        ReasonCode.GRAVITY, Section.ABOUT, lambda f, _: f.axes is FrameProblem.GRAVITY,
        "The measured gravity does not match the attitude.", lambda f, *_: sentence(f.axes_problem),
    ),
    Rule(
        ReasonCode.AXES, Section.SETTINGS, lambda f, _: f.axes is FrameProblem.AXES,
        lambda f, *_: sentence(f.axes_problem), DOCTOR,
    ),
    Rule(
        ReasonCode.ALARM, Section.LIVE, lambda f, _: f.lines is not None and bool(f.lines.alarm),
        "The ALARM pin is active.", "Compare the measured values with the limits of the device (docs/lines.md).",
    ),
    Rule(
        ReasonCode.LINE, Section.ABOUT, lambda f, _: f.lines is not None and f.lines.problems,
        lambda _f, name, problem: f"Line {name}: {problem}.", DOCTOR,
    ),
    Rule(
        ReasonCode.UTC, Section.TIME, lambda f, _: bool(f.utc_problem), lambda f, *_: sentence(f.utc_problem), DOCTOR
    ),
    Rule(
        ReasonCode.LEDGER, Section.LEDGER, lambda f, _: bool(f.open_bytes or f.open_frames), _ledger,
        "Report this fault of imud with the output of `imud status --json`.",
    ),
    Rule(
        ReasonCode.RESTARTS, Section.EVENTS, lambda f, limits: f.recent.restarts >= limits.restarts,
        lambda f, *_: f"The device restarted {f.recent.restarts} times in the last hour.",
        "Measure the supply voltage at the device.",
    ),
    Rule(
        ReasonCode.LOST, Section.LEDGER, lambda f, limits: bool(f.recent.lost) and f.lost_percent > limits.lost_percent,
        _lost, lambda f, *_: f.cause.next,
    ),
    Rule(
        ReasonCode.GAPS, Section.LEDGER, lambda f, _: f.recent.gaps > 0,
        lambda f, *_: f"Samples are lost in {f.recent.gaps} gap{'s' * (f.recent.gaps > 1)} of unknown size "
                      "in the last minute.",
        DOCTOR,
    ),
    Rule(
        ReasonCode.RATE, Section.SETTINGS, _has_other_rate, _rate,
        "Compare the output rate in the settings of the device with its bit rate.",
    ),
    Rule(
        ReasonCode.TIME_ERROR, Section.TIME,
        lambda f, limits: limits.t_err_ms is not None and f.t_err_ns / NS_PER_MS > limits.t_err_ms,
        lambda f, *_: f"The time stamp error is ±{f.t_err_ns / NS_PER_MS:.2g} ms.",
        "Connect SOUT, or reduce the latency timer.",
    ),
    Rule(
        ReasonCode.DEVICE_TIME, Section.TIME, lambda f, _: f.has_scattered_time,
        "The device time scatters: imud cannot count lost samples.", DOCTOR,
    ),
    Rule(ReasonCode.LINK, Section.ABOUT, lambda f, _: bool(f.problem), _problem, DOCTOR),
    # the condition ok: one of these rules always holds
    Rule(ReasonCode.LOST_BEFORE, Section.LEDGER, lambda f, _: f.recent.loss_ns > 0, _lost_before),
    Rule(
        ReasonCode.NONE_LOST, Section.LEDGER, lambda f, _: not f.recent.loss_ns,
        lambda f, *_: f"No sample was lost since imud started {f.ago(f.recent.begun_ns)}.",
    ),
)  # fmt: skip


NUMBER_RULES: Final = tuple(rule for rule in RULES if rule.code in (ReasonCode.RATE, ReasonCode.TIME_ERROR))
"""Rules for facts that change in each second."""


# --- counts of the last minute ----------------------------------------------------------------------------------------

_LOST: Final = counters_of(LOST_FIELDS)
CAUSES: Final = tuple(name.removeprefix("lost_") for name in LOST_FIELDS)
HOUR_NS: Final = 60 * MINUTE_NS
STEADY: Final = 0.01  # maximum change of the expected rate within the window of a rate, as a share
RESTARTS_MAX: Final = 60  # maximum number of stored restarts, as in `ConditionLimits.restarts`
_Lost = tuple[int, ...]  # in the order of CAUSES


def _by_cause(before: _Lost, after: _Lost) -> dict[str, int]:
    """Return the numbers of samples lost between two counts, without causes with no loss."""
    if before == after:
        return {}
    return {name: now - then for name, then, now in zip(CAUSES, before, after, strict=True) if now > then}


class _Second(NamedTuple):
    t_ns: int
    samples: int
    bytes_in: int
    lost: _Lost


class RecentCounts:
    """Counts of a device in the last minute and restarts in the last hour. Synchronization: the loop's thread only."""

    def __init__(self, ledger: Ledger, begun_ns: int, *, timed: bool) -> None:
        """`timed`: the device sends in real time. A replay can be faster, so its rate is not known."""
        self._ledger = ledger
        self._begun_ns = begun_ns
        self._timed = timed
        self._seconds: deque[_Second] = deque([self._present(begun_ns)], maxlen=64)
        self._steady: deque[_Second] = deque()  # seconds with the same expected rate and without a gap of unknown size
        self._steady_hz = 0.0  # expected rate at the start of `_steady`
        self._restarts: deque[int] = deque(maxlen=RESTARTS_MAX)
        self._resets = 0
        self._loss: dict[str, int] = {}  # number of samples in the last loss by cause
        self._loss_ns = 0

    def _present(self, now_ns: int) -> _Second:
        ledger = self._ledger
        return _Second(now_ns, ledger.samples, ledger.bytes_in, _LOST(ledger))

    def add(self, now_ns: int, rate_hz: float, resets: int) -> None:
        """Add the present counts. `rate_hz`: expected rate, 0 if the device does not run; `resets`: own restarts."""
        second, seconds, steady = self._present(now_ns), self._seconds, self._steady
        if lost := _by_cause(seconds[-1].lost, second.lost):
            self._loss = {} if now_ns - self._loss_ns > MINUTE_NS else self._loss
            self._loss_ns = now_ns
            for name, count in lost.items():
                self._loss[name] = self._loss.get(name, 0) + count
        seconds.append(second)
        _forget(seconds, now_ns - MINUTE_NS)
        if abs(rate_hz - self._steady_hz) > STEADY * self._steady_hz or "unknown" in lost:
            steady.clear()
            self._steady_hz = rate_hz
        if rate_hz and self._timed:
            steady.append(second)
            _forget(steady, now_ns - RATE_WINDOW_NS)
        if resets != self._resets or self._restarts:
            self._restarts.extend([now_ns] * min(max(resets - self._resets, 0), RESTARTS_MAX))
            self._resets = resets
            while self._restarts and self._restarts[0] <= now_ns - HOUR_NS:
                self._restarts.popleft()

    def status(self, last_sample_ns: int) -> RecentStatus:
        """Return the counts."""
        first, last = self._seconds[0], self._seconds[-1]
        causes = _by_cause(first.lost, last.lost)
        gaps = causes.pop("unknown", 0)
        known = dict(self._loss)
        known.pop("unknown", 0)
        return RecentStatus(
            self._begun_ns, self.steady_rate_hz(), last.samples - first.samples, causes, gaps,
            last.bytes_in - first.bytes_in, len(self._restarts), last_sample_ns, self._loss_ns,
            sum(known.values()), max(known, key=lambda name: known[name], default=""),
        )  # fmt: skip

    @property
    def has_losses(self) -> bool:
        """Whether samples were lost in the last minute."""
        return self._seconds[0].lost != self._seconds[-1].lost

    def rate_hz(self) -> float:
        """Return the rate of received samples over the last SHORT_NS; 0.0 without two counts."""
        last = self._seconds[-1]
        first = next((one for one in reversed(self._seconds) if one.t_ns <= last.t_ns - SHORT_NS), self._seconds[0])
        span_ns = last.t_ns - first.t_ns
        return (last.samples - first.samples) * NS_PER_S / span_ns if span_ns > 0 else 0.0

    def steady_rate_hz(self) -> float | None:
        """Return the rate of received and lost samples; None without a steady rate or after a gap of unknown size."""
        steady = self._steady
        if not steady or (span_ns := steady[-1].t_ns - steady[0].t_ns) < RATE_WINDOW_NS:
            return None
        first, last = steady[0], steady[-1]
        lost = sum(last.lost) - sum(first.lost) if last.lost != first.lost else 0
        return (last.samples - first.samples + lost) * NS_PER_S / span_ns


def _forget(seconds: deque[_Second], before_ns: int) -> None:
    """Remove old seconds. Keep one second before the window."""
    while len(seconds) > 2 and seconds[1].t_ns <= before_ns:
        seconds.popleft()


# --- hysteresis -------------------------------------------------------------------------------------------------------

HISTORY_MINUTES: Final = 60
_Key = tuple[ReasonCode, str]
_ORDER: Final = {condition: number for number, condition in enumerate(Condition)}


class ConditionWatch:
    """Condition of one device over time. Synchronization: the loop's thread only."""

    def __init__(self, limits: ConditionLimits, events: DeviceEvents, now_ns: int) -> None:
        self._begin_ns, self._end_ns = (int(one * NS_PER_S) for one in (limits.begin_s, limits.end_s))
        self._events = events
        self._causes: dict[_Key, tuple[int, int, Cause]] = {}  # first and last time of each cause, newest cause
        self._missing_ns: int | None = None  # CLOCK_MONOTONIC since which no samples arrive; None while they arrive
        self._found = False  # whether the device was running since start
        self._minute = 0
        self._history: deque[Condition | None] = deque([None] * HISTORY_MINUTES, maxlen=HISTORY_MINUTES)
        self._since_ns = now_ns
        self._counted: Sequence[Cause] = ()
        self.level = Condition.MISSING

    @property
    def condition(self) -> DeviceCondition:
        """Present condition with its sentences."""
        return DeviceCondition(self.level, self._since_ns, tuple(cause.reason() for cause in self._counted))

    @property
    def is_ok(self) -> bool:
        """Whether no reason counts, no cause of a reason exists or ended a short time ago, and samples arrive."""
        return self.level is Condition.OK and not self._causes and self._missing_ns is None

    @property
    def history(self) -> tuple[Condition | None, ...]:
        """Worst condition of each of the last 60 minutes, the oldest first."""
        return tuple(self._history)

    def update(self, now_ns: int, causes: Sequence[Cause]) -> None:
        """Take the present causes into account. Raise an event if the condition or its reasons changed."""
        before = self._counted
        if len(causes) == 1 and causes[0].rule.code in OK and not self._causes:
            self._missing_ns, self._found = None, True
            counted = causes
        else:
            counted = self._now_counted(now_ns, causes) or causes[-1:]
            counted = sorted(counted, key=lambda cause: _ORDER[condition_of(cause.rule.code)])
        self._counted, level = counted, condition_of(counted[0].rule.code)
        if level is not self.level:
            self._since_ns, self.level = now_ns, level
        self.remember(now_ns)
        if before and _keys(before) != _keys(counted):
            condition = self.condition
            codes = ", ".join(dict.fromkeys(cause.rule.code for cause in counted))
            self._events.raise_event(now_ns, EventKind.CONDITION, str(condition), condition=str(level), reasons=codes)

    def _now_counted(self, now_ns: int, causes: Sequence[Cause]) -> Sequence[Cause]:
        """Return the causes that count now: they lasted long enough, or ended a short time ago."""
        if causes[0].rule.code in MISSING:  # then there is no other cause
            self._missing_ns = now_ns if self._missing_ns is None else self._missing_ns
            if self._found and now_ns - self._missing_ns < self._begin_ns:
                return self._counted
            self._causes.clear()
            return causes
        self._missing_ns, self._found = None, True
        for cause in causes:
            if cause.rule.code not in OK:
                key = cause.rule.code, cause.setting
                self._causes[key] = self._causes[key][0] if key in self._causes else now_ns, now_ns, cause
        counted = []
        for key, (first_ns, last_ns, cause) in list(self._causes.items()):
            if now_ns - last_ns > (0 if key[0] in ENDS_AT_ONCE else self._end_ns):
                del self._causes[key]
            elif last_ns - first_ns >= self._begin_ns:
                counted.append(cause)
        return counted

    def remember(self, now_ns: int) -> None:
        """Add the present level to the history."""
        minute, history, level = now_ns // MINUTE_NS, self._history, self.level
        if minute != self._minute:
            history.extend([None] * min(minute - self._minute, HISTORY_MINUTES))
            self._minute = minute
        known = history[-1]
        if known is not level:
            history[-1] = level if known is None else min(known, level, key=lambda one: _ORDER[one])


def _keys(causes: Sequence[Cause]) -> frozenset[_Key]:
    """Return the keys of the reasons that are not ok."""
    return frozenset((cause.rule.code, cause.setting) for cause in causes if cause.rule.code not in OK)


JUDGE_NS: Final = NS_PER_S - 50 * NS_PER_MS  # minimum interval of the condition, ns: each second tick in a quiet state


class ConditionJudge:
    """Condition and recent counts of one device. Synchronization: the loop's thread only."""

    def __init__(self, config: DeviceConfig, port: str, ledger: Ledger, events: DeviceEvents, now_ns: int) -> None:
        self._limits = config.condition
        options = config.link_settings
        field = next((name for name in options.__struct_fields__ if getattr(options, name) == port), "")
        self.place = ConfiguredPort(
            port, f"{config.link}.{field}".rstrip("."), config.link in ("uart", "rs485"), _serial_ports
        )
        self.counts = RecentCounts(ledger, now_ns, timed=config.link != "replay")
        self.watch = ConditionWatch(config.condition, events, now_ns)
        self.due_ns = now_ns  # CLOCK_MONOTONIC of the next update: once per second
        self.state: DeviceState | None = None  # state of the device at the last update
        self._facts: Facts | None = None
        self._seen: tuple[int, Mapping[str, Any]] = 0, {}  # arguments `resets` and `known` of the last `judge`

    def judge(
        self, now_ns: int, rate_hz: float, t_err_ns: int, last_sample_ns: int, resets: int, known: Mapping[str, Any]
    ) -> bool:
        """Update the counts and the condition. Return whether the rules ran: they give the same result for the same
        facts. `rate_hz`: expected rate; `resets`: own restarts; `known`: fields of `Facts` that are not numbers."""
        self.due_ns, self.state, counts = now_ns + JUDGE_NS, known["state"], self.counts
        counts.add(now_ns, rate_hz if self.state is DeviceState.RUNNING else 0.0, resets)
        is_same, self._seen = self._seen == (resets, known), (resets, known)
        if is_same and not counts.has_losses and self.watch.is_ok and self._has_good_numbers(now_ns, rate_hz, t_err_ns):
            self.watch.remember(now_ns)
            return False
        recent = counts.status(last_sample_ns)
        self._facts = facts = Facts(
            now_ns=now_ns, place=self.place, recent=recent, rate_hz=recent.rate_hz, expected_rate_hz=rate_hz,
            t_err_ns=t_err_ns, **known,
        )  # fmt: skip
        self.watch.update(now_ns, causes_of(facts, self._limits))
        return True

    def _has_good_numbers(self, now_ns: int, rate_hz: float, t_err_ns: int) -> bool:
        """Update the numbers and the time of the facts. Return whether no rule for numbers holds."""
        facts = self._facts
        if facts is None:
            return False
        facts.now_ns, facts.rate_hz = now_ns, self.counts.steady_rate_hz()
        facts.expected_rate_hz, facts.t_err_ns = rate_hz, t_err_ns
        return not any(rule.holds(facts, self._limits) for rule in NUMBER_RULES)


def _serial_ports() -> Sequence[str]:
    return [port.path for port in list_ports()]
