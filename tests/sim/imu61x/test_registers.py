"""The simulated register file: pipeline, windows, latched values, and its faults."""

import errno

import pytest

from imud.drivers.imu61x import spi
from imud.drivers.imu61x.spi import READ_STATE, State
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import STANDARD_GRAVITY_M_S2
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.imu61x.uart import RegisterBehaviour
from imud.sim.physics import swing

MS = 1_000_000


class Clock:
    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        return self.now


def device(**more: object) -> tuple[Imu61xRegisters, Clock]:
    clock = Clock()
    return Imu61xRegisters(clock, **more), clock  # type: ignore[arg-type]  # passed on as given


def spoken(one: Imu61xRegisters, *words: int) -> list[int]:
    """Return the replies to the words. Each word has its own activation of chip select."""
    return [int.from_bytes(miso, "big") for miso in one.spi([word.to_bytes(2, "big") for word in words])]


@pytest.mark.manual("A 2.3 answers")
def test_answer_comes_with_the_second_word_after_it_even_in_another_transaction() -> None:
    one, _ = device(product="IMU618")
    assert spoken(one, 0xFE01, 0x6A00, 0x6C00, 0x6E00, 0x7000)[3:] == [0x0000, 0x494D]
    assert spoken(one, 0x7E00, 0x7E00) == [0x5536, 0x3138]
    assert spoken(one, 0x7E00) == [1]
    one, clock = device(update_ns=10 * MS)
    clock.now = 19 * MS
    before = one.i2c([b"\x12", 32])
    assert one.latched_ns == 10 * MS
    clock.now = 19 * MS + 999_999
    assert one.i2c([b"\x12", 32]) == before
    clock.now = 20 * MS
    assert one.i2c([b"\x12", 32]) != before
    one.faults.frozen = True
    clock.now = 90 * MS
    one.i2c([b"\x12", 32])
    assert one.latched_ns == 20 * MS


@pytest.mark.parametrize("burst", spi.POLLS)
def test_values_are_the_truth_of_the_update(burst: str) -> None:
    one, clock = device()
    spoken(one, 0xFE01, 0x8D00 | (burst == "extended"), 0xFE00)
    clock.now, transactions = 1_234 * MS, one.transactions
    codec = spi.DRIVER.make_codec(Ledger(), spi.DRIVER.settings(burst=burst))
    (found,) = codec.decode(0, b"".join(one.spi(spi.POLLS[burst][0].transfer.sends, 3)))
    assert isinstance(found, Measurement)
    truth = swing(STANDARD_GRAVITY_M_S2).at(1.234)
    assert found.accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=4e-5)
    assert found.gyro_rad_s == pytest.approx(truth.gyro_rad_s, abs=1e-6)
    assert found.temperature_c is None or found.temperature_c == pytest.approx(truth.temperature_c, abs=2e-3)
    assert one.transactions == transactions + 1


@pytest.mark.manual("A 2.4 WIN_CTRL", "A 2.4.1 reading", "A 2.1 mode")
def test_windows_bursts_modes_a_restart_and_variants_of_burst_ctrl() -> None:
    one, _ = device()
    assert spoken(one, 0x0600, 0x6C00, 0, 0)[2:] == [0, 0]  # configuration is not in window 0
    assert spoken(one, 0xFE01, 0x0600, 0x0E00, 0, 0)[3:] == [0xBB, 0]  # values are not in window 1
    one.spi([b"\xfe\x00"])
    spoken(one, 0x8644, 0x8D01)
    assert (one.filter, one.extended) == (0xBB, 0)  # writes to window 1 need this window
    one, _ = device()
    whole = one.spi(spi.READ_STANDARD.sends)[0]
    assert len(whole) == 32
    cut = b"".join(one.spi([spi.READ_STANDARD.sends[0][:8], bytes(24)]))
    assert cut[:8] == whole[:8] or cut[4:8] == whole[4:8]
    assert cut[12:] == bytes(len(cut) - 12)
    assert State(b"".join(device()[0].spi(READ_STATE.sends, 3))).product_id == b"\x00\x00IMU614"
    one, _ = device(modes=frozenset({3}))
    right, wrong = b"".join(one.spi(READ_STATE.sends, 3)), b"".join(one.spi(READ_STATE.sends, 0))
    assert State(right).product_id == b"\x00\x00IMU614"
    assert State(wrong).product_id != b"\x00\x00IMU614"
    one, _ = device()
    spoken(one, 0xFE01, 0x8644, 0x8D01)
    assert (one.filter, one.extended, one.window) == (0x44, 1, 1)
    one.restart()
    assert (one.filter, one.extended, one.window) == (0xBB, 0, 0)
    one, _ = device(behaviour=RegisterBehaviour(window_bits=0xA5FE))
    assert spoken(one, 0xFE01, 0x7E00, 0xFE00, 0x7E00, 0, 0)[3::2] == [0xA5FF, 0xA5FE]
    one, _ = device()
    good = one.i2c([b"\x6a", 8])
    one.faults.flips = 1
    flipped = one.i2c([b"\x6a", 8])
    assert sum((a ^ b).bit_count() for a, b in zip(good, flipped, strict=True)) == 1
    assert one.i2c([b"\x6a", 8]) == good
    one.faults.line = 0xFF
    assert one.i2c([b"\x6a", 8]) == b"\xff" * 8
    assert one.spi([b"\x00\x00"]) == [b"\xff\xff"]
    one.faults.error = errno.ENXIO
    with pytest.raises(OSError, match="ENXIO"):
        one.i2c([b"\x6a", 8])
    for behaviour, low, high in (
        (RegisterBehaviour(), 0x0100, 0x0001),
        (RegisterBehaviour(high_address=False), 0x0100, 0),
        (RegisterBehaviour(low_address=False), 0, 0x0001),
    ):
        one, _ = device(behaviour=behaviour)
        assert spoken(one, 0xFE01, 0x8D01, 0x0C00, 0x0D00, 0x7E00, 0x7E00)[4:] == [low, high]
