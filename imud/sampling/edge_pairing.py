"""Pairing of edges with samples, robust against the loss of either.

An event is a pulse on SOUT or a trigger on SIN; its stamp is the kernel's, its number that of its rising edge or of the
trigger. Counting alone goes wrong with the first loss. Device time says how many periods lie between two samples, so
the line through the events paired so far (`EdgeTracker`) predicts when the event of each sample is due; the nearest
event within a narrow window is its own, those passed over belong to no sample, and a sample without one in its window
lost it. To begin with, the fit of arrivals predicts: as soon as its error is below half a period, eight samples are
compared with their nearest events, and a line through most of them is the beginning. A line that is off by whole
periods, because the fit was, is found when the fit is known better, and by events that come after their message.

Pulses on SOUT_DIV are only assigned to samples (`MarkPairing`): cameras are triggered by them.
"""

from collections import deque
from collections.abc import Sequence
from math import inf
from statistics import median
from typing import Final

from imud.contracts.lines import Edge, Mark
from imud.model.units import NS_PER_US

REACH: Final = 0.45
"""Share of a period; an event further off than this belongs to another sample."""
SURE: Final = 1.4
"""The fit may choose the events of the first samples when this multiple of its error is within reach."""
WINDOW_NS: Final = 30 * NS_PER_US
WINDOW_SPREADS: Final = 8
FIRST: Final = 8
AGREE: Final = 6
"""AGREE of the FIRST samples must agree."""
AGREE_NS: Final = 150 * NS_PER_US
AGREE_SHARE: Final = 0.1
"""Tolerance of agreement in ns, or as a share of a period."""
MISSES_MOST: Final = 8
"""Number of samples in a row without an event after which the line is dropped."""
WRONG: Final = 0.75
WRONG_MOST: Final = 64
"""The line is wrong when the fit is off by this share of a period for that many samples in a row."""
SLOPE_OFF_MOST: Final = 0.12
"""A line whose slope differs from the fit's by more went through the events of other samples: past two crystals."""
LEARNED: Final = 16
"""Number of pairs from which the delay of the fit behind the events is known."""
QUEUE_MOST: Final = 4096
"""Events that wait for their message: 4 s at 1 kHz."""
TRACKED: Final = 32
"""Length of the tracker's memory, in events."""
SMOOTHING: Final = 1 / 32
FIRST_SPREAD_NS: Final = 10 * NS_PER_US
MARK_REACH: Final = 0.5
"""Share of a period; a sample further off than this is not the mark's."""
MARKS_KEPT: Final = 1024
"""Most marks that are kept for the reader, and most pulses that wait for their sample."""
_LEVEL_GAIN: Final = (1.0, 1.0, *(2 * (2 * n - 1) / (n * (n + 1)) for n in range(2, TRACKED + 1)))
# gains of the n-th of equally weighted points on a line
_SLOPE_GAIN: Final = (0.0, 0.0, *(6 / (n * (n + 1)) for n in range(2, TRACKED + 1)))

EdgeStamp = tuple[int, int]
"""(CLOCK_MONOTONIC of a rising edge, its number)."""


class PulseDecoder:
    """Decoder of edges into pulses of known width: a falling edge stands in for a lost rising one."""

    __slots__ = ("_risen", "_width_ns")

    def __init__(self, width_ns: int) -> None:
        self._width_ns = width_ns
        self._risen = 0

    def decode(self, edges: Sequence[Edge]) -> list[EdgeStamp]:
        """Return the pulses in `edges`; one whose rising edge is missing is counted back from its falling edge."""
        pulses: list[EdgeStamp] = []
        for t_ns, rising, number in edges:
            if rising:
                self._risen = number
                pulses.append((t_ns, number))
            elif self._risen != number - 1:
                pulses.append((t_ns - self._width_ns, number - 1))
        return pulses


def rising_edges(edges: Sequence[Edge]) -> list[EdgeStamp]:
    """Return the rising edges, for pulses of unknown width."""
    return [(edge.t_ns, edge.number) for edge in edges if edge.rising]


class EdgeTracker:
    """A line from device time to host time through the stamps of periodic events; it predicts the next event.

    Unlike arrivals, stamps of edges are late by microseconds, so their mean is followed and not their lower envelope:
    at first a fit of equal weights, later one that forgets (alpha-beta filter), 32 events long. A crystal that drifts
    by 0.1 ppm/s is then followed within 0.1 µs at 10 Hz and above.
    """

    __slots__ = ("_count", "_device_ns", "_edge_ns", "_offset", "slope", "spread_ns")

    def __init__(self, device_ns: int, edge_ns: int, slope: float) -> None:
        self._device_ns = device_ns
        self._edge_ns = edge_ns
        # the line at `_device_ns`, above `_edge_ns`: floats of ns since boot lose digits after some months
        self._offset = 0.0
        self._count = 1
        self.slope = slope
        """Host ns per device ns."""
        self.spread_ns = float(FIRST_SPREAD_NS)
        """Mean distance of stamps from where they were due."""

    def above(self, device_ns: int, edge_ns: int) -> float:
        """Delay of the event at `edge_ns` behind the line at `device_ns`, ns."""
        return edge_ns - self._edge_ns - self._offset - self.slope * (device_ns - self._device_ns)

    def due_ns(self, device_ns: int) -> int:
        """Predict the time of the event at `device_ns`."""
        return self._edge_ns + int(self._offset + self.slope * (device_ns - self._device_ns))

    def add_edge(self, device_ns: int, edge_ns: int, above: float) -> None:
        """Follow an event `above` its due time; `device_ns` rises."""
        self._count = n = self._count + 1 if self._count < TRACKED else TRACKED
        self.slope += _SLOPE_GAIN[n] * above / (device_ns - self._device_ns)
        self._offset = (_LEVEL_GAIN[n] - 1.0) * above
        self._device_ns, self._edge_ns = device_ns, edge_ns
        self.spread_ns += ((above if above > 0 else -above) - self.spread_ns) * SMOOTHING

    def widen(self, above: float) -> None:
        """Count an event at this distance into the spread without following it."""
        self.spread_ns += (abs(above) - self.spread_ns) * SMOOTHING

    def set_spread(self, spread_ns: float) -> None:
        """Set the spread that the first events show."""
        self.spread_ns = spread_ns


class EdgePairing:
    """Pairing of the events of one source with samples.

    `lead_ns` is the time from the event to the first byte of the message.
    """

    __slots__ = (
        "_first", "_lead_ns", "_pairs", "_queue", "_tracker", "_wrong", "delay_error_ns", "delay_ns", "due_ns",
        "events", "events_unpaired", "learned", "misses", "number", "samples_unpaired", "spread_ns", "stamp_ns",
    )  # fmt: skip

    def __init__(self, lead_ns: int) -> None:
        self._lead_ns = lead_ns
        self._queue: deque[EdgeStamp] = deque()
        self._tracker: EdgeTracker | None = None
        self._first: list[tuple[int, int]] = []
        self._pairs = 0
        self._wrong = 0
        self.delay_ns = float(lead_ns)
        """Delay of the fit of arrivals behind the events, ns."""
        self.delay_error_ns = 0.0
        """One-sigma error of the fit when it was compared last."""
        self.learned = False
        """Whether `delay_ns` comes from pairs."""
        self.due_ns = 0
        """Predicted time of the newest sample's event; only while `running`."""
        self.spread_ns = float(FIRST_SPREAD_NS)
        """Mean distance of events from where they were due."""
        self.stamp_ns = 0
        self.number = 0
        """The event of the newest sample that was paired."""
        self.misses = 0
        """Samples in a row without event."""
        self.events = 0
        self.events_unpaired = 0
        self.samples_unpaired = 0

    @property
    def running(self) -> bool:
        """Whether there is a line through events."""
        return self._tracker is not None

    def add_events(self, events: Sequence[EdgeStamp]) -> None:
        """Add events in their order, before the messages that follow them."""
        queue = self._queue
        queue.extend(events)
        self.events += len(events)
        while len(queue) > QUEUE_MOST:
            queue.popleft()
            self.events_unpaired += 1

    def restart(self) -> None:
        """Forget all that is relative to device time or to the fit: either began anew. Events that wait stay."""
        self.learned = False
        self._drop_line()

    def _drop_line(self) -> None:
        """Drop the line; a learned delay of the fit behind the events still holds."""
        self._tracker = None
        self._first.clear()
        self.misses = self._wrong = 0
        if not self.learned:
            self._pairs = 0
            self.delay_ns = float(self._lead_ns)

    def pair(
        self, device_ns: int, arrival_ns: int, fit_ns: int, fit_error_ns: float, period_ns: float, slope: float
    ) -> bool:
        """Find the event of the sample at `device_ns`, whose message began at `arrival_ns` at the latest.

        `fit_ns` is its time by the fit of arrivals, one sigma `fit_error_ns`; `period_ns` between samples (0: unknown).
        Returns whether `stamp_ns` and `number` are its event's.
        """
        tracker = self._tracker
        reach = REACH * period_ns
        if tracker is None:
            if period_ns and SURE * fit_error_ns < reach:
                self._acquire(device_ns, fit_ns - int(self.delay_ns), period_ns, slope)
                self.skip(device_ns)
            return False
        self.due_ns = tracker.due_ns(device_ns)
        if not self._nearest(tracker, device_ns, reach):
            self.samples_unpaired += 1
            self.misses += 1
            if self.misses >= MISSES_MOST:
                self._drop_line()
            return False
        if abs(tracker.slope - slope) > SLOPE_OFF_MOST:
            self._drop_line()
            return False
        self.misses = 0
        self.delay_error_ns = fit_error_ns
        return self._learn(fit_ns - self.due_ns, late=self.stamp_ns > arrival_ns, most=WRONG * period_ns)

    def _learn(self, delay_ns: int, *, late: bool, most: float) -> bool:
        """Compare a pair with the fit of arrivals; drop the line and return False when they contradict."""
        if self._pairs:
            self.delay_ns += (delay_ns - self.delay_ns) * SMOOTHING
        else:
            self.delay_ns = float(delay_ns)
        self._pairs += 1
        if late or abs(self.delay_ns - self._lead_ns) > most:
            self._wrong += 1
            if self._wrong >= WRONG_MOST:
                self.restart()
                return False
        else:
            self._wrong = 0
            self.learned = self.learned or self._pairs >= LEARNED
        return True

    def skip(self, device_ns: int) -> None:
        """Pass over the sample at `device_ns`, which has no event."""
        if self._tracker is not None:
            self.due_ns = self._tracker.due_ns(device_ns)

    def _nearest(self, tracker: EdgeTracker, device_ns: int, reach: float) -> bool:
        """Find the event nearest to the predicted time, drop those before it; follow it if it is in the window."""
        queue = self._queue
        best, best_off = (0, 0), inf
        while queue:
            off = tracker.above(device_ns, queue[0][0])
            if off >= reach or off >= abs(best_off):
                break
            event = queue.popleft()
            if abs(off) < abs(best_off) and off > -reach:
                self.events_unpaired += best_off is not inf
                best, best_off = event, off
            else:
                self.events_unpaired += 1
        if best_off is inf:
            return False
        window = WINDOW_NS + WINDOW_SPREADS * tracker.spread_ns
        if abs(best_off) > window:
            self.events_unpaired += 1
            tracker.widen(min(abs(best_off), 2 * window))  # one stray event must not open the window
            self.spread_ns = tracker.spread_ns
            return False
        self.stamp_ns, self.number = best
        tracker.add_edge(device_ns, best[0], best_off)
        self.spread_ns = tracker.spread_ns
        return True

    def _acquire(self, device_ns: int, due_ns: int, period_ns: float, slope: float) -> None:
        """Note the nearest event; begin a line when enough agree."""
        reach, queue, first = REACH * period_ns, self._queue, self._first
        while queue and queue[0][0] < due_ns - reach:
            queue.popleft()
        if not queue or queue[0][0] > due_ns + reach or (first and device_ns <= first[-1][0]):
            return
        t_ns = queue.popleft()[0]
        while queue and abs(queue[0][0] - due_ns) < abs(t_ns - due_ns):
            t_ns = queue.popleft()[0]
        first.append((device_ns, t_ns))
        if len(first) < FIRST:
            return
        x0, t0 = first[0]
        offs = [t - t0 - slope * (x - x0) for x, t in first]
        middle, near = median(offs), max(AGREE_NS, AGREE_SHARE * period_ns)
        agreed = [point for point, off in zip(first, offs, strict=True) if abs(off - middle) <= near]
        del first[: len(first) // 2]
        if len(agreed) >= AGREE:
            spread_ns = sum(abs(off - middle) for off in offs if abs(off - middle) <= near) / len(agreed)
            self._begin(agreed, slope, spread_ns)

    def _begin(self, points: list[tuple[int, int]], slope: float, spread_ns: float) -> None:
        """Begin a line through the first pairs of (device ns, event ns)."""
        self._tracker = tracker = EdgeTracker(*points[0], slope)
        for device_ns, t_ns in points[1:]:
            tracker.add_edge(device_ns, t_ns, tracker.above(device_ns, t_ns))
        self.spread_ns = spread_ns + FIRST_SPREAD_NS
        tracker.set_spread(self.spread_ns)
        self._first.clear()
        self.misses = self._wrong = 0


class MarkPairing:
    """Pairing of pulses on SOUT_DIV with samples."""

    __slots__ = ("_found", "_waiting")

    def __init__(self) -> None:
        self._waiting: deque[EdgeStamp] = deque(maxlen=MARKS_KEPT)
        self._found: deque[Mark] = deque(maxlen=MARKS_KEPT)

    def add_pulses(self, pulses: Sequence[EdgeStamp]) -> None:
        """Add rising edges in their order, before the messages that follow them."""
        self._waiting.extend(pulses)

    def add_sample(self, t_ns: int, seq: int, period_ns: float) -> None:
        """Add sample `seq`, whose pulse was or would have been at `t_ns`; samples in their order."""
        waiting, reach = self._waiting, MARK_REACH * period_ns
        if not period_ns:
            return
        while waiting and waiting[0][0] < t_ns + reach:
            at_ns, number = waiting.popleft()
            self._found.append(Mark(at_ns, number, seq if at_ns >= t_ns - reach else None))

    def take_marks(self) -> list[Mark]:
        """Return the pulses whose samples are known by now, in order, each once."""
        marks = list(self._found)
        self._found.clear()
        return marks
