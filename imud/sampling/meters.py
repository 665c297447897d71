"""Counters of a sample path: latency, and the causes of lost samples."""

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from typing import Final

from imud.contracts.status import LATENCY_BOUNDS_NS
from imud.formats import kernel
from imud.formats.slot import slot_status_bits, slot_times_ns
from imud.model.ledger import Ledger

_BOUNDS: Final = array("q", LATENCY_BOUNDS_NS).tobytes()


class LatencyMeter:
    """Histogram of the time from a measurement to its publication."""

    __slots__ = ("_add_latencies", "buckets", "sum_ns")

    def __init__(self) -> None:
        self.buckets = array("q", bytes(len(_BOUNDS) + 8))
        self.sum_ns = 0
        self._add_latencies = getattr(kernel.present.module, "add_latencies", None)

    def add_one(self, latency_ns: int) -> None:
        """Count a sample."""
        self.buckets[bisect_left(LATENCY_BOUNDS_NS, latency_ns)] += 1
        self.sum_ns += latency_ns

    def add(self, now_ns: int, times_ns: Sequence[int]) -> None:
        """Count samples with these time stamps that imud publishes at `now_ns`. The time stamps rise."""
        latencies = [now_ns - t_ns for t_ns in reversed(times_ns)]  # reversed: ascending latencies
        self.sum_ns += sum(latencies)
        buckets, begin = self.buckets, 0
        # one step for each bucket, not for each sample
        for bucket in range(bisect_left(LATENCY_BOUNDS_NS, latencies[0]), len(LATENCY_BOUNDS_NS)):
            end = bisect_right(latencies, LATENCY_BOUNDS_NS[bucket], begin)
            buckets[bucket] += end - begin
            if end == len(latencies):
                return
            begin = end
        buckets[-1] += len(latencies) - begin

    def add_slots(self, now_ns: int, packed: bytes) -> int:
        """Count the samples of slots, as `add`. Return their status bits."""
        add_latencies = self._add_latencies  # a call of a function in an attribute of `self` is slower
        counted = add_latencies(self.buckets, _BOUNDS, packed, now_ns) if add_latencies else None
        if counted is None:
            self.add(now_ns, slot_times_ns(packed))
            return slot_status_bits(packed)
        bits: int
        bits, sum_ns = counted
        self.sum_ns += sum_ns
        return bits


class LossMeter:
    """Attribution of lost samples to causes: first damaged frames, then kernel overruns, then the device.

    The device counter shows the number of lost samples. Each damaged frame since the last sample explains one of them.
    An overrun explains the rest. Without an overrun, the device did not send the rest.
    """

    def __init__(self, ledger: Ledger) -> None:
        # Number of damaged frames since the last sample. The path counts them and resets the number after each sample.
        self.bad_frames = 0
        self._ledger = ledger
        self._overruns_seen = 0

    def missed(self, count: int, overruns: int) -> None:
        """Attribute `count` lost samples. `overruns` is the kernel's count since the link was opened."""
        ledger = self._ledger
        by_crc = min(count, self.bad_frames)
        left = count - by_crc
        by_overrun = left if overruns > self._overruns_seen else 0
        ledger.lost_crc += by_crc
        ledger.lost_overrun += by_overrun
        ledger.lost_gap_device += left - by_overrun
        self._overruns_seen = overruns

    def link_opened(self) -> None:
        """Reset the overruns: the kernel counts from the opening of the link."""
        self._overruns_seen = 0
