"""Meters of one device: rate, latency, loss by cause. Plain integers, evaluated when they are read."""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence

from imud.contracts.status import LATENCY_BOUNDS_NS
from imud.ledger import Ledger
from imud.sample import Sample
from imud.units import NS_PER_S

RATE_WINDOW_NS = 2 * NS_PER_S
"""The rate shown is that of the last two seconds: long enough for 1 Hz devices, short enough to see a stall."""


class RateMeter:
    """Samples per second over the last `RATE_WINDOW_NS`, from counts taken at every tick."""

    def __init__(self) -> None:
        self._marks: deque[tuple[int, int]] = deque()

    def mark(self, now_ns: int, count: int) -> None:
        """Note that `count` samples were made until `now_ns`."""
        marks = self._marks
        marks.append((now_ns, count))
        while len(marks) > 2 and marks[1][0] <= now_ns - RATE_WINDOW_NS:
            marks.popleft()

    def rate_hz(self) -> float:
        """Samples per second between the oldest and the newest mark; 0.0 before there are two."""
        if len(self._marks) < 2:
            return 0.0
        (t0_ns, n0), (t1_ns, n1) = self._marks[0], self._marks[-1]
        return (n1 - n0) * NS_PER_S / (t1_ns - t0_ns) if t1_ns > t0_ns else 0.0


class LatencyMeter:
    """Histogram of the time from a measurement to its publication."""

    __slots__ = ("buckets", "sum_ns")

    def __init__(self) -> None:
        self.buckets = [0] * (len(LATENCY_BOUNDS_NS) + 1)
        self.sum_ns = 0

    def add(self, now_ns: int, samples: Sequence[Sample]) -> None:
        """Count samples that are published at `now_ns`, oldest first."""
        if len(samples) == 1:
            latency_ns = now_ns - samples[0].t_ns
            self.buckets[bisect_left(LATENCY_BOUNDS_NS, latency_ns)] += 1
            self.sum_ns += latency_ns
            return
        latencies = [now_ns - sample.t_ns for sample in reversed(samples)]  # rising, as times of samples do
        self.sum_ns += sum(latencies)
        buckets, begin = self.buckets, 0
        for bucket in range(bisect_left(LATENCY_BOUNDS_NS, latencies[0]), len(LATENCY_BOUNDS_NS)):
            end = bisect_right(latencies, LATENCY_BOUNDS_NS[bucket], begin)
            buckets[bucket] += end - begin
            if end == len(latencies):
                return
            begin = end
        buckets[-1] += len(latencies) - begin


class LossMeter:
    """Attribution of missing samples to causes: damaged frames, then kernel overruns, the rest to the device.

    A device-time gap says how many samples are missing; damaged frames heard since the last sample explain as many of
    them, then overruns the kernel counted explain the rest, and what is left the device itself did not send.
    """

    def __init__(self, ledger: Ledger) -> None:
        self.bad_frames = 0
        """Damaged frames heard since the last sample; the owner counts them and sets 0 after each sample."""
        self._ledger = ledger
        self._overruns_seen = 0

    def missed(self, count: int, overruns: int) -> None:
        """Attribute `count` missing samples; the kernel counted `overruns` since the link was opened."""
        ledger = self._ledger
        by_crc = min(count, self.bad_frames)
        left = count - by_crc
        by_overrun = left if overruns > self._overruns_seen else 0
        ledger.lost_crc += by_crc
        ledger.lost_overrun += by_overrun
        ledger.lost_gap_device += left - by_overrun
        self._overruns_seen = overruns

    def link_opened(self) -> None:
        """Note that the kernel's counters start anew."""
        self._overruns_seen = 0
