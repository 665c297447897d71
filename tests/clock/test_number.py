"""A counter that numbers samples: what is missing, what began anew, and the time that arrivals give."""

from random import Random

from imud.clock import SampleClock
from imud.sample import Measurement, Sample, Sync

MS = 1_000_000
PERIOD_NS = 10 * MS


def clock() -> SampleClock:
    return SampleClock("imu", tick_ns=0, tick_modulus=65536, byte_ns=0, hold_ns=0)


def sample(clock: SampleClock, index: int, t_ns: int, wait_ns: int = 2 * MS) -> Sample:
    """Sample `index`, begun on the wire at `t_ns`, complete `wait_ns` later."""
    return clock.sample(Measurement(40, 0, index % 65536), t_ns + wait_ns, 0, t_ns)


def test_missing_samples_are_counted_through_the_wrap() -> None:
    made, missed = clock(), []
    for index in (65530, 65531, 65532, 65535, 65536, 65540, 65541):
        sample(made, index, index * PERIOD_NS)
        missed.append(made.missed)
    assert missed == [0, 0, 0, 2, 0, 3, 0]
    assert made.status().resets == 0


def test_a_long_gap_is_believed_when_time_agrees() -> None:
    made = clock()
    for index in (1, 2, 3, 4, 1004):
        sample(made, index, index * PERIOD_NS)
    assert made.missed == 999


def test_a_counter_that_began_anew_is_no_loss() -> None:
    made = clock()
    for index in range(40000, 40020):
        sample(made, index, index * PERIOD_NS)
    t_ns = 40060 * PERIOD_NS  # 400 ms later it starts again from 0
    for index in range(3):
        sample(made, index, t_ns + index * PERIOD_NS)
        assert made.missed == 0
    assert made.status().resets == 1


def test_after_a_restart_of_the_link_nothing_is_missing() -> None:
    made = clock()
    for index in (1, 2, 3):
        sample(made, index, index * PERIOD_NS)
    made.restart()
    sample(made, 500, 500 * PERIOD_NS)
    assert made.missed == 0
    assert made.status().resets == 0


def test_time_is_that_of_the_first_frame_and_says_its_error() -> None:
    """The error shown covers what arrivals are off, and gaps do not spoil the rate."""
    made, random, offs = clock(), Random(1), []
    for index in range(2000):
        if index % 50 in (7, 8):
            continue
        delay_ns = int(random.expovariate(1 / (0.1 * MS)))
        made_of = sample(made, index, index * PERIOD_NS + delay_ns, random.randrange(1 * MS, 6 * MS))
        assert made_of.sync is Sync.ARRIVAL
        assert made_of.t_dev_ns is None
        if index > 100:
            offs.append(abs(made_of.t_ns - index * PERIOD_NS) / made_of.t_err_ns)
    assert sum(off < 1 for off in offs) / len(offs) > 0.68
    assert sum(off < 3 for off in offs) / len(offs) > 0.98
    assert made.status().t_err_ns < 0.5 * MS
    assert abs(made.expected_rate_hz - 100) < 1
