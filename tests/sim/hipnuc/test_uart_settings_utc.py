"""The simulated device changes to UTC when PPS and RMC match (manual 1.2.1), and never changes back."""

from collections.abc import Callable
from itertools import pairwise

import pytest

from imud.formats.nmea0183 import build
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings
from imud.sim.physics import Still
from tests.support.simulated_modules import BEGIN_NS, Hi91, unpack_hi91

UTC_S = 1_795_000_000
NO_UTC = 1 << 11


class Receiver:
    """A GNSS receiver connected to a device. It sends a pulse at each full second, and a sentence some time later."""

    def __init__(self, hardware: HipnucHardware) -> None:
        self.module = HipnucModule(BEGIN_NS, ModuleSettings(), hardware)
        self.second = UTC_S
        self.begin_ns = BEGIN_NS + hardware.boot_ms * NS_PER_MS + 123_456
        """CLOCK_MONOTONIC at `second`."""
        self.frames: list[tuple[int, Hi91]] = []
        """Pairs of (sampling time in UTC in ns, frame)."""

    def utc_ns(self, t_ns: int) -> int:
        return self.second * NS_PER_S + t_ns - self.begin_ns

    def go(self, seconds: int, *, pulse: bool = True, says: int | None = 0, late_ms: int = 150) -> None:
        """Let seconds pass. `says` is the error of the sentence in s; None for no sentence."""
        for _ in range(seconds):
            if pulse:
                self.module.mark(self.begin_ns)
            if says is not None:
                self.sentence(build((self.second + says) * NS_PER_S), late_ms)
            self.second += 1
            self.begin_ns += NS_PER_S
            self.advance()

    def sentence(self, data: bytes, late_ms: int) -> None:
        self.module.receive(data, self.begin_ns + late_ms * NS_PER_MS)

    def advance(self) -> None:
        for burst in self.module.advance(self.begin_ns):
            if burst.sample_ns is None:  # incomplete due to a restart
                continue
            self.frames.append((self.utc_ns(burst.sample_ns), unpack_hi91(burst.data)))

    def last(self, seconds: int) -> list[tuple[int, Hi91]]:
        return [(utc_ns, frame) for utc_ns, frame in self.frames if utc_ns >= (self.second - seconds) * NS_PER_S]

    def error_ms(self, modulus: int = 2**32, seconds: int = 1) -> list[float]:
        """Return the true time minus the time of the device, ms, over the last `seconds`."""
        half = modulus / 2
        return [
            (utc_ns / NS_PER_MS - frame.system_time_ms + half) % modulus - half for utc_ns, frame in self.last(seconds)
        ]


def still(skew_ppm: float = 20.0, **values: object) -> HipnucHardware:
    return HipnucHardware(motion=Still(), skew_ppm=skew_ppm, **values)  # type: ignore[arg-type]  # named by the caller


def test_time_becomes_utc_at_once_until_a_reboot() -> None:
    receiver = Receiver(still())
    receiver.go(3)
    assert all(frame.system_time_ms < 10_000 for _, frame in receiver.frames)
    receiver.go(1)
    assert receiver.frames[-1][1].system_time_ms > 10_000
    receiver.go(3)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms())
    times = [frame.system_time_ms for _, frame in receiver.frames]
    jumps = [after - before for before, after in pairwise(times) if abs(after - before - 10) > 1]
    assert len(jumps) == 1
    assert times[-1] == pytest.approx((UTC_S + 7) * 1000 % 2**32, abs=11)

    receiver = Receiver(still(utc_epoch="day"))
    receiver.go(6)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms(86_400_000))
    assert receiver.frames[-1][1].system_time_ms < 86_400_000

    receiver = Receiver(still(utc_epoch="day"))
    receiver.go(8)
    for _, frame in receiver.last(1):
        assert frame.word_1_2 == frame.system_time_ms % 1000

    receiver = Receiver(still())
    receiver.go(6)
    receiver.module.reboot(receiver.begin_ns)
    receiver.go(1, says=None)
    assert receiver.frames[-1][1].system_time_ms < 2000


@pytest.mark.manual("B 1.2.1 RMC sentences")
def test_midnight_many_sentences_the_status_bit_and_lost_pulses() -> None:
    for epoch, modulus, begin_s in (("day", 86_400_000, 1_795_046_400 - 8), ("unix", 2**32, 1_799_678_000)):
        receiver = Receiver(still(utc_epoch=epoch))
        receiver.second = begin_s - begin_s * 1000 % modulus // 1000 + modulus // 1000 - 8
        receiver.go(16)
        assert all(-0.05 <= error < 1.05 for error in receiver.error_ms(modulus))
        assert receiver.frames[-1][1].system_time_ms < 10_000

    receiver = Receiver(still())
    for _ in range(6):
        receiver.module.mark(receiver.begin_ns)
        for tenth in range(10):
            utc_ns = receiver.second * NS_PER_S + tenth * 100 * NS_PER_MS
            receiver.sentence(build(utc_ns), 100 * tenth + 60)
        receiver.go(1, pulse=False, says=None)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms())

    receiver = Receiver(still(firmware=169))
    receiver.go(6)
    statuses = [frame.word_1_2 for _, frame in receiver.frames]
    assert statuses[0] & NO_UTC
    assert not statuses[-1] & NO_UTC
    receiver.go(4, pulse=False)
    assert receiver.frames[-1][1].word_1_2 & NO_UTC
    receiver.go(1)
    assert not receiver.frames[-1][1].word_1_2 & NO_UTC

    receiver = Receiver(still(skew_ppm=100.0))
    receiver.go(6)
    receiver.go(100, pulse=False, says=None)
    drifted = receiver.error_ms()
    assert min(drifted) < -9  # 100 ppm over 100 s
    receiver.go(2, says=None)
    assert all(-0.2 <= error < 1.2 for error in receiver.error_ms())
    times = [frame.system_time_ms for _, frame in receiver.last(102)]
    assert all(abs(after - before) <= 20 for before, after in pairwise(times))


@pytest.mark.parametrize(("pulse", "says"), [(False, 0), (True, None)], ids=["without pulses", "without sentences"])
def test_both_are_needed(pulse: bool, says: int | None) -> None:
    receiver = Receiver(still())
    receiver.go(8, pulse=pulse, says=says)
    assert receiver.frames[-1][1].system_time_ms < 10_000


@pytest.mark.parametrize(
    "spoil",
    [
        lambda utc_ns: build(utc_ns, valid=False), lambda utc_ns: build(utc_ns).replace(b"A*", b"D*"),
        lambda utc_ns: build(utc_ns).replace(b"RMC", b"GGA"), lambda utc_ns: build(utc_ns + 500 * NS_PER_MS),
        lambda utc_ns: build(utc_ns)[:40],
    ],
    ids=["status V", "checksum", "another sentence", "not yet", "cut"],
)  # fmt: skip
def test_bad_sentences_say_nothing(spoil: Callable[[int], bytes]) -> None:
    receiver = Receiver(still())
    for _ in range(8):
        receiver.module.mark(receiver.begin_ns)
        receiver.sentence(spoil(receiver.second * NS_PER_S), 150)
        receiver.go(1, pulse=False, says=None)
    assert receiver.frames[-1][1].system_time_ms < 10_000


def test_one_wrong_sentence_changes_nothing_and_a_lasting_change_is_followed() -> None:
    receiver = Receiver(still())
    receiver.go(6)
    receiver.go(1, says=5)
    receiver.go(2)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms())
    receiver.go(3, says=5)
    assert all(-5000.05 <= error < -4998.95 for error in receiver.error_ms())

    receiver = Receiver(still())
    receiver.go(6)
    for _ in range(5):
        receiver.module.mark(receiver.begin_ns)
        receiver.module.mark(receiver.begin_ns + 400 * NS_PER_MS)
        receiver.module.mark(receiver.begin_ns + 700 * NS_PER_MS)
        receiver.go(1, pulse=False, says=None)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms(seconds=5))
