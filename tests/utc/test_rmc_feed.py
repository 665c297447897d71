"""Feed of sentences: transmission time, rejected sentences with their reasons, and a device that becomes UTC."""

from itertools import pairwise
from random import Random

import pytest

from imud.contracts.lines import UtcReference
from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.formats.nmea0183 import build, checksum
from imud.model.errors import LinkError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware
from imud.utc.rmc_feed import Refusal, RmcFeed

UTC_S = 1_795_000_000
BEGIN_NS = 1000 * NS_PER_S
"""CLOCK_MONOTONIC at UTC_S."""
OFFSET_NS = UTC_S * NS_PER_S - BEGIN_NS
WIRE_115200_NS = 70 * 10 * NS_PER_S // 115_200
GOOD = UtcReference(OFFSET_NS, NS_PER_MS)


class FeedBench:
    def __init__(self, rate_hz: int = 1, reference: UtcReference | None = GOOD, baud: int = 115_200) -> None:
        self.now_ns = BEGIN_NS
        self.sent: list[bytes] = []
        self.is_free = True
        self.broken = False
        self.bit_rate = baud
        self.feed = RmcFeed(self, lambda: self.now_ns, rate_hz)
        self.feed.reference = reference

    def write(self, data: bytes) -> None:
        if self.broken:
            raise LinkError("the port is gone")
        self.sent.append(data)

    def on_reset(self) -> None: ...

    def give(self, named_s: float, at_s: float, sentence: bytes | None = None, *, waited_s: float = 0.0) -> str:
        """Give the sentence of second `named_s` at `at_s`, both after UTC_S. Return the reason to reject it, or ""."""
        before = dict(self.feed.refused)
        t_rx_ns = BEGIN_NS + round(at_s * NS_PER_S)
        self.now_ns = t_rx_ns + round(waited_s * NS_PER_S)
        self.feed.on_sentence(sentence or build(UTC_S * NS_PER_S + round(named_s * NS_PER_S)), t_rx_ns)
        return next((kind for kind, count in self.feed.refused.items() if count != before.get(kind, 0)), "")


def test_sentences_are_passed_on_at_once_up_to_the_rate() -> None:
    bench = FeedBench()
    assert bench.give(0, 0.1) == ""
    assert bench.sent == [build(UTC_S * NS_PER_S)]
    assert (bench.feed.sent, bench.feed.refused) == (1, {})
    body = build(UTC_S * NS_PER_S)[1:-5].replace(b"GP", b"GN")
    bench = FeedBench()
    assert bench.give(0, 0.1, b"$%b*%02X\r\n" % (body, checksum(body))) == ""
    assert bench.sent == [build(UTC_S * NS_PER_S)], "another talker is made GP"
    bench = FeedBench(rate_hz=2)
    refusals = [bench.give(tenth / 10, tenth / 10 + 0.05) for tenth in range(30)]
    assert [n for n, refusal in enumerate(refusals) if not refusal] == [0, 5, 10, 15, 20, 25]
    assert set(refusals) == {"", Refusal.TOO_MANY}
    bench = FeedBench()
    bench.is_free = False
    assert bench.give(0, 0.1) == Refusal.BUSY
    bench.is_free = bench.broken = True
    assert bench.give(0, 0.2) == Refusal.LINK
    bench.broken = False
    assert bench.give(0, 0.3) == ""
    assert len(bench.sent) == 1


@pytest.mark.parametrize("rate_hz", [1, 2, 5, 10])
@pytest.mark.parametrize("reference", [None, GOOD])
def test_rate_counts_real_time(rate_hz: int, reference: UtcReference | None) -> None:
    """A hostile source sends 100 sentences per second, each with another time."""
    bench = FeedBench(rate_hz, reference)
    for index in range(2000):
        bench.give(index // 100 + index % 7 / 7 + index, index / 100)
        bench.give(index // 100 + index % 10 / 10, index / 100)
    assert bench.feed.sent <= 20 * rate_hz * 1.02 + 1
    assert bench.feed.sent + sum(bench.feed.refused.values()) == 4000


@pytest.mark.parametrize("rate_hz", [1, 5])
def test_rate_permits_jitter_and_drift(rate_hz: int) -> None:
    """The delay of a sentence changes by a third of a period, the oscillator of the host is 200 ppm slow."""
    bench = FeedBench(rate_hz, None)
    random = Random(1)
    for index in range(5000):
        period_s = 1 / rate_hz
        delay_s = random.uniform(0.1, 0.43) * period_s
        assert bench.give(index * period_s, (index * period_s) * (1 - 200e-6) + delay_s) == ""


@pytest.mark.parametrize(
    ("sentence", "refusal"),
    [
        (b"noise", Refusal.DAMAGED), (build(UTC_S * NS_PER_S)[:-4] + b"00\r\n", Refusal.DAMAGED),
        (b"", Refusal.DAMAGED), (build(UTC_S * NS_PER_S, valid=False), Refusal.NOT_VALID),
        (b"$GPRMC,,V,,,,,,,,,,N*53\r\n", Refusal.NOT_VALID),
    ],
)  # fmt: skip
def test_bad_sentences_are_refused(sentence: bytes, refusal: Refusal) -> None:
    bench = FeedBench()
    assert bench.give(0, 0.1, sentence or b"\x00") == refusal
    assert (bench.sent, bench.feed.refused) == ([], {refusal.value: 1})


REFERENCES = [GOOD, UtcReference(OFFSET_NS, 0), None]


@pytest.mark.parametrize("reference", REFERENCES, ids=["reference", "exact reference", "pulse line"])
@pytest.mark.parametrize(
    ("named_s", "at_s", "refusal"),
    [
        (0, 0.001, ""),
        (0, 0.9, ""),
        (0, 0.9745, Refusal.STALE),  # 6 ms on the wire and 20 ms of guard
        (0.5, 0.45, Refusal.AHEAD),
        (0.5, 0.55, ""),
    ],
)
def test_it_has_to_be_through_before_the_next_second(
    reference: UtcReference | None, named_s: float, at_s: float, refusal: str
) -> None:
    bench = FeedBench(reference=reference)
    if reference is None:
        bench.feed.on_pulse(BEGIN_NS)
        refusal = Refusal.STALE if refusal is Refusal.AHEAD else refusal  # without reference: of the second before
    assert bench.give(named_s, at_s) == refusal


def test_another_second_a_slow_port_a_late_sending_and_an_old_pulse() -> None:
    for at_s in (1.05, 1.5, 3.2, -0.02):
        assert FeedBench().give(0, at_s) == (Refusal.AHEAD if at_s < 0 else Refusal.STALE)
    assert FeedBench(baud=9600).give(0, 0.9) == ""
    assert FeedBench(baud=9600).give(0, 0.92) == Refusal.STALE  # 73 ms on the wire
    assert FeedBench().give(0, 0.1, waited_s=0.8) == ""
    assert FeedBench().give(0, 0.1, waited_s=0.9) == Refusal.STALE
    assert FeedBench(reference=None).give(0, 0.1, waited_s=1.0) == Refusal.STALE
    for error_ms, refusal in ((81, Refusal.STALE), (82, "")):  # three times the error and 5 ms: at most 250 ms
        assert FeedBench(reference=UtcReference(OFFSET_NS, error_ms * NS_PER_MS)).give(0, 1.5) == refusal
    bench = FeedBench(reference=None)
    bench.feed.on_pulse(BEGIN_NS)
    assert [bench.give(1, at_s) for at_s in (1.0999, 1.1)] == [Refusal.STALE, ""]  # a pulse is valid for 1.1 s


@pytest.mark.parametrize(("reference", "doubt_ms"), [(UtcReference(OFFSET_NS, 0), 5), (None, 0)])
def test_the_first_nanosecond_of_the_guard_is_too_late(reference: UtcReference | None, doubt_ms: int) -> None:
    wire_ns = len(build(UTC_S * NS_PER_S)) * uart_byte_ns(115_200)
    for early_ns, refusal in ((1, ""), (0, Refusal.STALE)):
        limit_s = ((980 - doubt_ms) * NS_PER_MS - wire_ns - early_ns) / NS_PER_S
        bench = FeedBench(reference=reference)
        if reference is None:
            assert FeedBench(reference=None).give(0, 0.1, waited_s=limit_s) == refusal, "without pulses"
            bench.feed.on_pulse(BEGIN_NS)
        assert bench.give(0, limit_s) == refusal


def test_a_module_that_is_fed_shows_utc() -> None:
    module = HipnucModule(BEGIN_NS - 3 * NS_PER_S, hardware=HipnucHardware(skew_ppm=30.0))
    bench = FeedBench()
    codec = DRIVER.make_codec(Ledger(), DRIVER.settings())
    ticks: list[int] = []
    for second in range(8):
        module.mark(BEGIN_NS + second * NS_PER_S)
        assert bench.give(second, second + 0.2) == ""
        module.receive(bench.sent[-1], bench.now_ns + WIRE_115200_NS)
        for burst in module.advance(BEGIN_NS + second * NS_PER_S + 999 * NS_PER_MS):
            for event in codec.feed(burst.data):
                assert isinstance(event, Measurement)
                assert event.dev_ticks is not None
                ticks.append(event.dev_ticks)
    assert 980 <= ticks[-1] - (UTC_S + 7) * 1000 % 2**32 < 1000
    assert sum(after - before != pytest.approx(10, abs=1) for before, after in pairwise(ticks)) == 1
