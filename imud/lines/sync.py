"""Synchronization lines of one device: SOUT, SOUT_DIV, PPS and SIN for its clock, ALARM for its status.

The clock must receive an edge before the frame that follows it. The path therefore calls `drain` before it decodes the
data of a read. A failed line affects only its own function. imud opens it again when possible.
"""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, Final

from imud.contracts.command import Proof, Verb
from imud.contracts.lines import (
    RESET_VERB,
    TRIGGER_VERB,
    AlarmRanges,
    DeviceLines,
    Edge,
    LineFactory,
    Mark,
    PulseReceiver,
)
from imud.contracts.status import LinesStatus
from imud.host.clock import HostClock
from imud.lines.alarm import AlarmMonitor
from imud.lines.reset import ResetLine
from imud.lines.trigger import SinTrigger, TriggerCounts
from imud.lines.watched_line import WatchedLine
from imud.model.errors import CommandError, LinkError
from imud.model.event import EventKind, RaiseEvent
from imud.model.sample import Sample
from imud.sampling.clock import SampleClock

# Bit of `Sample.status` that imud sets while the ALARM line is active. The bits of devices are below 2¹⁶.
ALARM_STATUS: Final = 1 << 31
# Lines whose edges imud needs only together with frames. The event loop does not wake up for these edges, because a
# wake-up needs as much CPU time as a frame.
WITH_FRAMES: Final = ("sout", "sout_div")


class SyncSignals:
    """Lines of one device, except reset and data ready. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        device: str,
        lines: DeviceLines,
        factory: LineFactory,
        raise_event: RaiseEvent,
        host: HostClock,
        pulses: PulseReceiver | None = None,
    ) -> None:
        """`pulses` receives the edges of PPS after the clock."""
        self._raise_event, self._host = raise_event, host
        self._pulses = pulses
        self._clock: SampleClock | None = None
        self._alarm = AlarmMonitor(raise_event)
        self._closed = False
        self._watched: dict[str, WatchedLine] = {}
        for key in ("sout", "sout_div", "pps", "alarm"):
            settings = getattr(lines, key)
            if settings is not None:
                line = factory.make_input(settings, f"{device} {key}", key != "alarm")
                self._watched[key] = WatchedLine(line, key, self, host, watch=key not in WITH_FRAMES)
        self._drained = [watched for key, watched in self._watched.items() if key != "alarm"]
        self._sin: SinTrigger | None = None
        if lines.sin is not None:
            output = factory.make_output(lines.sin, f"{device} sin")
            self._sin = SinTrigger(output, lines.sin, raise_event, host, factory.start_worker)

    def start(self, clock: SampleClock) -> None:
        """Deliver edges to the clock of the detected device, and drive SIN."""
        self._clock = clock
        if self._sin is not None:
            self._sin.start(clock)
        self._show_alarm()
        self.tick(self._host.now_ns(), None)

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Open due lines, raise pending events, and compare ALARM with the newest sample. Call this method at 10 Hz."""
        if self._closed:
            return
        for watched in self._watched.values():
            watched.tick(now_ns)
        self._alarm.tick(now_ns, newest)
        clock = self._clock
        if clock is None:
            return
        if self._sin is not None:
            self._sin.tick(now_ns)
        for mark in clock.take_marks():
            self._raise_mark(mark)

    def stop(self) -> None:
        """Release SIN and drop further edges: the device's link was closed. A second call does nothing."""
        self._clock = None
        if self._sin is not None:
            self._sin.stop()

    def close(self) -> None:
        """Release all lines. `tick` does not open them again. A second call does nothing."""
        self._closed = True
        self.stop()
        for watched in self._watched.values():
            watched.close()

    def drain(self) -> None:
        """Deliver all buffered edges and trigger stamps to the clock. Do not block: one system call per line."""
        for watched in self._drained:
            watched.drain()
        if self._sin is not None:
            self._sin.drain()

    def set_alarm_ranges(self, ranges: AlarmRanges | None) -> None:
        """Set the ranges that ALARM indicates according to the device settings. None disables the check."""
        self._alarm.set_ranges(ranges)

    def trigger_once(self) -> None:
        """Make one additional edge on SIN. Raises CommandError."""
        if self._sin is None:
            raise CommandError("trigger: expected the key lines.sin of the device, got none")
        try:
            self._sin.once()
        except LinkError as error:
            raise CommandError(f"trigger: {error}") from error

    @property
    def can_trigger(self) -> bool:
        return self._sin is not None

    def status(self, reset: ResetLine | None = None) -> LinesStatus:
        """Return the state and the counters of the lines. `reset` adds the problem of the reset line."""
        watched, sin = self._watched, self._sin
        problems = {key: line.problem for key, line in watched.items() if line.problem}
        if sin is not None and sin.problem:
            problems["sin"] = sin.problem
        if reset is not None and reset.problem:
            problems["reset"] = reset.problem
        if self._alarm.problem:
            problems.setdefault("alarm", self._alarm.problem)
        counts = sin.counts if sin is not None else TriggerCounts()
        return LinesStatus(
            problems=problems,
            edges={key: line.edges for key, line in watched.items()},
            edges_lost={key: line.edges_lost for key, line in watched.items()},
            alarm=self._alarm.line.active,
            alarms=self._alarm.line.raised,
            sin=sin is not None,
            triggers=counts.edges,
            triggers_missed=counts.missed,
            trigger_late_mean_ns=round(counts.mean_late_ns),
            trigger_late_worst_ns=counts.worst_late_ns,
            trigger_late_sum_ns=counts.sum_late_ns,
        )

    # --- events of the lines -----------------------------------------------------------------------------------------

    def on_edges(self, key: str, edges: Sequence[Edge]) -> None:
        if key == "alarm":
            self._alarm.line.on_edges(edges)
            self._show_alarm()
            return
        if key != "sout_div":
            self._host.utc_offset_ns()  # updates the steady time, by which the clock converts the edges
        if self._clock is not None:
            self._clock.add_edges(key, edges)
        if key == "pps" and self._pulses is not None:
            self._pulses.on_pulses(edges)

    def on_level(self, key: str, active: bool | None) -> None:
        """Follow the level of ALARM. The edges of the other lines carry the information."""
        if key == "alarm":
            self._alarm.line.on_level(self._host.now_ns(), active)
            self._show_alarm()

    def on_line_report(self, key: str, message: str) -> None:
        self._raise_event(self._host.now_ns(), EventKind.LINK, f"line {key}: {message}", line=key)

    def _show_alarm(self) -> None:
        if self._clock is not None:
            self._clock.set_own_status(ALARM_STATUS if self._alarm.line.active else None)

    def _raise_mark(self, mark: Mark) -> None:
        words = f"sample {mark.seq}" if mark.seq is not None else "a lost sample"
        self._raise_event(
            mark.t_ns, EventKind.MARK, f"pulse {mark.number} on SOUT_DIV belongs to {words}",
            t_ns=mark.t_ns, edge_seq=mark.number, seq=mark.seq,
        )  # fmt: skip


def _no_script(_target: object) -> None:
    raise AssertionError("a line is driven by `LineVerbs.run`")


RESET: Final = Verb("pulse the reset line, and wait until the device works again", _no_script, proof=Proof.RESTART)
TRIGGER: Final = Verb("make one additional edge on SIN", _no_script, proof=Proof.ONE_SAMPLE)


class LineVerbs:
    """Verbs that use the GPIO lines of one device. Synchronization: the event loop's thread only."""

    def __init__(self, reset: ResetLine | None, signals: SyncSignals | None) -> None:
        self.rows: dict[str, Verb] = {}  # verbs by name
        self._coroutines: dict[str, Callable[[], Awaitable[None]]] = {}
        if reset is not None:
            self.rows[RESET_VERB], self._coroutines[RESET_VERB] = RESET, reset.pulse
        if signals is not None and signals.can_trigger:

            async def trigger() -> None:
                signals.trigger_once()

            self.rows[TRIGGER_VERB], self._coroutines[TRIGGER_VERB] = TRIGGER, trigger

    async def run(self, name: str, arguments: Mapping[str, Any]) -> object:
        """Run a verb. It returns None. Raises BadArgument, CommandError."""
        self.rows[name].arguments(arguments)
        await self._coroutines[name]()
        return None
