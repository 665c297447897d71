"""UTC of one device: sentences for its port, a reference for its clock, pulses for chronyd."""

from typing import cast
from unittest.mock import Mock

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.lines import DeviceLines, Edge, PpsOptions, UtcReference
from imud.device import utc as utc_module
from imud.device.attachments import Attachments
from imud.device.health import DeviceEvents
from imud.device.utc import UtcFeed, make_utc_feed
from imud.formats.nmea0183 import build
from imud.host.clock import HostClock
from imud.lines.gpio import GPIO_LINES
from imud.links.memory import MemoryOptions
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.utc.chrony import ChronyFeed
from imud.utc.receivers import RmcOptions
from imud.utc.rmc_feed import RmcFeed
from imud.utc.system_clock import KernelClock
from tests.support.rmc_sources import FakeSource

UTC_S = 1_795_000_000
BEGIN_NS = 1000 * NS_PER_S
OFFSET_NS = UTC_S * NS_PER_S - BEGIN_NS


class FakePort:
    def __init__(self, bit_rate: int = 115_200) -> None:
        self.written: list[bytes] = []
        self.bit_rate = bit_rate
        self.is_free = True

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def on_reset(self) -> None: ...


class FakeChrony:
    problem = ""
    refused = 0

    def __init__(self) -> None:
        self.pulses: list[tuple[int, int]] = []
        self.closed = False

    @property
    def sent(self) -> int:
        return len(self.pulses)

    def send_pulse(self, t_ns: int, unix_s: int) -> None:
        self.pulses.append((t_ns, unix_s))

    def close(self) -> None:
        self.closed = True


class KeeperBench:
    def __init__(self, *, source: bool = True, system: UtcReference | None = None) -> None:
        self.now_ns = BEGIN_NS - NS_PER_S
        self.system = system
        self.source, self.chrony = FakeSource(), FakeChrony()
        host, port = HostClock(lambda: self.now_ns, lambda: self.now_ns, lambda: self.now_ns), FakePort()
        self.port, self.written = port, port.written
        self.keeper = UtcFeed(
            self.source if source else None, RmcFeed(port, host.now_ns) if source else None, lambda: self.system, host,
            cast(ChronyFeed, self.chrony),
        )  # fmt: skip
        self.clock = SampleClock("bow", tick_ns=NS_PER_MS, tick_modulus=1 << 32, byte_ns=0, hold_ns=0)
        self.keeper.tick(self.now_ns, None)
        self.keeper.start(self.clock)

    def second(self, number: int, *, pulse: bool = True, sentence: bool = True, off_s: int = 0) -> None:
        t_ns = BEGIN_NS + number * NS_PER_S
        if pulse:
            self.keeper.on_pulses([Edge(t_ns, True, 2 * number), Edge(t_ns + NS_PER_MS, False, 2 * number + 1)])
        self.now_ns = t_ns + NS_PER_S // 5
        if sentence:
            self.source.give(build((UTC_S + number + off_s) * NS_PER_S), self.now_ns)
        self.keeper.tick(self.now_ns, None)


@pytest.fixture
def bench() -> KeeperBench:
    return KeeperBench()


def test_sentences_are_sent_or_refused_and_give_pulses_utc(bench: KeeperBench) -> None:
    for number in range(6):
        bench.second(number)
    assert (len(bench.written), bench.written[3]) == (6, build((UTC_S + 3) * NS_PER_S))
    reference = bench.clock.utc_reference
    assert reference is not None
    assert reference.offset_ns == pytest.approx(OFFSET_NS, abs=1000)
    assert reference.error_ns < 100_000
    assert bench.chrony.pulses[-1] == (BEGIN_NS + 5 * NS_PER_S, UTC_S + 5)
    status = bench.keeper.status()
    assert (status.source, status.sent, status.refused, status.pulses) == ("test", 6, {}, 6)
    assert status.chrony_sent == len(bench.chrony.pulses) > 1
    bench.port.is_free = False
    bench.second(6)
    bench.port.is_free = True
    bench.second(7, sentence=False)
    bench.source.give(build((UTC_S + 9) * NS_PER_S), bench.now_ns)
    assert bench.keeper.status().refused == {"busy": 1, "leap": 1}  # a busy port, and a wrong second
    assert len(bench.written) == 6


def test_the_better_of_two_references_counts(bench: KeeperBench) -> None:
    good, bad = UtcReference(OFFSET_NS + 77, 10), UtcReference(OFFSET_NS + 55, 10**9)
    bench.system = bad
    bench.second(0)
    assert bench.clock.utc_reference == bad
    for number in range(1, 6):
        bench.second(number)
    by_pulses = bench.clock.utc_reference
    assert by_pulses is not None
    assert by_pulses.error_ns < 10**6
    bench.system = good
    bench.second(6)
    assert bench.clock.utc_reference == good
    bench.system = None
    bench.second(7)
    by_pulses = bench.clock.utc_reference
    assert by_pulses is not None
    assert by_pulses.offset_ns != good.offset_ns
    for number, off_ns in ((8, 4 * NS_PER_S // 10), (9, 6 * NS_PER_S // 10)):  # at most 0.5 s
        bench.system = UtcReference(OFFSET_NS + off_ns, 0)
        bench.second(number)
    assert bench.chrony.pulses[-1][1] == UTC_S + 8


ROLLOVER_S = 1024 * 7 * 86_400  # GPS week rollover


@pytest.mark.parametrize(
    ("off_s", "error_ns", "refused", "pulses", "problem"),
    [
        (-ROLLOVER_S, None, 6, 0, "date 2007-04-04 precedes the release of imud"),
        (-ROLLOVER_S, NS_PER_MS, 6, 0, "date 2007-04-04 precedes the release of imud"),
        (ROLLOVER_S, None, 0, 2, ""),  # the host knows no UTC
        (ROLLOVER_S, NS_PER_MS, 6, 0, "the sentences of test: they differ by +619315199.8 s from the synchronized"),
        (-3, NS_PER_MS, 6, 0, "the sentences of test: they differ by -3.2 s from"),
        (-3, NS_PER_S, 0, 2, ""),
        (-5, NS_PER_S, 6, 0, "the sentences of test: they differ by -5.2 s from"),
        (1, NS_PER_MS, 0, 0, "the pulses of test: they differ by +1.0 s from"),
        (0, NS_PER_MS, 0, 2, ""),
    ],
)
def test_a_receiver_with_a_wrong_date(
    caplog: pytest.LogCaptureFixture, off_s: int, error_ns: int | None, refused: int, pulses: int, problem: str
) -> None:
    bench = KeeperBench(system=None if error_ns is None else UtcReference(OFFSET_NS, error_ns))
    for number in range(6):
        bench.second(number, off_s=off_s)
    status = bench.keeper.status()
    assert (status.refused.get("implausible", 0), len(bench.chrony.pulses)) == (refused, pulses)
    assert (problem in status.problem) == (not problem or bool(status.problem))
    assert sum(record.getMessage() == status.problem for record in caplog.records) == (1 if problem else 0)
    if problem:
        assert (bench.written, bench.clock.utc_reference) == ([], bench.system)
        for number in range(6, 9):
            bench.second(number)
        assert bench.keeper.status().problem == ""
        assert len(bench.written) == 3


def test_a_hostile_source_without_a_synchronized_clock(bench: KeeperBench, caplog: pytest.LogCaptureFixture) -> None:
    """Sentences of rising seconds, then sentences that are in turn correct and wrong."""
    for second in range(1000):
        bench.now_ns = BEGIN_NS + second * NS_PER_MS
        bench.source.give(build((UTC_S + second) * NS_PER_S), bench.now_ns)
    assert bench.written == [build(UTC_S * NS_PER_S)]
    assert bench.keeper.status().refused == {"leap": 999}
    assert "the sentences of test: their time leaps against the clock of the host" in bench.keeper.problem
    for second in range(1, 30):
        bench.second(second, pulse=False)
        bench.source.give(build((UTC_S + 7 * second) * NS_PER_S), bench.now_ns)
    assert bench.written == [build((UTC_S + second) * NS_PER_S) for second in range(30)]
    assert len(caplog.records) == 1, "a hostile source must not fill the log"


def test_a_leap_that_the_synchronized_clock_confirms() -> None:
    """The system clock was synchronized after a receiver with a wrong time."""
    bench = KeeperBench()
    bench.second(0, pulse=False, off_s=400)
    bench.system = UtcReference(OFFSET_NS, NS_PER_MS)
    bench.second(1, pulse=False)
    assert bench.written[-1] == build((UTC_S + 1) * NS_PER_S)


@pytest.mark.parametrize(
    ("sentence", "problem"),
    [
        (b"", "test has sent no time sentence (RMC) for more than 10 s: is the receiver connected and sending?"),
        (build(UTC_S * NS_PER_S, valid=False), "the time sentences (RMC) of test have no valid time for more than"),
    ],
    ids=["no sentence", "status V"],
)
def test_silent_receiver_is_a_problem(bench: KeeperBench, sentence: bytes, problem: str) -> None:
    for second in range(3):
        bench.second(second)
    for second in range(3, 30):
        assert bench.keeper.problem == "" or second > 12
        bench.second(second, sentence=False)
        if sentence:
            bench.source.give(sentence, bench.now_ns)
    assert bench.keeper.problem.startswith(problem)
    bench.second(30)
    bench.keeper.tick(bench.now_ns, None)
    assert bench.keeper.status().problem == ""


def test_a_clock_has_the_reference_of_each_second_from_its_start_to_the_end_of_the_link() -> None:
    bench = KeeperBench(source=False, system=UtcReference(5, 5))
    bench.keeper.tick(BEGIN_NS, None)
    assert bench.clock.utc_reference == UtcReference(5, 5)
    bench.system = None
    bench.keeper.tick(BEGIN_NS + NS_PER_S - 1, None)
    assert bench.clock.utc_reference == UtcReference(5, 5)
    bench.keeper.tick(BEGIN_NS + NS_PER_S, None)
    assert bench.clock.utc_reference is None
    bench = KeeperBench(source=False, system=UtcReference(5, 5))
    bench.keeper.tick(BEGIN_NS, None)
    other = SampleClock("bow", tick_ns=NS_PER_MS, tick_modulus=1 << 32, byte_ns=0, hold_ns=0)
    bench.keeper.start(other)
    assert other.utc_reference == UtcReference(5, 5)
    bench.keeper.stop()
    bench.keeper.stop()
    bench.system = UtcReference(6, 6)
    bench.keeper.tick(BEGIN_NS + NS_PER_S, None)
    assert other.utc_reference == UtcReference(5, 5)
    bench.keeper.start(other)
    assert other.utc_reference == UtcReference(6, 6)
    steered = Mock(steady=Mock(rate=-2e-6, steady_ns=int))  # chronyd steers the clock: 2 µs until the next update
    keeper = UtcFeed(None, None, lambda: UtcReference(6, 6), steered)
    keeper.start(other)
    keeper.tick(BEGIN_NS, None)
    assert other.utc_reference == UtcReference(6, 6 + 2000)


def test_close_releases_source_and_socket() -> None:
    bench = KeeperBench()
    bench.keeper.close()
    bench.keeper.close()
    assert bench.source.closed
    assert bench.chrony.closed
    bench.source.started = 0
    bench.keeper.tick(BEGIN_NS, None)
    assert bench.source.started == 0
    UtcFeed(None, None, lambda: None, HostClock()).close()
    source = FakeSource()
    keeper = UtcFeed(source, None, lambda: None, HostClock())
    keeper.close()
    keeper.tick(BEGIN_NS, None)
    assert source.started == 0


def test_problems_are_in_the_status_and_a_late_sentence_is_refused(bench: KeeperBench) -> None:
    assert bench.keeper.status().problem == ""
    bench.chrony.problem = "no chronyd"
    assert bench.keeper.status().problem == "no chronyd"
    bench.source.problem = "no gpsd"
    assert bench.keeper.status().problem == "no gpsd"
    bench.second(0, sentence=False)
    bench.now_ns = BEGIN_NS + NS_PER_S - 25 * NS_PER_MS  # 6 ms transmission, and at least 20 ms before the next second
    for sentence in (b"$GPGGA,1*00\r\n", build(UTC_S * NS_PER_S)):
        bench.source.give(sentence, bench.now_ns)
    assert bench.keeper.status().refused == {"damaged": 1, "stale": 1}


def test_the_system_clock_is_used_only_while_it_is_synchronized(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SampleClock("bow", tick_ns=NS_PER_MS, tick_modulus=1 << 32, byte_ns=0, hold_ns=0)
    offset_ns, now_ns = [OFFSET_NS], lambda: BEGIN_NS
    host = HostClock(now_ns, lambda: BEGIN_NS + offset_ns[0], now_ns)
    keeper = make_utc_feed(configured(None, PpsOptions(line="A")), FakePort(9600), host)
    assert keeper is not None
    keeper.start(clock)
    monkeypatch.setattr(utc_module, "kernel_clock", lambda: KernelClock(False, 100, 100))
    keeper.tick(BEGIN_NS, None)
    assert clock.utc_reference is None
    monkeypatch.setattr(utc_module, "kernel_clock", lambda: KernelClock(True, 100, 0))
    offset_ns[0] += 37 * NS_PER_S
    keeper.tick(BEGIN_NS + NS_PER_S, None)
    assert clock.utc_reference == UtcReference(OFFSET_NS + 37 * NS_PER_S, 100_000)
    keeper.close()


def configured(rmc: RmcOptions | None, pps: PpsOptions | None) -> DeviceConfig:
    return DeviceConfig(
        "bow", "hipnuc-uart", None, False, "memory", MemoryOptions(), lines=DeviceLines(pps=pps), rmc=rmc
    )


@pytest.mark.parametrize("rmc", [None, RmcOptions(source="gpsd", rate_hz=5)])
@pytest.mark.parametrize("pps", [None, PpsOptions(line="A"), PpsOptions(line="A", chrony="/nowhere/imud.sock")])
def test_the_feed_follows_the_configuration(
    monkeypatch: pytest.MonkeyPatch, rmc: RmcOptions | None, pps: PpsOptions | None
) -> None:
    now_ns, port, source = [BEGIN_NS], FakePort(9600), FakeSource()

    def make() -> UtcFeed | None:
        host = HostClock(lambda: now_ns[0], lambda: now_ns[0] + OFFSET_NS, lambda: now_ns[0])
        return make_utc_feed(configured(rmc, pps), port, host)

    real = make()
    assert (real is None) == (rmc is None and pps is None)
    if real is None:
        return
    assert real.status().source.startswith("gpsd" if rmc else "")
    assert bool(real.status().source) == (rmc is not None)
    real.close()
    monkeypatch.setattr(utc_module, "RMC_SOURCES", {"gpsd": lambda _settings, _context: source})
    host = HostClock(lambda: BEGIN_NS, lambda: BEGIN_NS, lambda: BEGIN_NS)
    device = Attachments(configured(rmc, None), GPIO_LINES, port, DeviceEvents("bow", Ledger(), print), host)
    status = device.utc_status()
    assert (status and status.source) == ("test" if rmc else None)
    keeper = make()
    assert keeper is not None
    keeper.tick(BEGIN_NS, None)
    assert source.started == (rmc is not None)
    for second in range(1, 7):
        keeper.on_pulses([Edge(BEGIN_NS + second * NS_PER_S, True, second)])
        now_ns[0] = BEGIN_NS + second * NS_PER_S + NS_PER_S // 5
        source.give(build((UTC_S + second) * NS_PER_S), now_ns[0])
    assert len(port.written) == (6 if rmc is not None else 0)
    to_chrony = pps is not None and pps.chrony and rmc is not None  # imud must know the second of a pulse
    assert bool(keeper.status().chrony_refused) == bool(to_chrony)
    keeper.close()
