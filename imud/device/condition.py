"""Condition of one device: reasons from a few facts, with hysteresis.

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
from imud.device.health import NO_SAMPLE, RUNNING, SEARCH_BEGUN, DeviceEvents
from imud.device.recent_counts import MINUTE_NS, RATE_WINDOW_NS, RecentCounts
from imud.links.serial_port import list_ports
from imud.model.event import EventKind
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S

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


class Known(msgspec.Struct):
    """Facts of a device that rarely change. The rules run again if one of them changes."""

    state: DeviceState
    problem: str
    resets: int = 0  # number of restarts of the device since the start of imud that imud did not request
    is_polled: bool = False
    declared: SettingsStatus | None = None  # None if the settings cannot cause a reason
    axes: FrameProblem | None = None  # kind of the contradiction in axes, angles or heading
    axes_problem: str = ""  # text of this contradiction
    lines: LinesStatus | None = None
    has_scattered_time: bool = False  # whether the device time does not show lost samples
    utc_problem: str = ""
    open_bytes: int = 0  # bytes and frames that the ledger does not account for
    open_frames: int = 0
    is_in_boot_loader: bool = False  # whether the problem is an incomplete firmware update


class Facts(Known, kw_only=True):
    """Facts of a device at one moment that its condition depends on. The properties are words for sentences."""

    now_ns: int
    place: ConfiguredPort
    recent: RecentStatus
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
    if facts.state is DeviceState.MISSING or facts.is_in_boot_loader:  # the port is not checked yet, or a clear cause
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


def _unsaved(facts: Facts, name: str, value: Any) -> str:
    what = f"{title_of(name)} “{value_text(value)}”" if name else "A change"
    if name and facts.declared is not None and name not in facts.declared.flash_unknown:
        return f"{what} is lost at power-off because it is not saved."
    return f"{what} is not saved, and the value in flash is unknown."


def _ledger(facts: Facts, _name: str, _value: Any) -> str:
    count = f"{facts.open_bytes} bytes" if facts.open_bytes else f"{facts.open_frames} frames"
    return f"The ledger does not balance: {count}."


def _lost(facts: Facts, _name: str, _value: Any) -> str:
    percent = facts.lost_percent
    return f"{percent:.{1 if percent >= 1 else 2}f} % of the samples are lost {facts.cause.present}."


RATE_SAMPLES: Final = 2  # deviation that the start and the end of the window can cause, samples
DEVIATION_HZ: Final = RATE_SAMPLES * NS_PER_S / RATE_WINDOW_NS  # the same deviation of the rate


def _is_other_rate(rate_hz: float | None, expected_hz: float, limits: ConditionLimits) -> bool:
    if rate_hz is None or not expected_hz:
        return False
    deviation_hz = abs(rate_hz - expected_hz)
    return deviation_hz > DEVIATION_HZ and deviation_hz > limits.rate_percent / 100 * expected_hz


def _is_inexact(t_err_ns: int, limits: ConditionLimits) -> bool:
    return limits.t_err_ms is not None and t_err_ns / NS_PER_MS > limits.t_err_ms


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
        ReasonCode.RATE, Section.SETTINGS,
        lambda f, limits: _is_other_rate(f.rate_hz, f.expected_rate_hz, limits), _rate,
        "Compare the output rate in the settings of the device with its bit rate.",
    ),
    Rule(
        ReasonCode.TIME_ERROR, Section.TIME, lambda f, limits: _is_inexact(f.t_err_ns, limits),
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
        lambda f, *_: f"No sample was lost since imud started to read this device {f.ago(f.recent.begun_ns)}.",
    ),
)  # fmt: skip


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
        self.minute_end_ns = 0  # CLOCK_MONOTONIC of the next minute of the history
        self._history: deque[Condition | None] = deque([None] * HISTORY_MINUTES, maxlen=HISTORY_MINUTES)
        self._since_ns = now_ns
        self._counted: Sequence[Cause] = ()
        self.level = Condition.MISSING
        # whether no reason counts, no cause of a reason exists or ended recently, and samples arrive
        self.is_ok = False

    @property
    def condition(self) -> DeviceCondition:
        """Present condition with its sentences."""
        return DeviceCondition(self.level, self._since_ns, tuple(cause.reason() for cause in self._counted))

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
        self.is_ok = level is Condition.OK and not self._causes and self._missing_ns is None
        self.remember(now_ns)
        if before and _keys(before) != _keys(counted):
            condition = self.condition
            codes = ", ".join(dict.fromkeys(cause.rule.code for cause in counted))
            self._events.raise_event(
                now_ns, EventKind.CONDITION, str(condition), condition=str(level), reasons=codes, next=condition.steps
            )

    def _now_counted(self, now_ns: int, causes: Sequence[Cause]) -> Sequence[Cause]:
        """Return the causes that count now: they lasted long enough, or ended a short time ago."""
        if causes[0].rule.code in MISSING:  # then there is no other cause
            self._missing_ns = now_ns if self._missing_ns is None else self._missing_ns
            is_short = now_ns - self._missing_ns < self._begin_ns
            if self._found and is_short and not causes[0].facts.is_in_boot_loader:
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
            self._minute, self.minute_end_ns = minute, (minute + 1) * MINUTE_NS
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
        self._known: Known | None = None  # argument of the last `judge`

    def judge(
        self, now_ns: int, rate_hz: float, t_err_ns: int, last_sample_ns: int, known: Known, newest_ns: int = 0
    ) -> bool:
        """Update the counts and the condition. Return whether the rules ran: they give the same result for the same
        facts. `rate_hz`: expected rate. `newest_ns`: time stamp of the newest sample, 0 without a sample."""
        self.due_ns, self.state, counts, watch = now_ns + JUDGE_NS, known.state, self.counts, self.watch
        has_losses = counts.add(now_ns, rate_hz if known.state is RUNNING else 0.0, known.resets, newest_ns)
        is_same, self._known = known == self._known, known
        if (
            is_same
            and watch.is_ok
            and not has_losses
            and not _is_other_rate(counts.steady_rate_hz(), rate_hz, self._limits)
            and not _is_inexact(t_err_ns, self._limits)
            and self._facts is not None
        ):
            self._facts.now_ns = now_ns  # for the sentences
            if now_ns >= watch.minute_end_ns:
                watch.remember(now_ns)
            return False
        recent = counts.status(last_sample_ns)
        self._facts = facts = Facts(
            *msgspec.structs.astuple(known), now_ns=now_ns, place=self.place, recent=recent, rate_hz=recent.rate_hz,
            expected_rate_hz=rate_hz, t_err_ns=t_err_ns,
        )  # fmt: skip
        watch.update(now_ns, causes_of(facts, self._limits))
        return True

    def add_new_losses(self, now_ns: int, last_sample_ns: int) -> None:
        """Update the condition if the ledger contains losses that the last `judge` did not know. The sentences of a
        reply then agree with its ledger."""
        if self._facts is None or not self.counts.add_new_losses(now_ns):
            return
        recent = self.counts.status(last_sample_ns)
        self._facts = facts = msgspec.structs.replace(self._facts, now_ns=now_ns, recent=recent)
        self.watch.update(now_ns, causes_of(facts, self._limits))


def _serial_ports() -> Sequence[str]:
    return [port.path for port in list_ports()]
