"""What limits a clock: the sentence names the cause that the numbers show."""

import pytest

from imud.cli.clock import EDGES_ENOUGH, ENOUGH, verdict
from imud.contracts.status import ClockStatus
from imud.sample import Sync
from imud.units import NS_PER_MS

MS = NS_PER_MS
WIRE = [9 * MS + 1_000 * (n % 40) for n in range(200)]
TIMER = [2 * MS + (n * 160 % 16_000) * 1_000 for n in range(200)]


@pytest.mark.parametrize(
    ("clock", "behind_ns", "expected"),
    [
        (ClockStatus(Sync.UTC, t_err_ns=300_000), WIRE, "the host knows of UTC limits: 300.0 µs"),
        (ClockStatus(Sync.EDGE, t_err_ns=4_000), TIMER, "the kernel's stamps of the line: 4.0 µs"),
        (ClockStatus(Sync.ARRIVAL, t_err_ns=4_000), WIRE, "arrivals are all there is"),
        (ClockStatus(Sync.REGRESSION), WIRE[: ENOUGH - 1], "too few"),
        (ClockStatus(Sync.REGRESSION), WIRE, "arrivals spread over 0.0 ms; the constant delay"),
        (ClockStatus(Sync.REGRESSION, hold_ns=16 * MS), TIMER, "USB adapter's latency timer of 16 ms"),
        (ClockStatus(Sync.REGRESSION, hold_ns=16 * MS), WIRE, "the constant delay"),
        (ClockStatus(Sync.REGRESSION), TIMER, "a loaded system"),
    ],
)
def test_the_cause_is_named(clock: ClockStatus, behind_ns: list[int], expected: str) -> None:
    assert expected in verdict(clock, behind_ns)


@pytest.mark.parametrize(
    ("clock", "expected"),
    [
        (ClockStatus(Sync.EDGE, edges=1000, edges_unpaired=100, samples_unpaired=100), "stamps of the line"),
        (ClockStatus(Sync.EDGE, edges=1000, edges_unpaired=101), "101 of 1000 pulses belong to no sample: is the wire"),
        (ClockStatus(Sync.EDGE, edges=1000, samples_unpaired=3000), "3000 samples came without the pulse of theirs"),
        (ClockStatus(Sync.EDGE, edges=1000, triggers_missed=500), "500 triggers on SIN were not answered"),
        (ClockStatus(Sync.UTC, edges=1000, edges_unpaired=500), "belong to no sample"),
        (ClockStatus(Sync.UTC, edges=1000), "the device keeps UTC itself"),
        (ClockStatus(Sync.REGRESSION, edges=1000), "1000 edges came, and none is matched to a sample now"),
        (ClockStatus(Sync.REGRESSION, edges=EDGES_ENOUGH - 1, edges_unpaired=99), "the constant delay"),
    ],
)
def test_wires_that_do_not_fit_are_named_first(clock: ClockStatus, expected: str) -> None:
    assert expected in verdict(clock, WIRE)
