"""Samples that the host asked for: their time is that of the asking, and it rises whatever comes."""

from imud.clock import SampleClock
from imud.sample import Measurement, Sync

FRAME = Measurement(28, 0, None, (0.0, 0.0, 9.8))


def clock() -> SampleClock:
    return SampleClock("imu", tick_ns=0, tick_modulus=2, byte_ns=0, hold_ns=0)


def test_time_is_that_of_the_asking() -> None:
    sample = clock().sample_asked(FRAME, 1_000_000, 300, 1_200_000, 5_000_000_000)
    assert (sample.t_ns, sample.t_err_ns, sample.t_rx_ns, sample.utc_ns) == (1_000_000, 300, 1_200_000, 5_001_000_000)
    assert (sample.seq, sample.sync, sample.t_dev_ns) == (1, Sync.ARRIVAL, None)


def test_time_rises_strictly_and_is_never_after_the_answer() -> None:
    one = clock()
    samples = [one.sample_asked(FRAME, t_ns, 1, t_ns + 5, 0) for t_ns in (100, 100, 50, 103, 200)]
    assert [sample.t_ns for sample in samples] == [100, 101, 102, 103, 200]
    assert all(sample.t_ns <= sample.t_rx_ns for sample in samples)
    assert [sample.seq for sample in samples] == [1, 2, 3, 4, 5]


def test_error_that_does_not_fit_is_the_largest() -> None:
    assert clock().sample_asked(FRAME, 1, 2**40, 2, 0).t_err_ns == 2**32 - 1


def test_another_clock_of_the_device_goes_on_where_it_ended() -> None:
    one, other = clock(), clock()
    one.sample_asked(FRAME, 1000, 1, 1001, 0)
    other.follow(one)
    sample = other.sample_asked(FRAME, 500, 1, 501, 0)
    assert (sample.seq, sample.t_ns) == (2, 1001)


def test_by_an_edge() -> None:
    one = clock()
    samples = [one.sample_asked(FRAME, t_ns, 5, t_ns + 50, 0, edge) for t_ns, edge in ((100, 7), (200, None), (300, 8))]
    assert [(sample.sync, sample.edge_seq, sample.t_ns) for sample in samples] == [
        (Sync.EDGE, 7, 100), (Sync.ARRIVAL, None, 200), (Sync.EDGE, 8, 300),
    ]  # fmt: skip
    assert one.status().sync is Sync.EDGE


def test_what_is_lifted_is_part_of_the_error() -> None:
    one = clock()
    one.sample_asked(FRAME, 1000, 5, 1001, 0)
    sample = one.sample_asked(FRAME, 400, 5, 1002, 0)
    assert (sample.t_ns, sample.t_err_ns) == (1001, 606)
