"""What is known of UTC and who is told: the device by sentences, its clock by a reference, chronyd by pulses."""

from typing import cast

import pytest

from imud.clock import SampleClock
from imud.config import DeviceConfig
from imud.contracts.lines import DeviceLines, Edge, PpsSettings
from imud.contracts.timing import UtcReference
from imud.formats.rmc import build
from imud.links.memory import MemorySettings
from imud.runtime import utc_keeper
from imud.runtime.utc_keeper import DevicePort, UtcKeeper, make_keeper, system_utc
from imud.units import NS_PER_MS, NS_PER_S
from imud.utc.adjtimex import KernelClock
from imud.utc.chrony import ChronyFeed
from imud.utc.source import RmcSettings
from tests.support.in_loop import in_loop
from tests.support.wired import FakeSource

UTC_S = 1_795_000_000
BEGIN_NS = 1000 * NS_PER_S
OFFSET_NS = UTC_S * NS_PER_S - BEGIN_NS


class FakeChrony:
    """Keeps the pulses it is given."""

    problem = ""
    refused = 0

    def __init__(self) -> None:
        self.pulses: list[tuple[int, int]] = []
        self.closed = False

    @property
    def sent(self) -> int:
        return len(self.pulses)

    def pulse(self, t_ns: int, unix_s: int) -> None:
        self.pulses.append((t_ns, unix_s))

    def close(self) -> None:
        self.closed = True


class Bench:
    """A keeper and all around it."""

    def __init__(self, *, source: bool = True, system: UtcReference | None = None) -> None:
        self.written: list[bytes] = []
        self.busy = False
        self.system = system
        self.source, self.chrony = FakeSource(), FakeChrony()
        port = DevicePort(self.written.append, lambda: 115_200, lambda: self.busy)
        self.keeper = UtcKeeper(
            self.source if source else None,
            port if source else None,
            chrony=cast(ChronyFeed, self.chrony),
            system=lambda: self.system,
        )
        self.keeper.start()
        self.clock = SampleClock("bow", tick_ns=NS_PER_MS, tick_modulus=1 << 32, byte_ns=0, hold_ns=0)

    def second(self, number: int, *, pulse: bool = True, sentence: bool = True) -> None:
        t_ns = BEGIN_NS + number * NS_PER_S
        if pulse:
            self.keeper.pulses([Edge(t_ns, True, 2 * number), Edge(t_ns + NS_PER_MS, False, 2 * number + 1)])
        self.now_ns = t_ns + NS_PER_S // 5
        if sentence:
            self.source.give(build((UTC_S + number) * NS_PER_S), self.now_ns)
        self.keeper.tick(self.now_ns, self.clock)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench()

    def now_ns() -> int:
        return made.now_ns

    monkeypatch.setattr(made.keeper._feed, "_now_ns", now_ns)
    return made


def test_sentences_go_to_the_device_and_make_pulses_utc(bench: Bench) -> None:
    for number in range(6):
        bench.second(number)
    assert len(bench.written) == 6
    assert bench.written[3] == build((UTC_S + 3) * NS_PER_S)
    reference = bench.clock.reference
    assert reference is not None
    assert reference.offset_ns == pytest.approx(OFFSET_NS, abs=1000)
    assert reference.error_ns < 100_000
    assert bench.chrony.pulses[-1] == (BEGIN_NS + 5 * NS_PER_S, UTC_S + 5)
    status = bench.keeper.status()
    assert (status.source, status.sent, status.refused, status.pulses) == ("test", 6, {}, 6)
    assert status.chrony_sent == len(bench.chrony.pulses) > 1


def test_a_sentence_for_a_busy_or_wrong_second_is_refused_and_counted(bench: Bench) -> None:
    for number in range(4):
        bench.second(number)
    bench.busy = True
    bench.second(4)
    bench.busy = False
    bench.second(5, sentence=False)
    bench.source.give(build((UTC_S + 7) * NS_PER_S), bench.now_ns)
    assert bench.keeper.status().refused == {"busy": 1, "ahead": 1}
    assert len(bench.written) == 4


def test_before_anything_is_known_of_utc_the_pulse_says_what_is_too_late(bench: Bench) -> None:
    bench.second(0, sentence=False)
    bench.now_ns = BEGIN_NS + NS_PER_S - 25 * NS_PER_MS  # 6 ms on the wire, and 20 ms before the next second at least
    bench.source.give(build(UTC_S * NS_PER_S), bench.now_ns)
    assert bench.keeper.status().refused == {"stale": 1}


def test_the_better_of_two_references_counts(bench: Bench) -> None:
    good, bad = UtcReference(OFFSET_NS + 77, 10), UtcReference(OFFSET_NS + 55, 10**9)
    bench.system = bad
    bench.second(0)
    assert bench.clock.reference == bad
    for number in range(1, 6):
        bench.second(number)
    by_pulses = bench.clock.reference
    assert by_pulses is not None
    assert by_pulses.error_ns < 10**6
    bench.system = good
    bench.second(6)
    assert bench.clock.reference == good
    bench.system = None
    bench.second(7)
    by_pulses = bench.clock.reference
    assert by_pulses is not None
    assert by_pulses.offset_ns != good.offset_ns


def test_it_is_asked_once_a_second_and_forgotten_when_nobody_knows() -> None:
    bench = Bench(source=False, system=UtcReference(5, 5))
    bench.keeper.tick(BEGIN_NS, bench.clock)
    assert bench.clock.reference == UtcReference(5, 5)
    bench.system = None
    bench.keeper.tick(BEGIN_NS + NS_PER_S - 1, bench.clock)
    assert bench.clock.reference == UtcReference(5, 5)
    bench.keeper.tick(BEGIN_NS + NS_PER_S, None)
    bench.keeper.tick(BEGIN_NS + 2 * NS_PER_S, bench.clock)
    assert bench.clock.reference is None


@in_loop
async def test_everything_is_let_go_of() -> None:
    bench = Bench()
    await bench.keeper.close()
    await bench.keeper.close()
    assert bench.source.closed
    assert bench.chrony.closed
    await UtcKeeper(None, None).close()


def test_problems_of_source_and_chrony_show(bench: Bench) -> None:
    assert bench.keeper.status().problem == ""
    bench.chrony.problem = "no chronyd"
    assert bench.keeper.status().problem == "no chronyd"
    bench.source.problem = "no gpsd"
    assert bench.keeper.status().problem == "no gpsd"


def test_the_system_clock_counts_only_while_something_keeps_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(utc_keeper, "kernel_clock", lambda: KernelClock(False, 100, 100))
    assert system_utc() is None
    monkeypatch.setattr(utc_keeper, "kernel_clock", lambda: KernelClock(True, 100, 0))
    reference = system_utc()
    assert reference is not None
    assert reference.error_ns == 100_000


@pytest.mark.parametrize("rmc", [None, RmcSettings(source="gpsd", rate_hz=5)])
@pytest.mark.parametrize("pps", [None, PpsSettings(line="A"), PpsSettings(line="A", chrony="/nowhere/imud.sock")])
@in_loop
async def test_a_device_gets_what_it_is_configured_for(rmc: RmcSettings | None, pps: PpsSettings | None) -> None:
    config = DeviceConfig(
        "bow", "hipnuc-uart", None, False, "memory", MemorySettings(), lines=DeviceLines(pps=pps), rmc=rmc
    )
    keeper = make_keeper(config, DevicePort(lambda _data: None, lambda: 9600, lambda: False))
    assert (keeper is None) == (rmc is None and pps is None)
    if keeper is not None:
        assert keeper.status().source.startswith("gpsd" if rmc else "")
        assert (keeper._feed is None) == (rmc is None)
        assert (keeper._chrony is None) == (pps is None or not pps.chrony)
        await keeper.close()
