"""System clock: the state in the kernel, its meaning, and sentences at the right time or not at all."""

import asyncio
import ctypes
import errno
import time
from itertools import pairwise
from types import SimpleNamespace

import pytest

from imud.formats.nmea0183 import Rmc, parse
from imud.host.clock import HostClock
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.utc import system_clock
from imud.utc.receivers import RmcOptions
from tests.support.event_loops import VirtualClock, in_loop, run_virtually
from tests.support.rmc_sources import Sentences

GOOD = system_clock.KernelClock(True, 500, 1000)
OFFSET_NS = 1_795_000_000 * NS_PER_S + 123_456_789


def test_the_kernel_answers_sensibly_and_a_refused_call_means_not_synchronized() -> None:
    clock = system_clock.kernel_clock()
    assert 0 <= clock.most_error_us <= 16_000_000  # NTP_PHASE_LIMIT
    assert 0 <= clock.estimated_error_us <= 16_000_000
    assert clock.synchronised or clock.most_error_us > 0
    assert ctypes.sizeof(system_clock.Timex) == 26 * ctypes.sizeof(ctypes.c_long)  # <linux/timex.h>
    offset_ns = HostClock().utc_offset_ns()
    assert abs(time.monotonic_ns() + offset_ns - time.time_ns()) < 5 * NS_PER_S  # the host may stall in between

    def ask(_timex: system_clock.Timex) -> int:
        raise PermissionError(1, "Operation not permitted")

    assert not system_clock.kernel_clock(ask).synchronised
    assert system_clock.system_reference(system_clock.kernel_clock(ask), 42) is None
    assert system_clock.system_reference(system_clock.KernelClock(False, 1, NS_PER_MS), 42) is None


def test_a_state_of_the_kernel_is_returned_and_a_failed_call_is_an_error(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    states = iter((0, 5, -1))
    called = SimpleNamespace(adjtimex=lambda _timex: next(states))
    monkeypatch.setattr(ctypes, "CDLL", lambda _name, *, use_errno: called if use_errno else None)
    system_clock._libc.cache_clear()
    request.addfinalizer(system_clock._libc.cache_clear)
    assert [system_clock.ask_kernel(system_clock.Timex()) for _ in range(2)] == [0, 5]
    ctypes.set_errno(errno.EPERM)
    with pytest.raises(PermissionError, match="not permitted"):
        system_clock.ask_kernel(system_clock.Timex())


@pytest.mark.parametrize(
    ("state", "status", "synchronised"),
    [(0, 0x0001, True), (1, 0x2011, True), (5, 0x0040, False), (5, 0x0001, False), (0, 0x0040, False)],
)
def test_states_that_count_as_synchronized(state: int, status: int, synchronised: bool) -> None:
    def ask(timex: system_clock.Timex) -> int:
        assert timex.modes == 0  # adjtimex must not change the clock
        timex.status, timex.esterror, timex.maxerror = status, 7, 99
        return state

    assert system_clock.kernel_clock(ask) == system_clock.KernelClock(synchronised, 7, 99)


@pytest.mark.parametrize(
    ("clock", "error_ns"),
    [
        (system_clock.KernelClock(True, 250, 300), 250_000),
        (system_clock.KernelClock(True, 0, 1732), 999_971),  # uniform within ±1732 µs: 1732 / √3
        (system_clock.KernelClock(True, 5, 17_320), 9_999_707),
    ],
)
def test_the_error_is_the_greater_of_both(clock: system_clock.KernelClock, error_ns: int) -> None:
    reference = system_clock.system_reference(clock, 42)
    assert reference
    assert reference.offset_ns == 42
    assert reference.error_ns == pytest.approx(error_ns, abs=1)


class SystemClockBench:
    """A source with a clock of the test. Its timer does not run, because the tests do not wait."""

    def __init__(self, rate_hz: int = 1, clock: system_clock.KernelClock = GOOD) -> None:
        self.now_ns = 5 * NS_PER_S
        self.clock = clock
        self.got: list[tuple[bytes, int]] = []
        self.source = system_clock.SystemClockSource(
            RmcOptions(source="system", rate_hz=rate_hz), lambda: self.now_ns, lambda: OFFSET_NS, lambda: self.clock
        )
        self.source.start(lambda sentence, t_rx_ns: self.got.append((sentence, t_rx_ns)))

    def go(self, times: int, late_ns: int = 50_000) -> None:
        for _ in range(times):
            self.now_ns += self.source.wait_ns() + late_ns
            self.source.tick()


@pytest.mark.parametrize("rate_hz", [1, 3, 10])
@in_loop
async def test_each_names_its_instant_after_it_was_and_within_its_second(rate_hz: int) -> None:
    bench = SystemClockBench(rate_hz)
    bench.go(20 * rate_hz)
    assert len(bench.got) >= 18
    for sentence, t_rx_ns in bench.got:
        rmc, utc_ns = parse(sentence), t_rx_ns + OFFSET_NS
        assert isinstance(rmc, Rmc)
        assert rmc.valid
        assert rmc.unix_s == utc_ns // NS_PER_S
        assert 200 * NS_PER_MS <= utc_ns - rmc.utc_ns < 260 * NS_PER_MS
        assert utc_ns % NS_PER_S < 800 * NS_PER_MS
    names = [rmc.utc_ns for s, _ in bench.got if isinstance(rmc := parse(s), Rmc)]
    assert len(set(names)) == len(names)
    assert sum(name % NS_PER_S == 0 for name in names) >= 18
    assert min(b - a for a, b in pairwise(names)) == pytest.approx(1e9 / rate_hz, abs=1e7)  # RMC has 10 ms
    bench.source.close()


@in_loop
async def test_an_early_wakeup_waits_and_a_late_wakeup_skips_edges() -> None:
    bench = SystemClockBench()
    bench.go(1, late_ns=-1000)
    assert bench.got == []
    bench.go(1)
    assert len(bench.got) == 1
    bench.go(1, late_ns=51 * NS_PER_MS)
    assert len(bench.got) == 1
    bench.source.close()


@pytest.mark.parametrize(
    ("clock", "problem"),
    [
        (system_clock.KernelClock(False, 0, 0), "not synchronized"),
        (system_clock.KernelClock(True, 51_000, 60_000), "may be wrong by 51.0 ms, the maximum is 50 ms"),
        (system_clock.KernelClock(True, 0, 100_000), "may be wrong by 57.7 ms"),
    ],
)
@in_loop
async def test_an_inaccurate_clock_gives_no_sentence_and_reports_the_reason(
    clock: system_clock.KernelClock, problem: str
) -> None:
    bench = SystemClockBench(clock=clock)
    bench.go(3)
    assert bench.got == []
    assert problem in bench.source.problem
    bench.clock = GOOD
    bench.go(1)
    assert len(bench.got) == 1
    assert bench.source.problem == ""
    bench.source.close()


def test_the_timer_runs_in_the_event_loop_and_stops() -> None:
    clock, sentences = VirtualClock(), Sentences()
    settings = RmcOptions(source="system", rate_hz=10)
    source = system_clock.SystemClockSource(settings, clock.now_ns, clock.host.utc_offset_ns, lambda: GOOD)

    async def scene() -> None:
        source.start(sentences)
        await sentences.until(lambda: len(sentences.got) >= 12)
        source.close()
        source.close()
        await asyncio.sleep(1)

    run_virtually(clock, scene())
    assert source.sentences == len(sentences.got) == 12
