"""The kernel is asked for real; what its answer means is worked out by hand."""

import time

import pytest

from imud.units import NS_PER_MS, NS_PER_S
from imud.utc.adjtimex import KernelClock, Timex, kernel_clock, realtime_offset_ns, system_reference


def test_the_kernel_answers_sensibly() -> None:
    clock = kernel_clock()
    assert 0 <= clock.most_error_us <= 16_000_000  # NTP_PHASE_LIMIT
    assert 0 <= clock.estimated_error_us <= 16_000_000
    assert clock.synchronised or clock.most_error_us > 0


@pytest.mark.parametrize(
    ("state", "status", "synchronised"),
    [(0, 0x0001, True), (1, 0x2011, True), (5, 0x0040, False), (5, 0x0001, False), (0, 0x0040, False)],
)
def test_what_counts_as_synchronised(state: int, status: int, synchronised: bool) -> None:
    def ask(timex: Timex) -> int:
        assert timex.modes == 0  # nothing is to be changed
        timex.status, timex.esterror, timex.maxerror = status, 7, 99
        return state

    assert kernel_clock(ask) == KernelClock(synchronised, 7, 99)


def test_a_kernel_that_may_not_be_asked_vouches_for_nothing() -> None:
    def ask(_timex: Timex) -> int:
        raise PermissionError(1, "Operation not permitted")

    assert not kernel_clock(ask).synchronised
    assert system_reference(kernel_clock(ask), 42) is None


def test_the_offset_joins_both_clocks() -> None:
    offset_ns = realtime_offset_ns()
    assert abs(time.monotonic_ns() + offset_ns - time.time_ns()) < 5 * NS_PER_S  # the machine may stall in between


@pytest.mark.parametrize(
    ("clock", "error_ns"),
    [
        (KernelClock(True, 250, 300), 250_000),
        (KernelClock(True, 0, 1732), 999_971),  # uniform within ±1732 µs: 1732 / √3
        (KernelClock(True, 5, 17_320), 9_999_707),
    ],
)
def test_the_error_is_the_greater_of_both(clock: KernelClock, error_ns: int) -> None:
    reference = system_reference(clock, 42)
    assert reference
    assert reference.offset_ns == 42
    assert reference.error_ns == pytest.approx(error_ns, abs=1)


def test_a_clock_that_nothing_keeps_is_no_reference() -> None:
    assert system_reference(KernelClock(False, 1, NS_PER_MS), 42) is None
