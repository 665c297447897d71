"""Output `rules`: evaluates the rules, and starts their events, snapshots, lines and commands.

    batch ─▶ Limit of each rule ─▶ begin or end ─▶ event, line, command
    tick  ─▶ sample rate, lost samples, silence ─┘

A rule has one state for each device. An active rule of a device that stops stays active: only values end it. When the
output or the device ends (a changed configuration, the end of imud), imud ends its active rules with an event.
"""

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, inf
from typing import Final

from imud.contracts.lines import DrivenOutput
from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import RulesStatus, RuleStatus
from imud.formats.slot import PRESENT_BITS, SLOT_BYTES, SLOT_FIELDS, slot_times_ns
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.rules.commands import CommandEnd, CommandRunner, Result
from imud.publishers.rules.limit import AXES, Change, Limit, LimitState, Reduction, Statistic, settle_s
from imud.publishers.rules.settings import RuleOptions, RulesOptions

log = logging.getLogger(__name__)

WHO: Final = "rules"  # name of this output in latency requests
LATENCY_NS: Final = 100 * NS_PER_MS  # maximum hold of samples, ns: an event is at most this late
END_HOLD_NS: Final = NS_PER_S  # minimum hold before the end of a rule, ns: limits the number of events
STALL_NS: Final = 2 * NS_PER_S  # a longer time between two ticks is a stall of the host, not a silence of a device
UNEVALUATED_NS: Final = 10 * NS_PER_S  # time with samples but without values before imud reports a rule
AXIS_PLACES: Final = {"x": 0, "y": 1, "z": 2, "roll": 0, "pitch": 1}
_OFFSETS: Final = {field.name: field.offset for field in SLOT_FIELDS}


def state_of(rule: RuleOptions) -> LimitState:
    """Return the state of a rule before the first sample."""
    state = LimitState()
    state.above = inf if rule.above is None else rule.above
    state.below = -inf if rule.below is None else rule.below
    state.above_end, state.below_end = state.above - rule.hysteresis, state.below + rule.hysteresis
    state.hold_ns = round(rule.hold_s * NS_PER_S)
    state.end_hold_ns = max(state.hold_ns, END_HOLD_NS)
    state.window_ns = round(rule.window * NS_PER_S)
    state.held_ns, state.scale, state.count = -1, 1.0, 1
    if name := rule.field:
        state.bit, state.offset = PRESENT_BITS[name], _OFFSETS[name]
    if rule.axis is not None:
        state.offset += 8 * AXIS_PLACES[rule.axis]
    if rule.measure == "tilt_deg":
        state.scale = degrees(1)
        state.reduction = Reduction.TILT if rule.axis is None else Reduction.SIGNED
        state.count = 2 if rule.axis is None else 1
    elif rule.measure == "temperature_c":
        state.reduction = Reduction.SIGNED
    elif rule.measure == "t_err_ms":
        state.reduction, state.scale, state.offset = Reduction.INTEGER, 1 / NS_PER_MS, _OFFSETS["t_err_ns"]
    else:
        state.count = AXES if rule.axis is None else 1
    if rule.measure == "angular_rate_deg_s":
        state.scale = degrees(1)
    if rule.kind.has_band:
        state.statistic = Statistic.PEAK if rule.measure == "peak_accel_m_s2" else Statistic.RMS
        state.has_band = int(rule.band_hz is not None)
    return state


class DeviceRule:
    """One rule for one device."""

    def __init__(self, name: str, rule: RuleOptions, device: str) -> None:
        self.name, self.rule, self.device = name, rule, device
        self.limit = Limit(state_of(rule))
        self.active = False
        self.begun_ns = 0  # time when the rule became active, CLOCK_MONOTONIC
        self.begins = 0
        self.problem = ""
        self._design_problem = ""
        self._evaluated = -1  # comparisons at the last tick with a change
        self._counts = (0, 0, 0)  # samples then: used, absent, not finite
        self._waited_ns = 0  # time with samples since then
        settle_ns = 0 if rule.band_hz is None else round(settle_s(*rule.band_hz) * NS_PER_S)
        window_ns = round(rule.window * NS_PER_S) if rule.kind.has_window else 0
        self._patience_ns = UNEVALUATED_NS + settle_ns + window_ns

    def design(self) -> None:
        """Design the band filter for the measured sample period."""
        if self.rule.band_hz is not None:
            state = self.limit.load()
            low_hz, high_hz = self.rule.band_hz
            self._design_problem = state.design(low_hz, high_hz)
            self.limit.store()

    def compare(self, value: float, step_ns: int) -> Change:
        """Compare a value of a tick with the limit."""
        state = self.limit.load()
        change = state.compare(value, step_ns)
        self.limit.store()
        return change

    def judge(self, step_ns: int, has_samples: bool) -> bool:
        """Find out whether imud evaluates the rule. Return whether the answer changed."""
        state, before = self.limit.load(), self.problem
        if state.evaluated != self._evaluated:
            self._evaluated, self._waited_ns = state.evaluated, 0
            self._counts = (state.used, state.absent, state.not_finite)
            self.problem = ""
        elif has_samples:
            self._waited_ns += min(step_ns, NS_PER_S)
        if self._design_problem and not state.designed:
            self.problem = f"not evaluated: {self._design_problem}"
        elif self._waited_ns >= self._patience_ns:
            self.problem = f"not evaluated: {self._reason(state)}"
        return self.problem != before

    def _reason(self, state: LimitState) -> str:
        used, absent, not_finite = self._counts
        if state.used == used and state.absent > absent:
            return (
                f"the samples of {self.device} do not contain {self.rule.field}; select a frame type with this field, "
                f"or remove the device from the rule"
            )
        if state.not_finite > not_finite:
            return f"values of {self.rule.field} are not finite"
        if not state.period_ns:
            return "imud cannot measure the sample rate for band_hz: the time stamps are uneven"
        return f"the band filter starts again after each gap: {state.restarts} gaps"


@dataclass(slots=True)
class RateWindow:
    """Open window of a sample rate."""

    begun_ns: int  # CLOCK_MONOTONIC at the start of the window
    stamp_ns: int  # time stamp of the newest sample before the window
    count: int = 0
    rate_hz: float | None = None  # rate of the previous window; None: no previous window


class WatchedDevice:
    """One device with its rules."""

    def __init__(self, name: str, rules: list[DeviceRule], now_ns: int) -> None:
        self.name, self.rules = name, rules
        # functions that evaluate slots, without the rules of ticks
        self.sampled = tuple((one.limit.evaluate, one) for one in rules if one.rule.kind.is_sampled)
        self.samples = 0  # number of samples since the last tick
        self.newest = b""  # slots of the newest batch
        self.heard_ns = now_ns  # tick after the newest sample
        self.windows: dict[str, RateWindow] = {}  # by rule of the sample rate
        self.losses: dict[str, deque[tuple[int, int]]] = {}  # time and lost samples of the window, by rule


class Rules:
    """Output of rules. Synchronization: the event loop's thread only."""

    event: Final = None  # rules do not limit events

    def __init__(self, settings: RulesOptions, context: PublisherContext) -> None:
        self._settings, self._context = settings, context
        self._devices: dict[str, WatchedDevice] = {}
        self._lines: dict[str, DrivenOutput] = {}
        self._runner = CommandRunner(settings.commands, context.clock.now_ns)
        self._tick_ns = context.clock.now_ns()
        self._is_running = False

    # --- publisher ----------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start to evaluate the rules. Lines open at the next tick."""
        context = self._context
        for name, rule in self._settings.rules.items():
            if rule.line is not None:
                self._lines[name] = context.drive_line(rule.line, f"rule {name}")
        context.outputs.rules.append(self.status)
        self._is_running = True
        self._ask()

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device with the rules that name it."""
        rules = [
            DeviceRule(rule_name, rule, name)
            for rule_name, rule in self._settings.rules.items()
            if rule.devices is None or name in rule.devices
        ]
        if rules:
            self._devices[name] = WatchedDevice(name, rules, self._context.clock.now_ns())
        self._ask()

    def remove_device(self, name: str) -> None:
        device = self._devices.pop(name, None)
        if device is not None:
            self._end_all(device, "the device was removed or restarted by a new configuration")
            self._ask()

    def publish(self, batch: Batch) -> None:
        """Evaluate the rules of a device with each sample."""
        device = self._devices.get(batch.device)
        if device is None:
            return
        packed = batch.packed
        device.newest = packed
        device.samples += len(packed) // SLOT_BYTES
        for evaluate, one in device.sampled:
            offset = evaluate(packed, 0)
            while offset >= 0:
                self._take(one, packed, offset)
                offset = evaluate(packed, offset)

    def tick(self, now_ns: int) -> None:
        """Evaluate sample rate, lost samples and silence. Open lines. Find rules without values."""
        step_ns, self._tick_ns = now_ns - self._tick_ns, now_ns
        for device in list(self._devices.values()):
            has_samples = device.samples > 0
            if has_samples:
                device.heard_ns = now_ns
            elif step_ns > STALL_NS:
                device.heard_ns += step_ns  # the host did not read the samples of this time
            for one in device.rules:
                if not one.rule.kind.is_sampled:
                    self._tick_rule(device, one, now_ns, step_ns)
                elif one.judge(step_ns, has_samples) and one.problem:
                    log.warning("rules: %s of %s: %s", one.name, one.device, one.problem)
            device.samples = 0
        for line in self._lines.values():
            line.tick(now_ns)

    def close(self) -> None:
        """End active rules with events, lines and running commands. A second call does nothing."""
        if not self._is_running:
            return
        self._is_running = False
        self._context.outputs.rules.remove(self.status)
        self._context.latencies.release(WHO)
        for device in self._devices.values():
            self._end_all(device, "the output rules ended")
        for line in self._lines.values():
            line.close()
        self._runner.close()

    def status(self) -> RulesStatus:
        found = tuple(
            RuleStatus(one.name, one.device, one.active, one.begins, one.problem or self._action_problem(one.rule))
            for device in self._devices.values()
            for one in device.rules
        )
        problems = {name: line.problem for name, line in self._lines.items()}
        counts = {result.value: self._runner.results[result] for result in Result}
        return RulesStatus(found, problems, counts)

    # --- values -------------------------------------------------------------------------------------------------------

    def _ask(self) -> None:
        """Request the latency for the devices with rules of samples."""
        names = [device.name for device in self._devices.values() if device.sampled]
        if not self._is_running or not names:
            self._context.latencies.release(WHO)
        else:
            self._context.latencies.ask(WHO, LATENCY_NS, names)

    def _take(self, one: DeviceRule, packed: bytes, offset: int) -> None:
        """Process the change at the slot before `offset`."""
        state = one.limit.load()
        if state.change == Change.PERIOD:
            one.design()
        else:
            self._change(one, state.value, slot_times_ns(packed[offset - SLOT_BYTES : offset])[0])

    def _tick_rule(self, device: WatchedDevice, one: DeviceRule, now_ns: int, step_ns: int) -> None:
        """Evaluate a rule of ticks."""
        value = _TICK_VALUES[one.rule.measure](self, device, one, now_ns)
        if value is not None and one.compare(value, step_ns):
            self._change(one, value, now_ns)

    def _silence(self, device: WatchedDevice, _one: DeviceRule, now_ns: int) -> float:
        return (now_ns - device.heard_ns) / NS_PER_S

    def _lost(self, device: WatchedDevice, one: DeviceRule, now_ns: int) -> float:
        """Return the number of samples lost in the window. A gap of unknown size counts as one sample."""
        total = sum(self._context.devices.losses(device.name))
        kept = device.losses.setdefault(one.name, deque())
        if kept and total < kept[-1][1]:
            kept.clear()  # a new ledger
        kept.append((now_ns, total))
        while len(kept) > 1 and kept[1][0] <= now_ns - round(one.rule.window * NS_PER_S):
            kept.popleft()
        return float(total - kept[0][1])

    def _rate(self, device: WatchedDevice, one: DeviceRule, now_ns: int) -> float | None:
        """Return the sample rate of the newest complete window, by time stamps: 0 without samples; None without a
        window."""
        newest_ns = slot_times_ns(device.newest[-SLOT_BYTES:])[0] if device.newest else 0
        window = device.windows.get(one.name)
        if window is None:  # the first window begins with a sample
            if device.newest:
                device.windows[one.name] = RateWindow(now_ns, newest_ns)
            return None
        window.count += device.samples
        if now_ns - window.begun_ns >= round(one.rule.window * NS_PER_S):
            span_ns = newest_ns - window.stamp_ns
            rate_hz = window.count * NS_PER_S / span_ns if window.count and span_ns > 0 else 0.0
            device.windows[one.name] = window = RateWindow(now_ns, newest_ns, rate_hz=rate_hz)
        return window.rate_hz

    # --- events and actions -------------------------------------------------------------------------------------------

    def _change(self, one: DeviceRule, value: float, t_ns: int) -> None:
        """Report that a rule became active or ended, and start the actions."""
        now_ns, rule = self._context.clock.now_ns(), one.rule
        one.active = not one.active
        unit = f" {rule.kind.unit}" if rule.kind.unit and rule.kind.unit != "°" else rule.kind.unit
        shown_axis = f" {rule.axis}" if rule.axis else ""
        what = f"{rule.kind.words}{shown_axis} {value:.4g}{unit}"
        if one.active:
            one.begins += 1
            one.begun_ns = now_ns
            is_above = rule.above is not None and value > rule.above
            limit = rule.above if is_above else rule.below
            message = f"rule {one.name}: {what}, {'above' if is_above else 'below'} {limit:g}{unit}"
            self._send(one, message, now_ns, value, t_ns, limit=limit, **({"snapshot": True} if rule.snapshot else {}))
        else:
            message = f"rule {one.name} ended: {what}"
            duration_s = round((now_ns - one.begun_ns) / NS_PER_S, 3)
            self._send(one, message, now_ns, value, t_ns, duration_s=duration_s)
        self._set_line(one.name)
        if words := rule.command if one.active else rule.end_command:
            self._run(one, words, message, value)

    def _send(
        self, one: DeviceRule, message: str, now_ns: int, value: float, t_ns: int, **detail: str | float | bool | None
    ) -> None:  # fmt: skip
        log.log(logging.WARNING if one.active else logging.INFO, "%s: %s", one.device, message)
        facts: dict[str, str | int | float | bool | None] = {
            "rule": one.name, "active": one.active, "measure": one.rule.measure, "value": value, "t_ns": t_ns,
        }  # fmt: skip
        self._context.owner.send_event(Event(now_ns, one.device, EventKind.RULE, message, facts | detail))

    def _end_all(self, device: WatchedDevice, reason: str) -> None:
        """End the active rules of a device without a command."""
        for one in device.rules:
            if one.active:
                one.active = False
                now_ns = self._context.clock.now_ns()
                value = one.limit.load().value
                duration_s = round((now_ns - one.begun_ns) / NS_PER_S, 3)
                self._send(one, f"rule {one.name} ended: {reason}", now_ns, value, now_ns, duration_s=duration_s)
                self._set_line(one.name)

    def _set_line(self, name: str) -> None:
        line = self._lines.get(name)
        if line is not None:
            line.set(any(one.active for device in self._devices.values() for one in device.rules if one.name == name))

    def _run(self, one: DeviceRule, words: list[str], message: str, value: float) -> None:
        """Run a command with the facts of the event in its environment. Replace arguments such as `{value}`."""
        facts = {
            "rule": one.name, "device": one.device, "active": str(int(one.active)), "measure": one.rule.measure,
            "value": f"{value:.9g}", "message": message,
        }  # fmt: skip
        argv = [facts.get(word[1:-1], word) if word[:1] == "{" and word[-1:] == "}" else word for word in words]
        environment = {f"IMUD_{name.upper()}": text for name, text in facts.items()}
        self._runner.run(argv, environment, lambda end: self._command_ended(one, end))

    def _command_ended(self, one: DeviceRule, end: CommandEnd) -> None:
        """Log the end of a command. A failure is also an event."""
        last = f"; last line: {end.last_line}" if end.last_line else ""
        message = f"command of rule {one.name}: {end.words}{last}"
        if end.result is Result.OK:
            log.info("%s: %s", one.device, message)
            return
        log.warning("%s: %s", one.device, message)
        detail: dict[str, str | int | float | bool | None] = {"rule": one.name, "result": end.result.value}
        now_ns = self._context.clock.now_ns()
        self._context.owner.send_event(Event(now_ns, one.device, EventKind.RULE, message, detail))

    def _action_problem(self, rule: RuleOptions) -> str:
        if rule.snapshot and not self._context.outputs.flights:
            return "snapshot: the flight recorder does not run; set recorder.flight.enabled"
        return ""


_TICK_VALUES: Final[dict[str, Callable[[Rules, WatchedDevice, DeviceRule, int], float | None]]] = {
    "silence_s": Rules._silence,
    "lost_samples": Rules._lost,
    "sample_rate_hz": Rules._rate,
}
