"""The log contains each fault with its kind, each fault has its effect, and the seed decides the faults."""

from random import Random

import pytest

from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS
from imud.sim.ports.faults import Fault, FaultKind, FaultRates, Faults, rates_from
from imud.sim.sensor import Burst

STEP_NS = 10 * NS_PER_MS


def bursts(count: int) -> list[Burst]:
    random = Random(1)
    return [Burst(n * STEP_NS, DRIVER.example_frame(random), n * STEP_NS - 1, n) for n in range(count)]


def passed(faults: Faults, count: int = 300) -> list[tuple[Burst, Burst | None]]:
    return [(burst, faults.pass_on(burst)) for burst in bursts(count)]


def hit(faults: Faults) -> set[int]:
    return {fault.burst for fault in faults.log}


@pytest.mark.parametrize("kind", FaultKind)
def test_what_was_not_hit_arrives_as_it_was_and_what_was_is_noted(kind: FaultKind) -> None:
    faults = Faults(5, rates_from(f"{kind}=0.1"))
    for number, (before, after) in enumerate(passed(faults)):
        if number in hit(faults):
            assert after != before
        elif kind not in (FaultKind.DELAY, FaultKind.UNPLUG):  # DELAY and UNPLUG also affect later bursts
            assert after == before
    assert set(faults.counts) == {kind}
    assert (1 if kind is FaultKind.UNPLUG else 10) <= faults.counts[kind] <= 60
    assert faults.counts[kind] == len(faults.log)
    assert faults.bursts == 300


@pytest.mark.parametrize(
    ("kind", "least", "most"),
    [(FaultKind.CUT, -82, -1), (FaultKind.FLIP, 0, 0), (FaultKind.DROP, -1, -1), (FaultKind.INSERT, 1, 16)],
)
def test_length_tells_the_kind(kind: FaultKind, least: int, most: int) -> None:
    faults = Faults(3, rates_from(f"{kind}=1"))
    for before, after in passed(faults, 100):
        change = len(after.data if after else b"") - len(before.data)
        assert least <= change <= most or (kind is FaultKind.CUT and len(before.data) > 82 and change < 0)


def test_flips_wrong_rates_delays_unplugging_and_invalid_rates() -> None:
    for before, after in passed(Faults(3, FaultRates(flip=1.0)), 50):
        assert after
        assert sum((a ^ b).bit_count() for a, b in zip(before.data, after.data, strict=True)) == 1

    faults = Faults(2, FaultRates(wrong_baud=1.0), baud=115_200)
    assert all(after is None or after.data != before.data for before, after in passed(faults, 100))

    faults = Faults(3, FaultRates(delay=0.5, delay_ns=25 * NS_PER_MS))
    pairs = passed(faults)
    times = [after.due_ns for _, after in pairs if after]
    assert times == sorted(times)
    assert all(after and after.due_ns >= before.due_ns for before, after in pairs)
    assert faults.bursts_hit == 0

    faults = Faults(3, FaultRates(unplug=0.02, unplug_ns=55 * NS_PER_MS))
    pairs = passed(faults)
    first = faults.log[0].burst
    assert [after for _, after in pairs[first : first + 6]] == [None] * 6
    assert faults.unplugged_until_ns >= first * STEP_NS + 55 * NS_PER_MS
    assert sum(after is None for _, after in pairs) == faults.bursts_hit

    for text in ("flop=0.1", "flip", "flip=often", "flip=1.5", "flip=-1", "flip=nan"):
        with pytest.raises(ValueError, match="fault"):
            rates_from(text)


def test_the_ledger_of_a_codec_tells_the_same() -> None:
    faults, ledger = Faults(11, FaultRates(flip=0.05, cut=0.03, drop=0.03, insert=0.03)), Ledger()
    codec = DRIVER.make_codec(ledger, DRIVER.settings())
    events = [event for _, after in passed(faults, 400) if after for event in codec.feed(after.data)]
    events += codec.flush()
    untouched = 400 - len(hit(faults))
    measured = sum(isinstance(event, Measurement) for event in events)
    survivable = faults.counts[FaultKind.INSERT]  # bytes inserted directly before a frame do not damage it
    assert ledger.closes()
    assert untouched <= ledger.frames_in_samples <= untouched + survivable
    assert measured >= untouched

    assert rates_from("flip=0.5,delay=0.1,delay_ns=7") == FaultRates(flip=0.5, delay=0.1, delay_ns=7)
    assert not rates_from("").any()
    assert rates_from("cut=0.1").any()
    rates = FaultRates(flip=0.1, cut=0.1, delay=0.1)

    def run(seed: int) -> list[Fault]:
        faults = Faults(seed, rates)
        passed(faults)
        return faults.log

    assert run(1) == run(1)
    assert run(1) != run(2)
