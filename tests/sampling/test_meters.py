"""Latency, and causes of loss, computed by hand."""

import struct

from imud.contracts.status import LATENCY_BOUNDS_NS
from imud.model.ledger import Ledger
from imud.sampling.meters import LatencyMeter, LossMeter

SLOT = struct.Struct("<8xq40xI260x")  # the fields `t_ns` and `status` of a slot


def test_latencies_go_into_the_buckets_whose_bounds_they_do_not_exceed() -> None:
    meter = LatencyMeter()
    for latency_ns in (50_000, 50_001, 10**12):
        meter.add(2 * 10**12, published_after(latency_ns))
    assert (meter.buckets[0], meter.buckets[1]) == (1, 1)
    assert meter.buckets[len(LATENCY_BOUNDS_NS)] == 1
    assert meter.sum_ns == 100_001 + 10**12
    usual, alone = [10**12, 50_000_001, 50_000_000, 20_000_000, 20_000_000, 5_000_001, 49_999, 7], LatencyMeter()
    for latencies in (usual, [2**50 + 1, *usual], [2**62, *usual], [0, -5]):  # the kernel counts no longer latencies
        together, packed = LatencyMeter(), LatencyMeter()
        times_ns = published_after(*latencies)
        together.add(2 * 10**12, times_ns)
        slots = b"".join(SLOT.pack(t_ns, 1 << number) for number, t_ns in enumerate(times_ns))
        assert packed.add_slots(2 * 10**12, slots) == 2 ** len(latencies) - 1
        assert (packed.buckets, packed.sum_ns) == (together.buckets, together.sum_ns)
        assert together.sum_ns == sum(latencies)
        if latencies is usual:
            for latency_ns in latencies:
                alone.add(2 * 10**12, published_after(latency_ns))
            assert (together.buckets, together.buckets[-1], together.buckets[0]) == (alone.buckets, 2, 2)
            assert together.sum_ns == alone.sum_ns


def published_after(*latencies_ns: int) -> list[int]:
    """Return time stamps of samples that are published at 2000 s, oldest first."""
    return [2 * 10**12 - latency_ns for latency_ns in latencies_ns]


def test_loss_is_explained_by_damage_first_then_overruns_then_the_device() -> None:
    ledger = Ledger()
    loss = LossMeter(ledger)
    loss.bad_frames = 2
    loss.missed(3, overruns=0)
    assert (ledger.lost_crc, ledger.lost_overrun, ledger.lost_gap_device) == (2, 0, 1)
    loss.bad_frames = 0
    loss.missed(4, overruns=7)
    assert (ledger.lost_crc, ledger.lost_overrun, ledger.lost_gap_device) == (2, 4, 1)
    loss.missed(1, overruns=7)  # no new overrun
    assert (ledger.lost_crc, ledger.lost_overrun, ledger.lost_gap_device) == (2, 4, 2)
    loss.link_opened()
    loss.missed(1, overruns=1)
    assert ledger.lost_overrun == 5
    assert ledger.lost() == 9
