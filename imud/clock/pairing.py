"""Events of a line paired with the samples they belong to, whichever of both gets lost.

Counting alone goes wrong with the first loss. Device time says how many periods lie between two samples, so the line
through the events paired so far (`tracker`) says when the event of each sample is due; the nearest event within a
narrow window is its own, those passed over belong to no sample, and a sample without one in its window lost it.
To begin with, the clock's fit of arrivals says when: as soon as it is surer than half a period, eight samples are
compared with their nearest events, and a line through most of them is the beginning. A line that is off by whole
periods, because the fit was, is found by the fit's better knowledge later, and by events that come after their message.
"""

from collections import deque
from collections.abc import Sequence
from math import inf
from statistics import median
from typing import Final

from imud.clock.pulses import Stamp
from imud.clock.tracker import FIRST_SPREAD_NS, Tracker
from imud.units import NS_PER_US

REACH: Final = 0.45
"""Share of a period; an event further off than this belongs to another sample."""
SURE: Final = 1.4
"""The fit may choose the events of the first samples when so many of its errors are within reach."""
WINDOW_NS: Final = 30 * NS_PER_US
WINDOW_SPREADS: Final = 8
FIRST: Final = 8
AGREE: Final = 6
"""Of the first so many samples, so many must agree."""
AGREE_NS: Final = 150 * NS_PER_US
AGREE_SHARE: Final = 0.1
"""They agree within this much, or this share of a period."""
MISSES_MOST: Final = 8
"""After so many samples in a row without an event the line is given up."""
WRONG: Final = 0.75
WRONG_MOST: Final = 64
"""The line is wrong when for so many samples in a row the fit is off by this share of a period."""
SLOPE_OFF_MOST: Final = 0.12
"""A line whose slope differs from the fit's by more went through the events of other samples: past two crystals."""
LEARNED: Final = 16
"""So many pairs say how far the fit is behind the events."""
QUEUE_MOST: Final = 4096
"""Events that wait for their message: 4 s at 1 kHz."""
SMOOTHING: Final = 1 / 32


class Pairing:
    """The events of one line, and which sample each belongs to."""

    __slots__ = (
        "_first", "_pairs", "_queue", "_tracker", "_wrong", "delay_error_ns", "delay_ns", "due_ns", "events",
        "events_unpaired", "lead_ns", "learned", "misses", "number", "samples_unpaired", "spread_ns", "stamp_ns",
    )  # fmt: skip

    def __init__(self, lead_ns: int) -> None:
        self.lead_ns = lead_ns
        """From the event to the first byte of the message."""
        self._queue: deque[Stamp] = deque()
        self._tracker: Tracker | None = None
        self._first: list[tuple[int, int]] = []
        self._pairs = 0
        self._wrong = 0
        self.delay_ns = float(lead_ns)
        """How much later than the events the fit of arrivals is."""
        self.delay_error_ns = 0.0
        """One-sigma error of the fit when it was compared last."""
        self.learned = False
        """Whether `delay_ns` comes from pairs."""
        self.due_ns = 0
        """When the event of the newest sample was due; only while `running`."""
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

    def give(self, events: Sequence[Stamp]) -> None:
        """Events in their order, before the messages that follow them."""
        queue = self._queue
        queue.extend(events)
        self.events += len(events)
        while len(queue) > QUEUE_MOST:
            queue.popleft()
            self.events_unpaired += 1

    def restart(self) -> None:
        """Device time began anew, or the fit did: nothing is known of it any more. Events that wait stay."""
        self.learned = False
        self._give_up()

    def _give_up(self) -> None:
        """No line any more; how far the fit is behind the events still holds if it was learned."""
        self._tracker = None
        self._first.clear()
        self.misses = self._wrong = 0
        if not self.learned:
            self._pairs = 0
            self.delay_ns = float(self.lead_ns)

    def pair(self, x: int, y: int, fit_ns: int, fit_error_ns: float, period_ns: float, slope: float) -> bool:
        """Look for the event of the sample at device time `x`, whose message began no later than `y`.

        `fit_ns` is its time by the fit of arrivals, one sigma `fit_error_ns`; `period_ns` between samples (0: unknown).
        Returns whether `stamp_ns` and `number` are its event's.
        """
        tracker = self._tracker
        reach = REACH * period_ns
        if tracker is None:
            if period_ns and SURE * fit_error_ns < reach:
                self._acquire(x, fit_ns - int(self.delay_ns), period_ns, slope)
                self.skip(x)
            return False
        self.due_ns = tracker.at(x)
        if not self._nearest(tracker, x, reach):
            self.samples_unpaired += 1
            self.misses += 1
            if self.misses >= MISSES_MOST:
                self._give_up()
            return False
        if abs(tracker.slope - slope) > SLOPE_OFF_MOST:
            self._give_up()
            return False
        self.misses = 0
        self.delay_error_ns = fit_error_ns
        return self._learn(fit_ns - self.due_ns, late=self.stamp_ns > y, most=WRONG * period_ns)

    def _learn(self, delay_ns: int, *, late: bool, most: float) -> bool:
        """Compare a pair with the fit of arrivals; returns False, and gives the line up, when they contradict."""
        if self._pairs:
            self.delay_ns += (delay_ns - self.delay_ns) * SMOOTHING
        else:
            self.delay_ns = float(delay_ns)
        self._pairs += 1
        if late or abs(self.delay_ns - self.lead_ns) > most:
            self._wrong += 1
            if self._wrong >= WRONG_MOST:
                self.restart()
                return False
        else:
            self._wrong = 0
            self.learned = self.learned or self._pairs >= LEARNED
        return True

    def skip(self, x: int) -> None:
        """The sample at `x` has no event."""
        if self._tracker is not None:
            self.due_ns = self._tracker.at(x)

    def _nearest(self, tracker: Tracker, x: int, reach: float) -> bool:
        """Find the event nearest to where it is due, drop those before it; follow it if it is in the window."""
        queue = self._queue
        best, best_off = (0, 0), inf
        while queue:
            off = tracker.above(x, queue[0][0])
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
            tracker.judge(min(abs(best_off), 2 * window))  # one stray event must not open the window
            self.spread_ns = tracker.spread_ns
            return False
        self.stamp_ns, self.number = best
        tracker.take(x, best[0], best_off)
        self.spread_ns = tracker.spread_ns
        return True

    def _acquire(self, x: int, due_ns: int, period_ns: float, slope: float) -> None:
        """Note the nearest event; begin a line when enough agree."""
        reach, queue, first = REACH * period_ns, self._queue, self._first
        while queue and queue[0][0] < due_ns - reach:
            queue.popleft()
        if not queue or queue[0][0] > due_ns + reach or (first and x <= first[-1][0]):
            return
        t_ns = queue.popleft()[0]
        while queue and abs(queue[0][0] - due_ns) < abs(t_ns - due_ns):
            t_ns = queue.popleft()[0]
        first.append((x, t_ns))
        if len(first) < FIRST:
            return
        x0, t0 = first[0]
        offs = [t - t0 - slope * (x - x0) for x, t in first]
        middle, near = median(offs), max(AGREE_NS, AGREE_SHARE * period_ns)
        agreed = [point for point, off in zip(first, offs, strict=True) if abs(off - middle) <= near]
        del first[: len(first) // 2]
        if len(agreed) >= AGREE:
            self._begin(
                agreed, slope, sum(abs(off - middle) for off in offs if abs(off - middle) <= near) / len(agreed)
            )

    def _begin(self, points: list[tuple[int, int]], slope: float, spread_ns: float) -> None:
        self._tracker = tracker = Tracker(*points[0], slope)
        for x, t_ns in points[1:]:
            tracker.take(x, t_ns, tracker.above(x, t_ns))
        tracker.spread_ns = self.spread_ns = spread_ns + FIRST_SPREAD_NS
        self._first.clear()
        self.misses = self._wrong = 0
