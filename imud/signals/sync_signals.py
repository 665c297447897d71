"""The lines of one device: SOUT, SOUT_DIV, PPS and SIN tell its clock when, ALARM that something is wrong.

Edges reach the clock before the frame that follows them: `drain` is called right before what was read is fed.
A line that fails costs the device nothing but what the line told; it is opened again when it can be.
"""

from collections.abc import Callable, Mapping, Sequence
from time import monotonic_ns
from typing import Final

from imud.clock import SampleClock
from imud.contracts.lines import DeviceLines, Edge, LineFactory
from imud.contracts.status import LinesStatus
from imud.contracts.timing import Mark, TriggerStamp
from imud.errors import CommandError, LinkError
from imud.event import EventKind, RaiseEvent
from imud.sample import Sample
from imud.signals.alarm_watch import AlarmWatch
from imud.signals.reset import ResetLine
from imud.signals.trigger import Trigger
from imud.signals.watched_line import RETRY_NS, WatchedLine
from imud.units import NS_PER_MS

ALARM_STATUS: Final = 1 << 31
"""Bit of `Sample.status` that is imud's own: the ALARM line was active. The devices' own bits are below 2¹⁶."""
WITH_FRAMES: Final = ("sout", "sout_div")
"""Lines whose edges are of use only together with frames: waking up for each would cost as much as for a frame."""
OnPulses = Callable[[Sequence[Edge]], None]


class SyncSignals:
    """Owns the lines of one device. Synchronization: the loop's thread only."""

    def __init__(
        self,
        device: str,
        lines: DeviceLines,
        maker: LineFactory,
        raise_event: RaiseEvent,
        on_pulses: OnPulses | None = None,
    ) -> None:
        """`on_pulses` is told the edges of PPS besides the clock."""
        self._raise_event = raise_event
        self._on_pulses = on_pulses
        self._clock: SampleClock | None = None
        self._alarm = AlarmWatch(raise_event)
        self._watched: dict[str, WatchedLine] = {}
        for key, take in (
            ("sout", self._on_sout),
            ("sout_div", self._on_divided),
            ("pps", self._on_pps),
            ("alarm", self._on_alarm),
        ):
            settings = getattr(lines, key)
            if settings is not None:
                on_level = self._on_alarm_level if key == "alarm" else _ignore
                line = maker.make_input(settings, f"{device} {key}", key != "alarm")
                self._watched[key] = WatchedLine(
                    line, take, on_level, self._complainer(key), watch=key not in WITH_FRAMES
                )
        self._drained = [watched for key, watched in self._watched.items() if key != "alarm"]
        self._sin = maker.make_output(lines.sin, f"{device} sin") if lines.sin is not None else None
        self._trigger: Trigger | None = None
        if self._sin is not None and lines.sin is not None:
            pulse_ns = round(lines.sin.pulse_ms * NS_PER_MS)
            self._trigger = Trigger(self._sin, lines.sin.rate_hz, pulse_ns=pulse_ns)
        self._triggering = False
        self._trigger_due_ns = 0
        self._trigger_problem = ""
        self._stopped = False

    def start(self, clock: SampleClock) -> None:
        """The device is found: what the lines tell is for this clock, and SIN is driven."""
        self._clock = clock
        self._show_alarm()
        self.tick(monotonic_ns())

    def settings(self, settings: Mapping[str, str]) -> None:
        """What the device is set to, as read back: what its ALARM line should say follows from that."""
        self._alarm.settings(settings)

    def drain(self) -> None:
        """Give the clock all edges there are. Does not wait; one system call per line."""
        for watched in self._drained:
            watched.drain()
        if self._trigger is not None:
            self._trigger.drain()

    def tick(self, now_ns: int, newest: Sample | None = None) -> None:
        """Ten times a second, with the device's newest sample: open what is to be opened, tell what has gathered."""
        if self._stopped:
            return
        for watched in self._watched.values():
            watched.tick(now_ns)
        self._alarm.tick(now_ns, newest)
        clock = self._clock
        if clock is None:
            return
        if self._trigger is not None and not self._triggering and now_ns >= self._trigger_due_ns:
            self._start_trigger(now_ns)
        for mark in clock.take_marks():
            self._tell_mark(mark)

    def rest(self) -> None:
        """The device's link ended: SIN is left inactive, and what the other lines tell is for no clock."""
        self._clock = None
        if self._trigger is not None and self._sin is not None:
            self._trigger.stop()
            self._sin.close()
            self._triggering = False
            self._trigger_due_ns = 0

    def stop(self) -> None:
        """Let go of all lines for good; may be called twice."""
        self._stopped = True
        self.rest()
        for watched in self._watched.values():
            watched.close()

    def trigger_once(self) -> None:
        """Make one edge on SIN besides those of its rate. Raises CommandError."""
        if self._trigger is None:
            raise CommandError("trigger: expected the key sin below lines of the device, got none")
        try:
            self._trigger.once()
        except LinkError as error:
            raise CommandError(f"trigger: {error}") from error

    @property
    def can_trigger(self) -> bool:
        """Whether there is a line to SIN."""
        return self._trigger is not None

    def status(self, reset: ResetLine | None = None) -> LinesStatus:
        """How the lines are doing, that of reset included."""
        problems = {key: watched.problem for key, watched in self._watched.items() if watched.problem}
        if self._trigger_problem:
            problems["sin"] = self._trigger_problem
        if reset is not None and reset.problem:
            problems["reset"] = reset.problem
        if self._alarm.problem:
            problems.setdefault("alarm", self._alarm.problem)
        counts = self._trigger.counts if self._trigger is not None else None
        return LinesStatus(
            problems=problems,
            edges={key: watched.edges for key, watched in self._watched.items()},
            edges_lost={key: watched.line.edges_lost for key, watched in self._watched.items()},
            alarm=self._alarm.line.active,
            alarms=self._alarm.line.raised,
            sin=self._trigger is not None,
            triggers=counts.edges if counts else 0,
            triggers_missed=counts.missed if counts else 0,
            trigger_late_mean_ns=round(counts.mean_late_ns) if counts else 0,
            trigger_late_worst_ns=counts.worst_late_ns if counts else 0,
            trigger_late_sum_ns=counts.sum_late_ns if counts else 0,
        )

    # --- what the lines tell -----------------------------------------------------------------------------------------

    def _on_sout(self, edges: Sequence[Edge]) -> None:
        if self._clock is not None:
            self._clock.edges(edges)

    def _on_divided(self, edges: Sequence[Edge]) -> None:
        if self._clock is not None:
            self._clock.divided(edges)

    def _on_pps(self, edges: Sequence[Edge]) -> None:
        if self._clock is not None:
            self._clock.pulses(edges)
        if self._on_pulses is not None:
            self._on_pulses(edges)

    def _on_stamps(self, stamps: Sequence[TriggerStamp]) -> None:
        if self._clock is not None:
            self._clock.triggers(stamps)

    def _on_alarm(self, edges: Sequence[Edge]) -> None:
        self._alarm.edges(edges)
        self._show_alarm()

    def _on_alarm_level(self, active: bool | None) -> None:
        self._alarm.level(monotonic_ns(), active)
        self._show_alarm()

    def _show_alarm(self) -> None:
        """In the samples from now on."""
        if self._clock is not None:
            self._clock.own_status = ALARM_STATUS if self._alarm.line.active else None

    def _tell_mark(self, mark: Mark) -> None:
        words = f"sample {mark.seq}" if mark.seq is not None else "a sample that was lost"
        self._raise_event(
            mark.t_ns, EventKind.MARK, f"pulse {mark.number} on SOUT_DIV belongs to {words}",
            t_ns=mark.t_ns, edge_seq=mark.number, seq=mark.seq,
        )  # fmt: skip

    # --- SIN ---------------------------------------------------------------------------------------------------------

    def _start_trigger(self, now_ns: int) -> None:
        assert self._trigger is not None
        assert self._sin is not None
        try:
            self._sin.open()
        except LinkError as error:
            self._end_trigger(error, now_ns)
            return
        self._trigger_problem = ""
        self._triggering = True
        self._trigger.start(self._on_stamps, self._end_trigger)

    def _end_trigger(self, error: LinkError, now_ns: int | None = None) -> None:
        assert self._sin is not None
        self._sin.close()
        self._triggering = False
        self._trigger_due_ns = (monotonic_ns() if now_ns is None else now_ns) + RETRY_NS
        if str(error) != self._trigger_problem:
            self._trigger_problem = str(error)
            self._complainer("sin")(self._trigger_problem)

    def _complainer(self, key: str) -> Callable[[str], None]:
        return lambda problem: self._raise_event(monotonic_ns(), EventKind.LINK, f"line {key}: {problem}", line=key)


def _ignore(_active: bool | None) -> None:
    """The level of a line that tells by its edges."""
