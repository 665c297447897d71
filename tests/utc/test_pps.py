"""UTC from pulses and sentences, compared with the truth."""

from random import Random

import pytest

from imud.contracts.lines import UtcReference
from imud.formats.nmea0183 import build
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.utc.pps import PpsReference

UTC_S = 1_795_000_000
BEGIN_NS = 77 * NS_PER_S + 123_456_789


class Receiver:
    """Sentences, and pulses with the time stamps of a host whose oscillator is `ppm` fast."""

    def __init__(self, ppm: float = 30.0, late_ns: float = 0.0) -> None:
        self.seconds: list[int | None] = []  # known second of each accepted pulse
        self.reference = PpsReference()
        self.number = 0
        self._rate = 1 + ppm * 1e-6
        self._late_ns = late_ns
        self._random = Random(1)

    def t_ns(self, after_s: float = 0.0) -> int:
        return BEGIN_NS + round((self.number + after_s) * NS_PER_S * self._rate)

    def go(self, seconds: int, *, pulse: bool = True, says: int | None = 0) -> None:
        for _ in range(seconds):
            self.number += 1
            if pulse and self.reference.on_pulse(self.t_ns() + round(abs(self._random.gauss(0, self._late_ns)))):
                self.seconds.append(self.reference.second_s)
            if says is not None:
                self.reference.on_sentence(build((UTC_S + self.number + says) * NS_PER_S), self.t_ns(0.3))

    def known(self, after_s: float = 0.0) -> UtcReference:
        reference = self.reference.reference(self.t_ns(after_s))
        assert reference is not None
        return reference

    def error_ns(self, after_s: float = 0.0) -> float:
        """Return the estimate minus the truth, ns."""
        truth_ns = UTC_S * NS_PER_S + (self.number + after_s) * NS_PER_S
        return self.known(after_s).offset_ns - (int(truth_ns) - self.t_ns(after_s))


def test_three_pulses_and_two_sentences_give_utc_or_another_second() -> None:
    receiver = Receiver()
    receiver.go(3)
    assert receiver.reference.reference(receiver.t_ns()) is None
    receiver.go(2)
    assert abs(receiver.error_ns()) < 1000
    assert abs(receiver.error_ns(0.9)) < 1000
    assert receiver.known().error_ns == pytest.approx(5000, rel=0.2)
    assert receiver.reference.pulses == 5
    receiver.go(5)
    assert [unix_s for unix_s in receiver.seconds if unix_s] == [UTC_S + n for n in range(5, 11)]
    receiver = Receiver()
    receiver.go(10)
    receiver.go(1, says=3)
    receiver.go(1)
    assert abs(receiver.error_ns()) < 1000
    receiver.go(2, says=3)
    assert receiver.error_ns() == pytest.approx(3 * NS_PER_S, abs=1000)


@pytest.mark.parametrize(("ppm", "late_ns"), [(-100.0, 0.0), (0.0, 5_000.0), (100.0, 5_000.0), (-100.0, 50_000.0)])
def test_the_time_stamp_error_covers_the_truth(ppm: float, late_ns: float) -> None:
    receiver, inside = Receiver(ppm, late_ns), 0
    receiver.go(20)
    for _ in range(100):
        receiver.go(1)
        inside += abs(receiver.error_ns(0.5)) <= 2 * receiver.known(0.5).error_ns
    assert inside >= 95


def test_gaps_are_bridged_until_they_are_too_long() -> None:
    receiver = Receiver()
    receiver.go(10)
    for gap in (0, 1, 5, 9):
        assert not receiver.reference.on_pulse(receiver.t_ns(0.4))
        assert not receiver.reference.on_pulse(receiver.t_ns(0.7))
        receiver.go(gap, pulse=False)
        receiver.go(1)
        assert abs(receiver.error_ns()) < 1000
    assert (receiver.reference.pulses_ignored, receiver.reference.pulses) == (8, 14)
    receiver.go(30, pulse=False, says=None)
    receiver.go(2, says=None)
    assert receiver.reference.pulses == 14
    receiver.go(4)
    assert abs(receiver.error_ns()) < 1000
    assert receiver.reference.pulses == 20
    receiver = Receiver()
    receiver.go(10, says=None)
    assert receiver.reference.pulses == 10
    assert receiver.reference.reference(receiver.t_ns()) is None
    assert not any(receiver.seconds)
    receiver = Receiver()
    receiver.go(20)
    receiver.go(100, pulse=False, says=None)
    assert abs(receiver.error_ns()) < 2 * receiver.known().error_ns
    assert receiver.known().error_ns > 100_000
    assert receiver.reference.reference(receiver.t_ns(600)) is None


def test_another_receiver_takes_over() -> None:
    receiver = Receiver()
    receiver.go(10)
    assert [receiver.reference.on_pulse(receiver.t_ns(n + 0.25)) for n in range(1, 5)] == [False, False, True, True]
    assert receiver.reference.reference(receiver.t_ns(5)) is None
    for _ in range(2):
        receiver.reference.on_sentence(build((UTC_S + 40) * NS_PER_S), receiver.t_ns(4.6))
    reference = receiver.reference.reference(receiver.t_ns(4.6))
    assert reference
    assert reference.offset_ns + receiver.t_ns(4.6) == pytest.approx((UTC_S + 40.35) * NS_PER_S, abs=1000)


@pytest.mark.parametrize(
    ("sentence", "after_s"),
    [
        (build(UTC_S * NS_PER_S, valid=False), 0.3), (build(UTC_S * NS_PER_S)[:-6], 0.3),
        (build(UTC_S * NS_PER_S + 500 * NS_PER_MS), 0.3), (build(UTC_S * NS_PER_S), 1.0),
        (build(UTC_S * NS_PER_S), -1e-9),
    ],
    ids=["status V", "damaged", "not yet", "at the next pulse", "before the pulse"],
)  # fmt: skip
def test_sentences_that_name_no_pulse_are_ignored(sentence: bytes, after_s: float) -> None:
    receiver = Receiver(0)
    receiver.go(5, says=None)
    for _ in range(3):
        receiver.reference.on_sentence(sentence, receiver.t_ns(after_s))
    assert receiver.reference.sentences_ignored == 3
    assert receiver.reference.reference(receiver.t_ns()) is None


def accepted(*steps_ns: int) -> list[bool]:
    """Return whether a reference with five exact pulses accepts pulses after these steps, each alone."""
    found = []
    for step_ns in steps_ns:
        receiver = Receiver(0)
        receiver.go(5)
        found.append(receiver.reference.on_pulse(receiver.t_ns() + step_ns))
    return found


def test_pulses_follow_each_other_and_give_utc_for_ten_minutes() -> None:
    second, off = NS_PER_S, NS_PER_MS // 2
    assert accepted(second - off, second + off, 10 * second - 10 * off, 10 * second + 10 * off) == [True] * 4
    assert accepted(second - off - 1, second + off + 1, 10 * second + 10 * off + 1, 11 * second, 0) == [False] * 5
    receiver = Receiver(0)
    receiver.go(3, says=None)
    for after_s in (0, 0.1):  # a receiver with 10 Hz
        assert receiver.reference.reference(receiver.t_ns()) is None
        receiver.reference.on_sentence(build((UTC_S + 3) * NS_PER_S), receiver.t_ns(after_s))
    assert receiver.known(600).offset_ns == UTC_S * NS_PER_S - BEGIN_NS
    assert receiver.reference.reference(receiver.t_ns(600) + 1) is None


def test_the_fit_uses_the_last_16_pulses_and_their_spread() -> None:
    receiver = Receiver(100)
    receiver.go(40)
    begin_ns = receiver.t_ns()
    for number in range(1, 17):  # the oscillator has no error any longer
        receiver.reference.on_pulse(begin_ns + number * NS_PER_S)
    (reference, later) = (receiver.reference.reference(begin_ns + (16 + wait) * NS_PER_S) for wait in (0, 100))
    assert reference is not None
    assert later is not None
    assert abs(later.offset_ns - reference.offset_ns) <= 1
    assert reference.error_ns == 5000
    assert later.error_ns == pytest.approx(100_000, rel=0.01)  # 5 µs, and 1 µs per second

    # every second time stamp is 10 µs late: the median is at 5 µs, sigma is 1.4826 · 5 µs, the quartile is 5 µs higher
    receiver = Receiver(0)
    receiver.go(4)
    for number in range(1, 17):
        receiver.reference.on_pulse(receiver.t_ns(number) + 10_000 * (number % 2))
    found = receiver.reference.reference(receiver.t_ns(16))
    assert found is not None
    assert found.error_ns == pytest.approx((5_000**2 + (1.4826 * 5_000) ** 2 + 5_000**2) ** 0.5, rel=0.15)
