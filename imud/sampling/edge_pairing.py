"""Pairing of edges with samples. It tolerates the loss of edges and of samples.

An event is a pulse on SOUT or a trigger on SIN, with the time stamp of the kernel and the number of its rising edge or
trigger. A count of events would be wrong after the first loss. The device time shows the number of periods between two
samples. The line through the paired events (`EdgeTracker`) therefore predicts the event of each sample. The nearest
event in a narrow window is the event of the sample. Earlier events belong to no sample. A sample without an event in
its window lost its event.

At the start, the fit of arrivals predicts the events. If its error is below half a period, the module compares eight
samples with their nearest events, and starts a line through most of them. A line that is wrong by whole periods is
found later, if the fit is more accurate or if events arrive after their frames.

`MarkPairing` assigns pulses on SOUT_DIV to samples. Users trigger cameras with these pulses.
"""

from collections import deque
from collections.abc import Sequence
from math import inf
from statistics import median
from typing import Final

from imud.contracts.lines import Edge, Mark
from imud.model.units import NS_PER_US

REACH: Final = 0.45  # maximum distance of an event from its predicted time, as a share of a period
SURE: Final = 1.4  # factor for the error of the fit that must be within REACH before the fit selects the first events
# window around the predicted time: WINDOW_NS plus WINDOW_SPREADS times the spread of the events
WINDOW_NS: Final = 30 * NS_PER_US
WINDOW_SPREADS: Final = 8
FIRST: Final = 8
AGREE: Final = 6  # number of the FIRST samples that must agree
AGREE_NS: Final = 150 * NS_PER_US
AGREE_SHARE: Final = 0.1  # maximum distance of agreeing events from their median, in ns or as a share of a period
MISSES_MOST: Final = 8  # number of consecutive samples without an event after which the line is dropped
WRONG: Final = 0.75
WRONG_MOST: Final = 64  # number of consecutive samples with a fit off by WRONG periods after which the line is wrong
# Maximum difference of the slopes of line and fit. A larger difference means that the events belong to other samples.
SLOPE_OFF_MOST: Final = 0.12
LEARNED: Final = 16  # number of pairs after which the delay of the fit behind the events is known
QUEUE_MOST: Final = 4096  # maximum number of events that wait for their frame: 4 s at 1 kHz
TRACKED: Final = 32  # number of events in the memory of the tracker
SMOOTHING: Final = 1 / 32
FIRST_SPREAD_NS: Final = 10 * NS_PER_US
MARK_REACH: Final = 0.5  # maximum distance of a sample from its pulse, as a share of a period
MARKS_KEPT: Final = 1024  # maximum number of marks for the reader, and of pulses that wait for their sample
# gains of the n-th of equally weighted points on a line
_LEVEL_GAIN: Final = (1.0, 1.0, *(2 * (2 * n - 1) / (n * (n + 1)) for n in range(2, TRACKED + 1)))
_SLOPE_GAIN: Final = (0.0, 0.0, *(6 / (n * (n + 1)) for n in range(2, TRACKED + 1)))

EdgeStamp = tuple[int, int]  # time of a rising edge, ns, and its number


class PulseDecoder:
    """Decoder of edges into pulses of known width. A falling edge replaces a lost rising edge."""

    __slots__ = ("_risen", "_width_ns")

    def __init__(self, width_ns: int) -> None:
        self._width_ns = width_ns
        self._risen = 0

    def decode(self, edges: Sequence[Edge]) -> list[EdgeStamp]:
        """Return the pulses in `edges`. Compute a lost rising edge from the falling edge."""
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
    """Line from device time to host time through periodic events. It predicts the next event.

    The time stamps of edges are late by microseconds, not by milliseconds as arrivals. The line therefore follows their
    mean and not their lower envelope: first a fit with equal weights, then an alpha-beta filter over 32 events. It
    follows a crystal that drifts by 0.1 ppm/s within 0.1 µs at 10 Hz and above.
    """

    __slots__ = ("_count", "_device_ns", "_edge_ns", "_offset", "slope", "spread_ns")

    def __init__(self, device_ns: int, edge_ns: int, slope: float) -> None:
        self._device_ns = device_ns
        self._edge_ns = edge_ns
        # line at `_device_ns`, relative to `_edge_ns`: a float of ns since boot loses digits after some months
        self._offset = 0.0
        self._count = 1
        self.slope = slope  # host ns per device ns
        self.spread_ns = float(FIRST_SPREAD_NS)  # mean distance of events from their predicted time, ns

    def above(self, device_ns: int, edge_ns: int) -> float:
        """Return the delay of the event at `edge_ns` behind the line at `device_ns`, ns."""
        return edge_ns - self._edge_ns - self._offset - self.slope * (device_ns - self._device_ns)

    def due_ns(self, device_ns: int) -> int:
        """Return the predicted time of the event at `device_ns`, ns."""
        return self._edge_ns + int(self._offset + self.slope * (device_ns - self._device_ns))

    def add_edge(self, device_ns: int, edge_ns: int, above: float) -> None:
        """Follow an event `above` ns after its predicted time. `device_ns` must rise."""
        self._count = n = self._count + 1 if self._count < TRACKED else TRACKED
        self.slope += _SLOPE_GAIN[n] * above / (device_ns - self._device_ns)
        self._offset = (_LEVEL_GAIN[n] - 1.0) * above
        self._device_ns, self._edge_ns = device_ns, edge_ns
        self.spread_ns += ((above if above > 0 else -above) - self.spread_ns) * SMOOTHING

    def widen(self, above: float) -> None:
        """Add an event to the spread without following it."""
        self.spread_ns += (abs(above) - self.spread_ns) * SMOOTHING

    def set_spread(self, spread_ns: float) -> None:
        self.spread_ns = spread_ns


class EdgePairing:
    """Pairing of the events of one source with samples. `lead_ns` is the time from the event to the first byte of the
    frame."""

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
        self.delay_ns = float(lead_ns)  # delay of the fit of arrivals behind the events, ns
        self.delay_error_ns = 0.0  # one-sigma error of the fit at the newest pair, ns
        self.learned = False  # whether `delay_ns` comes from pairs
        self.due_ns = 0  # predicted time of the newest sample's event, ns; valid only while `running`
        self.spread_ns = float(FIRST_SPREAD_NS)  # mean distance of events from their predicted time, ns
        self.stamp_ns = 0
        self.number = 0  # Number of the newest paired event. `stamp_ns` is its time.
        self.misses = 0  # number of consecutive samples without an event
        self.events = 0
        self.events_unpaired = 0
        self.samples_unpaired = 0

    @property
    def running(self) -> bool:
        return self._tracker is not None

    def add_events(self, events: Sequence[EdgeStamp]) -> None:
        """Add events in order, before the frames that follow them."""
        queue = self._queue
        queue.extend(events)
        self.events += len(events)
        while len(queue) > QUEUE_MOST:
            queue.popleft()
            self.events_unpaired += 1

    def restart(self) -> None:
        """Restart with a new device time or fit. Keep the waiting events."""
        self.learned = False
        self._drop_line()

    def _drop_line(self) -> None:
        """Drop the line. Keep the delay from the events to the fit if it is learned."""
        self._tracker = None
        self._first.clear()
        self.misses = self._wrong = 0
        if not self.learned:
            self._pairs = 0
            self.delay_ns = float(self._lead_ns)

    def pair(
        self, device_ns: int, arrival_ns: int, fit_ns: int, fit_error_ns: float, period_ns: float, slope: float
    ) -> bool:
        """Find the event of the sample at `device_ns`. Return whether `stamp_ns` and `number` are this event.

        `arrival_ns` is the latest start of the sample's frame. `fit_ns` is its time according to the fit,
        `fit_error_ns` the one-sigma error. `period_ns` is the time between samples, 0 if unknown.
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
        """Compare a pair with the fit of arrivals. If they contradict each other, drop the line and return False."""
        if self._pairs:
            self.delay_ns += (delay_ns - self.delay_ns) * SMOOTHING
        else:
            self.delay_ns = float(delay_ns)
        self._pairs += 1
        if late or abs(self.delay_ns - self._lead_ns) > most:  # an event after its frame, or a wrong period
            self._wrong += 1
            if self._wrong >= WRONG_MOST:
                self.restart()
                return False
        else:
            self._wrong = 0
            self.learned = self.learned or self._pairs >= LEARNED
        return True

    def skip(self, device_ns: int) -> None:
        if self._tracker is not None:
            self.due_ns = self._tracker.due_ns(device_ns)

    def _nearest(self, tracker: EdgeTracker, device_ns: int, reach: float) -> bool:
        """Find and follow the event nearest to the predicted time. Return whether it is in the window."""
        # Drop the earlier events.
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
            tracker.widen(min(abs(best_off), 2 * window))  # one wrong event must not widen the window
            self.spread_ns = tracker.spread_ns
            return False
        self.stamp_ns, self.number = best
        tracker.add_edge(device_ns, best[0], best_off)
        self.spread_ns = tracker.spread_ns
        return True

    def _acquire(self, device_ns: int, due_ns: int, period_ns: float, slope: float) -> None:
        """Store the nearest event. Start a line if enough events agree."""
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
        """Add rising edges in order, before the frames that follow them."""
        self._waiting.extend(pulses)

    def add_sample(self, t_ns: int, seq: int, period_ns: float) -> None:
        """Add sample `seq`, with its real or possible pulse at `t_ns`. Add the samples in order."""
        waiting, reach = self._waiting, MARK_REACH * period_ns
        if not period_ns:
            return
        while waiting and waiting[0][0] < t_ns + reach:
            at_ns, number = waiting.popleft()
            self._found.append(Mark(at_ns, number, seq if at_ns >= t_ns - reach else None))

    def take_marks(self) -> list[Mark]:
        """Return the new pulses with their sample, in order. Each pulse is returned once."""
        marks = list(self._found)
        self._found.clear()
        return marks
