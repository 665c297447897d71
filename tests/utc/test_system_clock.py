"""Sentences from the system clock: right second, right moment, and none from a clock that nothing keeps."""

import asyncio

import pytest

from imud.formats.rmc import Rmc, parse
from imud.units import NS_PER_MS, NS_PER_S
from imud.utc.adjtimex import KernelClock
from imud.utc.source import RmcSettings
from imud.utc.system_clock import AFTER_NS, LATEST_NS, SystemClockSource
from tests.support.sentences import Sentences

GOOD = KernelClock(True, 500, 1000)
OFFSET_NS = 1_795_000_000 * NS_PER_S + 123_456_789


class Bench:
    """A source with a clock of the test's."""

    def __init__(self, rate_hz: int = 1, clock: KernelClock = GOOD) -> None:
        self.now_ns = 5 * NS_PER_S
        self.clock = clock
        self.got: list[tuple[bytes, int]] = []
        self.source = SystemClockSource(
            RmcSettings(source="system", rate_hz=rate_hz), lambda: self.clock, lambda: OFFSET_NS, lambda: self.now_ns
        )
        self.source._on_sentence = lambda sentence, t_rx_ns: self.got.append((sentence, t_rx_ns))

    def go(self, times: int, late_ns: int = 50_000) -> None:
        """Wait as long as the source says, and a little more."""
        for _ in range(times):
            self.now_ns += self.source.wait_ns() + late_ns
            self.source.tick()


@pytest.mark.parametrize("rate_hz", range(1, 11))
def test_each_names_its_instant_after_it_was_and_within_its_second(rate_hz: int) -> None:
    bench = Bench(rate_hz)
    bench.go(20 * rate_hz)
    assert len(bench.got) >= 18
    for sentence, t_rx_ns in bench.got:
        rmc, utc_ns = parse(sentence), t_rx_ns + OFFSET_NS
        assert isinstance(rmc, Rmc)
        assert rmc.valid
        assert rmc.unix_s == utc_ns // NS_PER_S
        assert AFTER_NS <= utc_ns - rmc.utc_ns < AFTER_NS + 60 * NS_PER_MS
        assert utc_ns % NS_PER_S < LATEST_NS
    names = [rmc.utc_ns for s, _ in bench.got if isinstance(rmc := parse(s), Rmc)]
    assert len(set(names)) == len(names)
    assert sum(name % NS_PER_S == 0 for name in names) >= 18


def test_woken_early_it_waits_and_woken_late_it_leaves_out() -> None:
    bench = Bench()
    bench.go(1, late_ns=-1000)
    assert bench.got == []
    bench.go(1)
    assert len(bench.got) == 1
    bench.go(1, late_ns=51 * NS_PER_MS)
    assert len(bench.got) == 1


@pytest.mark.parametrize(
    ("clock", "problem"),
    [
        (KernelClock(False, 0, 0), "not synchronised"),
        (KernelClock(True, 51_000, 60_000), "may be wrong by 51.0 ms, allowed are 50 ms"),
        (KernelClock(True, 0, 100_000), "may be wrong by 57.7 ms"),
    ],
)
def test_a_clock_that_is_not_good_enough_gives_none_and_says_why(clock: KernelClock, problem: str) -> None:
    bench = Bench(clock=clock)
    bench.go(3)
    assert bench.got == []
    assert problem in bench.source.problem
    bench.clock = GOOD
    bench.go(1)
    assert len(bench.got) == 1
    assert bench.source.problem == ""


def test_it_runs_in_the_loop_and_stops() -> None:
    async def scene() -> None:
        sentences = Sentences()
        source = SystemClockSource(RmcSettings(source="system", rate_hz=10), lambda: GOOD)
        source.start(sentences)
        await sentences.until(lambda: len(sentences.got) >= 2)
        await source.close()
        await source.close()
        assert source.sentences == len(sentences.got)

    asyncio.run(scene())
