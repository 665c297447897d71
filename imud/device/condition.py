"""Condition of one device: reasons from its status, with hysteresis, and counts of the last minute.

status ──▶ reasons_of ──▶ ConditionWatch (begins after 5 s, ends after 60 s) ──▶ status, event
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final, NamedTuple
from zlib import crc32

from msgspec.structs import replace

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
    signature,
)
from imud.contracts.setting import SettingsState, title_of
from imud.contracts.status import DeviceState, DeviceStatus, FrameProblem, RecentStatus
from imud.device.health import NO_SAMPLE, SEARCH_BEGUN, DeviceEvents
from imud.links.serial_port import list_ports
from imud.model.event import EventKind
from imud.model.ledger import LOST_FIELDS, Ledger, bytes_open, frames_open
from imud.model.options import shown
from imud.model.units import NS_PER_MS, NS_PER_S

MINUTE_NS: Final = 60 * NS_PER_S
SERIAL_WIRES: Final = "check that TX and RX are not swapped"
BUS_WIRES: Final = "check the wires and the bit rate of the bus"

# Reasons that end with their cause: only the user or a new start of the samples ends them, so they do not flicker
ENDS_AT_ONCE: Final = frozenset((*MISSING, *OK, ReasonCode.SETTING, ReasonCode.UNSAVED, ReasonCode.DECLINATION))


class LossCause(NamedTuple):
    """Words about lost samples of one cause."""

    present: str
    past: str
    next: str


LOSSES: Final[Mapping[str, LossCause]] = {
    "crc": LossCause(
        "because frames are damaged", "because frames were damaged",
        "Check the cable, its length and its ground. If they are correct, use a lower bit rate.",
    ),
    "gap_device": LossCause(
        "before they reach this host", "before they reached this host",
        "Use a lower output rate or a higher bit rate of the device.",
    ),
    "overrun": LossCause(
        "in kernel buffer overruns", "in a kernel buffer overrun", "Reduce the load of this host, or use a lower rate."
    ),
    "queue": LossCause(
        "because imud is too late", "because imud was too late", "Reduce the load of this host, or use a lower rate."
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ConfiguredPort:
    """Port of a device in its configuration."""

    port: str  # for example `/dev/ttyUSB0`
    key: str  # key of the configuration, for example `uart.port`
    is_serial: bool  # whether the port is a serial port of this host
    others: Callable[[], Sequence[str]]  # returns the serial ports of this host


def reasons_of(status: DeviceStatus, limits: ConditionLimits, place: ConfiguredPort, now_ns: int) -> list[Reason]:
    """Return the present reasons of a device, without hysteresis. `status.recent` must not be None."""
    if status.state is DeviceState.FINISHED:
        problem = f" {_sentence(status.problem)}" if status.problem else ""
        return [Reason(ReasonCode.FINISHED, f"The replay is at its end.{problem}")]
    if status.state is not DeviceState.RUNNING:
        return [_missing(status, place, now_ns)]
    assert status.recent is not None
    return [
        *_settings(status), *_axes(status), *_lines(status), *_ledger(status), *_restarts(status.recent, limits),
        *_losses(status.recent, limits), *_rate(status, status.recent, limits), *_time(status, limits), *_link(status),
    ]  # fmt: skip


# --- missing ----------------------------------------------------------------------------------------------------------


def _missing(status: DeviceStatus, place: ConfiguredPort, now_ns: int) -> Reason:
    recent, problem = status.recent, status.problem
    if status.state is DeviceState.MISSING and place.is_serial:
        there = ", ".join(place.others()) or "none"
        step = f"Plug in the cable, or correct {place.key} in the configuration. Ports on this host: {there}."
        return Reason(ReasonCode.NO_PORT, f"The port {place.port} does not exist.", step, Section.ABOUT)
    if status.state is DeviceState.SILENT and problem.startswith(NO_SAMPLE):
        silent = duration(now_ns - recent.last_sample_ns) if recent is not None else "some time"
        words = f"The device stopped sending {silent} ago. Its port still exists."
        return Reason(ReasonCode.STOPPED, words, "Check the power supply and the connector.", Section.ABOUT)
    if status.state in (DeviceState.MISSING, DeviceState.FAILED):
        code = ReasonCode.FAILED if status.state is DeviceState.FAILED else ReasonCode.NO_PORT
        return Reason(code, _sentence(problem), DOCTOR, Section.ABOUT)
    is_quiet = recent is None or not recent.bytes_in
    if is_quiet and status.polling is None and not problem.startswith(("it replies", SEARCH_BEGUN)):
        wires = SERIAL_WIRES if place.is_serial else BUS_WIRES
        step = f"Check the power supply, and {wires}."
        return Reason(ReasonCode.NO_DATA, f"No data arrives at {place.port}.", step, Section.ABOUT)
    if problem in ("", SEARCH_BEGUN):
        return Reason(ReasonCode.SEARCHING, f"imud searches for the device at {place.port}.", "Wait for the search.")
    return Reason(ReasonCode.NO_SAMPLES, _sentence(problem), DOCTOR, Section.ABOUT)


def _sentence(problem: str) -> str:
    """Return a problem as a sentence."""
    first, _, rest = problem.partition(" ")
    if first.isalpha() and first.islower() and first != "imud":
        first = first.capitalize()
    text = f"{first} {rest}".strip() or "The reason is not known"
    return text if text.endswith((".", "?", "!")) else f"{text}."


# --- attention --------------------------------------------------------------------------------------------------------


def _settings(status: DeviceStatus) -> Iterator[Reason]:
    declared = status.declared
    if declared is None:
        return
    if declared.state is SettingsState.DIFFER:
        for name, one in declared.differences.items():
            actual = "not known" if one.actual is None else f"“{value_text(one.actual)}”"
            words = (
                f"{title_of(name)} is {actual} on the device, but “{value_text(one.declared)}” in the configuration."
            )
            step = "Apply the declared value, or change the configuration."
            yield Reason(ReasonCode.SETTING, words, step, Section.SETTINGS, name)
    if declared.unsaved:
        step = "Save the settings to the device's flash."
        for name, value in declared.lost_at_power_off.items():
            words = f"{title_of(name)} “{value_text(value)}” is lost at power-off because it is not saved."
            yield Reason(ReasonCode.UNSAVED, words, step, Section.SETTINGS, name)
        if not declared.lost_at_power_off:
            words = "A change is lost at power-off because it is not saved."
            yield Reason(ReasonCode.UNSAVED, words, step, Section.SETTINGS)
    if declared.problem:
        step = "Run `imud settings` with the name of the device."
        yield Reason(ReasonCode.SETTINGS_PROBLEM, _sentence(declared.problem), step, Section.SETTINGS)


def value_text(value: Any) -> str:
    """Return the value of a setting for people: words without quotes, other values as JSON."""
    return value if isinstance(value, str) else shown(value)


def _axes(status: DeviceStatus) -> Iterator[Reason]:
    frame = status.frame
    if frame is None or frame.problem_kind is None:
        return
    match frame.problem_kind:
        case FrameProblem.DECLINATION:
            relative = "power-on" in frame.problem
            step = "Calibrate the magnetometer, or remove" if relative else "Remove"
            step += " declination_deg from the configuration."
            yield Reason(ReasonCode.DECLINATION, f"{frame.problem}.", step, Section.CALIBRATION)
        case FrameProblem.GRAVITY:
            words = "The measured gravity does not match the attitude."
            yield Reason(ReasonCode.GRAVITY, words, _sentence(frame.problem), Section.ABOUT)
        case FrameProblem.AXES:
            yield Reason(ReasonCode.AXES, _sentence(frame.problem), DOCTOR, Section.SETTINGS)


def _lines(status: DeviceStatus) -> Iterator[Reason]:
    if status.lines is not None:
        if status.lines.alarm:
            step = "Compare the measured values with the limits of the device (docs/lines.md)."
            yield Reason(ReasonCode.ALARM, "The ALARM pin is active.", step, Section.LIVE)
        for line, problem in status.lines.problems.items():
            yield Reason(ReasonCode.LINE, f"Line {line}: {problem}.", DOCTOR, Section.ABOUT, line)
    if status.utc is not None and status.utc.problem:
        yield Reason(ReasonCode.UTC, _sentence(status.utc.problem), DOCTOR, Section.TIME)


def _ledger(status: DeviceStatus) -> Iterator[Reason]:
    open_bytes, open_frames = bytes_open(status.ledger), frames_open(status.ledger)
    if open_bytes or open_frames:
        count = f"{open_bytes} bytes" if open_bytes else f"{open_frames} frames"
        step = "Report this fault of imud with the output of `imud status --json`."
        yield Reason(ReasonCode.LEDGER, f"The ledger does not balance: {count}.", step, Section.LEDGER)


def _restarts(recent: RecentStatus, limits: ConditionLimits) -> Iterator[Reason]:
    if recent.restarts >= limits.restarts:
        words = f"The device restarted {recent.restarts} times in the last hour."
        yield Reason(ReasonCode.RESTARTS, words, "Measure the supply voltage at the device.", Section.EVENTS)


# --- degraded ---------------------------------------------------------------------------------------------------------


def _losses(recent: RecentStatus, limits: ConditionLimits) -> Iterator[Reason]:
    lost = sum(recent.lost.values())
    percent = 100 * lost / (lost + recent.samples) if lost else 0.0
    if percent > limits.lost_percent:
        cause = LOSSES[max(recent.lost, key=lambda name: recent.lost[name])]
        digits = 1 if percent >= 1 else 2
        words = f"{percent:.{digits}f} % of the samples are lost {cause.present}."
        yield Reason(ReasonCode.LOST, words, cause.next, Section.LEDGER)
    if recent.gaps:
        words = f"Samples are lost in {recent.gaps} gap{'s' * (recent.gaps > 1)} of unknown size in the last minute."
        yield Reason(ReasonCode.GAPS, words, DOCTOR, Section.LEDGER)


RATE_WINDOW_NS: Final = 10 * NS_PER_S  # time over which imud measures the rate, ns
RATE_SAMPLES: Final = 2  # deviation that the start and the end of the window can cause, samples


def _rate(status: DeviceStatus, recent: RecentStatus, limits: ConditionLimits) -> Iterator[Reason]:
    rate_hz, expected_hz = recent.rate_hz, status.expected_rate_hz
    if rate_hz is None or not expected_hz:
        return
    tolerance_hz = max(limits.rate_percent / 100 * expected_hz, RATE_SAMPLES * NS_PER_S / RATE_WINDOW_NS)
    if abs(rate_hz - expected_hz) > tolerance_hz:
        words = f"The device sends {_rate_text(rate_hz)} samples per second instead of {_rate_text(expected_hz)}."
        step = "Compare the output rate in the settings of the device with its bit rate."
        yield Reason(ReasonCode.RATE, words, step, Section.SETTINGS)


def _rate_text(rate_hz: float) -> str:
    return f"{rate_hz:.1f}".removesuffix(".0")


def _time(status: DeviceStatus, limits: ConditionLimits) -> Iterator[Reason]:
    error_ms = status.clock.t_err_ns / NS_PER_MS
    if limits.t_err_ms is not None and error_ms > limits.t_err_ms:
        words = f"The time stamp error is ±{error_ms:.2g} ms."
        yield Reason(ReasonCode.TIME_ERROR, words, "Connect SOUT, or reduce the latency timer.", Section.TIME)


def _link(status: DeviceStatus) -> Iterator[Reason]:
    if status.problem:
        yield Reason(ReasonCode.LINK, _sentence(status.problem), DOCTOR, Section.ABOUT)


# --- ok ---------------------------------------------------------------------------------------------------------------


def no_loss(recent: RecentStatus, now_ns: int) -> Reason:
    """Return the reason of a device without a problem: its last loss."""
    if not recent.loss_ns:
        words = f"No sample was lost since imud started {duration(now_ns - recent.begun_ns)} ago."
        return Reason(ReasonCode.NONE_LOST, words, section=Section.LEDGER)
    count, cause = recent.loss_samples, LOSSES.get(recent.loss_cause)
    what = f"{count} sample{'s were' if count != 1 else ' was'} lost" if count else "Samples were lost"
    words = f"{what} {duration(now_ns - recent.loss_ns)} ago" + (f" {cause.past}." if cause is not None else ".")
    return Reason(ReasonCode.LOST_BEFORE, f"{words} No sample was lost after that.", section=Section.LEDGER)


# --- counts of the last minute ----------------------------------------------------------------------------------------

_COUNTS: Final = attrgetter("samples", "bytes_in", *LOST_FIELDS)
CAUSES: Final = tuple(name.removeprefix("lost_") for name in LOST_FIELDS)
HOUR_NS: Final = 60 * MINUTE_NS
STEADY: Final = 0.01  # maximum change of the expected rate within the window of a rate, as a share
RESTARTS_MAX: Final = 60  # maximum number of stored restarts, as in `ConditionLimits.restarts`


class _Second(NamedTuple):
    t_ns: int
    counts: Sequence[int]
    rate_hz: float  # expected rate; 0 if it is not known or if the device does not run


class RecentCounts:
    """Counts of a device in the last minute and restarts in the last hour. Synchronization: the loop's thread only."""

    def __init__(self, ledger: Ledger, begun_ns: int, *, timed: bool) -> None:
        """`timed`: the device sends in real time. A replay can be faster, so its rate is not known."""
        self._ledger = ledger
        self._begun_ns = begun_ns
        self._timed = timed
        self._seconds: deque[_Second] = deque([_Second(begun_ns, _COUNTS(ledger), 0.0)], maxlen=64)
        self._restarts: deque[int] = deque(maxlen=RESTARTS_MAX)
        self._resets = 0
        self._loss = dict.fromkeys(CAUSES, 0)
        self._loss_ns = 0

    def add(self, now_ns: int, rate_hz: float, resets: int) -> None:
        """Add the present counts. `rate_hz`: expected rate, 0 if the device does not run; `resets`: own restarts."""
        second = _Second(now_ns, _COUNTS(self._ledger), rate_hz)
        self._note_loss(now_ns, self._seconds[-1].counts, second.counts)
        self._seconds.append(second)
        while len(self._seconds) > 2 and self._seconds[1].t_ns <= now_ns - MINUTE_NS:
            self._seconds.popleft()
        self._restarts.extend([now_ns] * min(max(resets - self._resets, 0), RESTARTS_MAX))
        self._resets = resets
        while self._restarts and self._restarts[0] <= now_ns - HOUR_NS:
            self._restarts.popleft()

    def _note_loss(self, now_ns: int, before: Sequence[int], after: Sequence[int]) -> None:
        lost = {name: now - then for name, then, now in zip(CAUSES, before[2:], after[2:], strict=True) if now > then}
        if not lost:
            return
        if now_ns - self._loss_ns > MINUTE_NS:
            self._loss = dict.fromkeys(CAUSES, 0)
        self._loss_ns = now_ns
        for name, count in lost.items():
            self._loss[name] += count

    def status(self, last_sample_ns: int) -> RecentStatus:
        """Return the counts."""
        first, last = self._seconds[0], self._seconds[-1]
        samples, bytes_in, *lost = (now - then for then, now in zip(first.counts, last.counts, strict=True))
        causes = {name: count for name, count in zip(CAUSES, lost, strict=True) if count}
        gaps = causes.pop("unknown", 0)
        known = {name: count for name, count in self._loss.items() if name != "unknown"}
        return RecentStatus(
            self._begun_ns, self._rate_hz(), samples, causes, gaps, bytes_in, len(self._restarts), last_sample_ns,
            self._loss_ns, sum(known.values()), max(known, key=lambda name: known[name]) if any(known.values()) else "",
        )  # fmt: skip

    def _rate_hz(self) -> float | None:
        """Return the rate of received and lost samples; None without a steady rate or after a gap of unknown size."""
        last = self._seconds[-1]
        window = [one for one in self._seconds if one.t_ns >= last.t_ns - RATE_WINDOW_NS - NS_PER_S]
        first = window[0]
        rates = [one.rate_hz for one in window]
        span_ns = last.t_ns - first.t_ns
        is_steady = min(rates) > 0 and max(rates) - min(rates) <= STEADY * max(rates)
        if not self._timed or span_ns < RATE_WINDOW_NS or not is_steady or first.counts[-1] != last.counts[-1]:
            return None
        samples = sum(last.counts[2:]) - sum(first.counts[2:]) + last.counts[0] - first.counts[0]
        return samples * NS_PER_S / span_ns


# --- hysteresis -------------------------------------------------------------------------------------------------------

HISTORY_MINUTES: Final = 60
_Key = tuple[ReasonCode, str]


class ConditionWatch:
    """Condition of one device over time. Synchronization: the loop's thread only."""

    def __init__(self, limits: ConditionLimits, events: DeviceEvents, now_ns: int) -> None:
        self._limits = limits
        self._events = events
        self._causes: dict[_Key, tuple[int, int, Reason]] = {}  # first and last time of each cause, newest reason
        self._missing_ns: int | None = None  # CLOCK_MONOTONIC since which no samples arrive; None while they arrive
        self._found = False  # whether the device was running since start
        self._minute = 0
        self._history: deque[Condition | None] = deque([None] * HISTORY_MINUTES, maxlen=HISTORY_MINUTES)
        self.condition = DeviceCondition(Condition.MISSING, now_ns)

    @property
    def history(self) -> tuple[Condition | None, ...]:
        """Worst condition of each of the last 60 minutes, the oldest first."""
        return tuple(self._history)

    def update(self, now_ns: int, reasons: Sequence[Reason], recent: RecentStatus) -> None:
        """Take the present reasons into account. Raise an event if the condition or its reasons changed."""
        counted = self._counted(now_ns, reasons)
        if not counted:
            counted = [reason for reason in reasons if reason.code in OK] or [no_loss(recent, now_ns)]
        counted.sort(key=lambda reason: _ORDER[condition_of(reason.code)])
        before, condition = self.condition, condition_of(counted[0].code)
        since_ns = before.since_ns if condition is before.condition else now_ns
        self.condition = DeviceCondition(condition, since_ns, tuple(counted))
        self._remember(now_ns, condition)
        if before.reasons and signature(before) != signature(self.condition):
            codes = ", ".join(dict.fromkeys(reason.code for reason in counted))
            self._events.raise_event(
                now_ns, EventKind.CONDITION, str(self.condition), condition=str(condition), reasons=codes
            )

    def _counted(self, now_ns: int, reasons: Sequence[Reason]) -> list[Reason]:
        """Return the reasons that count now: their cause lasted long enough, or ended a short time ago."""
        begin_ns, end_ns = (int(one * NS_PER_S) for one in (self._limits.begin_s, self._limits.end_s))
        if missing := [reason for reason in reasons if reason.code in MISSING]:
            self._missing_ns = now_ns if self._missing_ns is None else self._missing_ns
            if self._found and now_ns - self._missing_ns < begin_ns:
                return list(self.condition.reasons)
            self._causes.clear()
            return missing
        self._missing_ns, self._found = None, True
        for reason in reasons:
            if reason.code not in OK:
                key = reason.code, reason.setting
                self._causes[key] = self._causes[key][0] if key in self._causes else now_ns, now_ns, reason
        counted = []
        for key, (first_ns, last_ns, reason) in list(self._causes.items()):
            if now_ns - last_ns > (0 if key[0] in ENDS_AT_ONCE else end_ns):
                del self._causes[key]
            elif last_ns - first_ns >= begin_ns:
                counted.append(reason)
        return counted

    def _remember(self, now_ns: int, condition: Condition) -> None:
        minute = now_ns // MINUTE_NS
        for _ in range(min(minute - self._minute, HISTORY_MINUTES)):
            self._history.append(None)
        self._minute = minute
        known = self._history[-1]
        self._history[-1] = condition if known is None else min(known, condition, key=lambda one: _ORDER[one])


_ORDER: Final = {condition: number for number, condition in enumerate(Condition)}


JUDGE_NS: Final = NS_PER_S  # interval of the condition, ns
JUDGE_GROUPS: Final = 10  # number of ticks over which the devices of a daemon spread this work


class ConditionJudge:
    """Condition and recent counts of one device. Synchronization: the loop's thread only."""

    def __init__(self, config: DeviceConfig, port: str, ledger: Ledger, events: DeviceEvents, now_ns: int) -> None:
        self._limits = config.condition
        options = config.link_settings
        field = next((name for name in options.__struct_fields__ if getattr(options, name) == port), "")
        self._place = ConfiguredPort(
            port, f"{config.link}.{field}".rstrip("."), config.link in ("uart", "rs485"), _serial_ports
        )
        self._counts = RecentCounts(ledger, now_ns, timed=config.link != "replay")
        self._watch = ConditionWatch(config.condition, events, now_ns)
        self._offset_ns = crc32(config.name.encode()) % JUDGE_GROUPS * (JUDGE_NS // JUDGE_GROUPS)
        self._due_ns = now_ns
        self._state: DeviceState | None = None

    @property
    def condition(self) -> DeviceCondition:
        """Present condition."""
        return self._watch.condition

    @property
    def history(self) -> tuple[Condition | None, ...]:
        """Worst condition of each of the last 60 minutes, the oldest first."""
        return self._watch.history

    def recent(self, last_sample_ns: int) -> RecentStatus:
        """Return the counts of the last minute. `last_sample_ns`: CLOCK_MONOTONIC of the newest sample."""
        return self._counts.status(last_sample_ns)

    def tick(self, now_ns: int, state: DeviceState, status: Callable[[], DeviceStatus]) -> None:
        """Update the condition once per second, and when the state changed. `status` returns the present status."""
        if now_ns < self._due_ns and state is self._state:
            return
        self._due_ns = now_ns + JUDGE_NS - (now_ns - self._offset_ns) % JUDGE_NS
        self._state = state
        present = status()
        assert present.recent is not None
        resets = present.clock.resets - present.resets_requested
        self._counts.add(now_ns, present.expected_rate_hz if state is DeviceState.RUNNING else 0.0, resets)
        present = replace(present, recent=self._counts.status(present.recent.last_sample_ns))
        reasons = reasons_of(present, self._limits, self._place, now_ns)
        assert present.recent is not None
        self._watch.update(now_ns, reasons, present.recent)


def _serial_ports() -> Sequence[str]:
    return [port.path for port in list_ports()]
