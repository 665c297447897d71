"""One truth, four buses: the same motion at the same instants, read in every format, agrees within their resolutions.

No noise and no time passes: the simulated devices are asked for what they measured at instants that all of them have.
The resolutions are worked out by hand from the manual's layouts; half a step is the most that rounding can cost.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import dist

import pytest

from imud.contracts.codec import CodecEvent
from imud.contracts.polling import PolledCodec, PolledEvent, Transfer, TransferScript, run_transfer_script
from imud.devices.imu61x.can.codec import Imu61xCanCodec, Imu61xCanSettings
from imud.devices.imu61x.common.register_driver import RegisterSettings
from imud.devices.imu61x.i2c.codec import Imu61xI2cCodec
from imud.devices.imu61x.i2c.driver import DRIVER as I2C
from imud.devices.imu61x.spi.codec import Imu61xSpiCodec
from imud.devices.imu61x.spi.driver import DRIVER as SPI
from imud.devices.imu61x.spi.session import SpiDeviceSettings
from imud.devices.imu61x.uart.codec import Imu61xCodec
from imud.ledger import Ledger
from imud.sample import Measurement
from imud.sim.imu61x.can import Imu61xCanHardware, Imu61xCanModule
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.imu61x.settings import Imu61xSettings
from imud.sim.imu61x.uart import Imu61xHardware, Imu61xModule
from imud.sim.physics.motion import Truth, swing
from tests.support.simulated_modules import over_i2c, over_spi

EPOCH_NS = 5_000_000_000
"""Zero of the motion, the same for all devices."""
STEP_NS = 10_000_000
INSTANTS = [EPOCH_NS + 500_000_000 + n * STEP_NS for n in range(1, 201)]
"""2 s of motion from 510 ms after power-on, where all have booted."""
MOTION = swing(9.80665)

G, DEG = 9.80665, 0.017453292519943295


@dataclass(frozen=True)
class Resolution:
    """Half a step of a format in SI; None or 0 if the format does not carry the value."""

    accel_m_s2: float
    gyro_rad_s: float
    temperature_c: float | None = None
    euler_rad: float = 0.0


# Steps of a 32-bit float, 24 bits of fraction: a value in [2^n, 2^(n+1)) comes in steps of 2^(n-23).
# accel below 2 g: steps of 2^-23 g, half is 2^-24 = 5.96e-8 g = 5.85e-7 m/s²
# gyro below 128 °/s: 2^-17 °/s, half is 2^-18 = 3.81e-6 °/s = 6.66e-8 rad/s
# angles below 128°: half is 2^-18 = 3.81e-6° = 6.66e-8 rad; temperature below 64 °C: 2^-18, half is 2^-19 = 1.91e-6 °C
FLOATS = Resolution(5.85e-7, 6.66e-8, 1.91e-6, 6.66e-8)
RESOLUTIONS = {
    "uart": FLOATS,
    "i2c": Resolution(5.85e-7, 6.66e-8, 1.91e-6),
    "spi extended": FLOATS,
    # temperature as int16 of 0.01 °C: half is 0.005
    "can": Resolution(5.85e-7, 6.66e-8, 0.005, 6.66e-8),
    # accel 0.2 g / 65536 = 3.0518e-6 g, half is 1.5259e-6 g = 1.4964e-5 m/s²
    # gyro 0.016 °/s / 65536 = 2.4414e-7 °/s, half is 1.2207e-7 °/s = 2.1305e-9 rad/s
    "spi standard": Resolution(1.4964e-5, 2.1306e-9),
    # accel a thousandth of the burst's step: half is 1.4964e-8 m/s²
    # temperature 1 / 263.4 / 65536 = 5.7931e-8 °C, half is 2.8965e-8
    "spi registers": Resolution(1.4965e-8, 2.1306e-9, 2.8966e-8),
}
ROUNDING = 1 + 1e-6
"""Arithmetic of 64-bit floats on the way, and the last digit of the numbers above."""

Read = Mapping[int, Measurement]
"""What was measured, by the instant."""


def by_uart() -> Read:
    module = Imu61xModule(EPOCH_NS, Imu61xSettings(rate_hz=100), Imu61xHardware(motion=MOTION, skew_ppm=0, boot_ms=500))
    codec = Imu61xCodec(Ledger())
    found: dict[int, Measurement] = {}
    for instant_ns in INSTANTS:
        events = [event for burst in module.advance(instant_ns + STEP_NS - 1) for event in codec.feed(burst.data)]
        found[instant_ns] = only(events)
    return found


def by_can() -> Read:
    hardware = Imu61xCanHardware(rate_hz=100, motion=MOTION, skew_ppm=0, boot_ms=510)
    module = Imu61xCanModule(EPOCH_NS, hardware)
    codec = Imu61xCanCodec(Ledger(), Imu61xCanSettings())
    found: dict[int, Measurement] = {}
    for instant_ns in INSTANTS:
        events: list[CodecEvent] = []
        for frame in module.advance(instant_ns + STEP_NS - 1):
            events += codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.due_ns)
        found[instant_ns] = only(events)
    return found


def by_i2c() -> Read:
    settings = RegisterSettings()
    return by_polls(I2C.set_up(settings), Imu61xI2cCodec(Ledger(), settings), over_i2c)


def by_spi(burst: str) -> Read:
    settings = SpiDeviceSettings(burst=burst)  # type: ignore[arg-type]  # passed on as given
    return by_polls(SPI.set_up(settings), Imu61xSpiCodec(Ledger(), settings), over_spi)


def by_polls(
    set_up: TransferScript[Mapping[str, str]],
    codec: PolledCodec,
    transfer: Callable[[Imu61xRegisters, Transfer], bytes],
) -> Read:
    """Set the device up, then read it at each instant."""
    now_ns = EPOCH_NS
    device = Imu61xRegisters(lambda: now_ns, motion=MOTION)
    run_transfer_script(set_up, lambda one: transfer(device, one))
    found: dict[int, Measurement] = {}
    for now_ns in INSTANTS:
        found[now_ns] = only(codec.decode(0, transfer(device, codec.polls[0].transfer)))
        assert device.latched_ns == now_ns
    return found


def only(events: Sequence[CodecEvent | PolledEvent]) -> Measurement:
    (event,) = events
    assert isinstance(event, Measurement)
    return event


@pytest.fixture(scope="module")
def read() -> dict[str, Read]:
    return {
        "uart": by_uart(),
        "i2c": by_i2c(),
        "spi standard": by_spi("standard"),
        "spi extended": by_spi("extended"),
        "spi registers": by_spi("registers"),
        "can": by_can(),
    }


def differences(a: Measurement | Truth, b: Measurement | Truth) -> dict[str, float]:
    """The largest difference of any axis, by field that both have."""
    found: dict[str, float] = {}
    for name in ("accel_m_s2", "gyro_rad_s", "euler_rad"):
        one, other = getattr(a, name), getattr(b, name)
        if one is not None and other is not None:
            found[name] = max(dist([x], [y]) for x, y in zip(one, other, strict=True))
    if a.temperature_c is not None and b.temperature_c is not None:
        found["temperature_c"] = abs(a.temperature_c - b.temperature_c)
    return found


@pytest.mark.parametrize("name", RESOLUTIONS)
def test_each_format_is_the_truth_to_half_a_step(read: dict[str, Read], name: str) -> None:
    allowed = RESOLUTIONS[name]
    worst: dict[str, float] = {}
    for instant_ns, measured in read[name].items():
        truth = MOTION.at((instant_ns - EPOCH_NS) / 1e9)
        for field, value in differences(measured, truth).items():
            worst[field] = max(worst.get(field, 0.0), value)
    worst.pop("euler_rad", None)  # the truth has another convention; formats are compared with each other below
    for field, value in worst.items():
        half_step = getattr(allowed, field)
        assert value <= half_step * ROUNDING, field
        assert value > 0.2 * half_step, f"{field}: the resolution is worse than it need be said"
    assert {"accel_m_s2", "gyro_rad_s"} <= set(worst)
    assert ("temperature_c" in worst) is (allowed.temperature_c is not None)


def test_formats_with_angles_agree_within_both_of_their_resolutions(read: dict[str, Read]) -> None:
    """The truth has another convention of angles."""
    with_angles = {name for name in read if read[name][INSTANTS[0]].euler_rad is not None}
    assert with_angles == {"uart", "spi extended", "can"}
    for one, other in combinations(sorted(with_angles), 2):
        for instant_ns in INSTANTS:
            found = differences(read[one][instant_ns], read[other][instant_ns])
            assert found["euler_rad"] <= 2 * FLOATS.euler_rad * ROUNDING, (one, other, instant_ns - EPOCH_NS)


def test_the_motion_is_one_that_would_show_a_mistake() -> None:
    """Every axis moves and every value differs from the others, within the ranges that the resolutions are for."""
    truths = [MOTION.at((instant_ns - EPOCH_NS) / 1e9) for instant_ns in INSTANTS]
    for axis in range(3):
        accel = [truth.accel_m_s2[axis] for truth in truths]
        gyro = [truth.gyro_rad_s[axis] for truth in truths]
        assert max(accel) - min(accel) > 0.5
        assert max(gyro) - min(gyro) > 0.2
        assert max(map(abs, accel)) < 2 * G
        assert max(map(abs, gyro)) < 128 * DEG
        assert max(abs(truth.euler_rad[axis]) for truth in truths) < 128 * DEG
