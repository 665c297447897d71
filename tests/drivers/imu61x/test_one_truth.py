"""One motion on four buses: the values in every format are correct within half a step.

The simulated devices measure at common instants, without noise and without real time. The resolutions are computed by
hand from the layouts in the manual; half a step is the maximum rounding error.
"""

from collections.abc import Callable, Sequence
from functools import cache

import pytest

from imud.attitude.rotation import euler_zyx_from_quat
from imud.contracts.codec import CodecEvent, PolledCodec, PolledEvent
from imud.contracts.script import Transfer, TransferScript, run_transfer_script
from imud.contracts.setting import Reports
from imud.drivers.imu61x.can import Imu61xCanCodec, Imu61xCanOptions
from imud.drivers.imu61x.i2c import DRIVER as I2C
from imud.drivers.imu61x.i2c import Imu61xI2cCodec
from imud.drivers.imu61x.registers import RegisterOptions
from imud.drivers.imu61x.spi import DRIVER as SPI
from imud.drivers.imu61x.spi import Imu61xSpiCodec, SpiDeviceOptions
from imud.drivers.imu61x.uart.codec import Imu61xCodec
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.imu61x.can import Imu61xCanHardware, Imu61xCanModule
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.imu61x.uart import Imu61xHardware, Imu61xModule, Imu61xSettings
from imud.sim.physics import swing
from tests.support.simulated_modules import over_i2c, over_spi

EPOCH_NS = 5_000_000_000  # start of the motion, equal for all devices
STEP_NS = 10_000_000
INSTANTS = [EPOCH_NS + 500_000_000 + n * STEP_NS for n in range(1, 201)]
"""2 s of motion from 510 ms after power-on, when all devices have booted."""
MOTION = swing(9.80665)

# Steps of a 32-bit float with 24 bits of fraction: a value in [2^n, 2^(n+1)) has steps of 2^(n-23).
# accel below 2 g: steps of 2^-23 g, half is 2^-24 = 5.96e-8 g = 5.85e-7 m/s²
# gyro below 128 °/s: 2^-17 °/s, half is 2^-18 = 3.81e-6 °/s = 6.66e-8 rad/s
# angles below 128°: half is 2^-18 = 3.81e-6° = 6.66e-8 rad; temperature below 64 °C: 2^-18, half is 2^-19 = 1.91e-6 °C
FLOATS = {"accel_m_s2": 5.85e-7, "gyro_rad_s": 6.66e-8, "temperature_c": 1.91e-6, "euler_rad": 6.66e-8}
HALF_STEPS = {
    "uart": FLOATS,
    "i2c": {name: FLOATS[name] for name in ("accel_m_s2", "gyro_rad_s", "temperature_c")},
    "spi extended": FLOATS,
    # temperature as int16 of 0.01 °C: half is 0.005
    "can": FLOATS | {"temperature_c": 0.005},
    # accel 0.2 g / 65536 = 3.0518e-6 g, half is 1.5259e-6 g = 1.4964e-5 m/s²
    # gyro 0.016 °/s / 65536 = 2.4414e-7 °/s, half is 1.2207e-7 °/s = 2.1305e-9 rad/s
    "spi standard": {"accel_m_s2": 1.4964e-5, "gyro_rad_s": 2.1306e-9},
    # accel a thousandth of the burst's step: half is 1.4964e-8 m/s²
    # temperature 1 / 263.4 / 65536 = 5.7931e-8 °C, half is 2.8965e-8
    "spi registers": {"accel_m_s2": 1.4965e-8, "gyro_rad_s": 2.1306e-9, "temperature_c": 2.8966e-8},
}
"""Maximum error of each value in a format: half a step, SI."""
ROUNDING = 1 + 1e-6  # rounding of 64-bit floats, and of the last digit of the numbers above


def by_uart() -> list[Measurement]:
    module = Imu61xModule(EPOCH_NS, Imu61xSettings(rate_hz=100), Imu61xHardware(motion=MOTION, skew_ppm=0, boot_ms=500))
    codec = Imu61xCodec(Ledger())
    bursts = [module.advance(instant_ns + STEP_NS - 1) for instant_ns in INSTANTS]
    return [only([event for burst in one for event in codec.feed(burst.data)]) for one in bursts]


def by_can() -> list[Measurement]:
    hardware = Imu61xCanHardware(rate_hz=100, motion=MOTION, skew_ppm=0, boot_ms=510)
    module, codec = Imu61xCanModule(EPOCH_NS, hardware), Imu61xCanCodec(Ledger(), Imu61xCanOptions())
    sets = [module.advance(instant_ns + STEP_NS - 1) for instant_ns in INSTANTS]
    return [only([e for f in one for e in codec.feed_frame(f.can_id, f.extended, f.data, f.due_ns)]) for one in sets]


def by_polls(
    set_up: TransferScript[Reports], codec: PolledCodec, transfer: Callable[[Imu61xRegisters, Transfer], bytes]
) -> list[Measurement]:
    """Set up the device, then read it at each instant."""
    now_ns = EPOCH_NS
    device = Imu61xRegisters(lambda: now_ns, motion=MOTION)
    run_transfer_script(set_up, lambda one: transfer(device, one))
    found: list[Measurement] = []
    for now_ns in INSTANTS:
        found.append(only(codec.decode(0, transfer(device, codec.polls[0].transfer))))
        assert device.latched_ns == now_ns
    return found


def only(events: Sequence[CodecEvent | PolledEvent]) -> Measurement:
    (event,) = events
    assert isinstance(event, Measurement)
    return event


@cache
def read(name: str) -> list[Measurement]:
    if name in ("uart", "can"):
        return by_uart() if name == "uart" else by_can()
    if name == "i2c":
        return by_polls(I2C.set_up(RegisterOptions()), Imu61xI2cCodec(Ledger(), RegisterOptions()), over_i2c)
    settings = SpiDeviceOptions(burst=name.removeprefix("spi "))  # type: ignore[arg-type]  # a kind of burst
    return by_polls(SPI.set_up(settings), Imu61xSpiCodec(Ledger(), settings), over_spi)


@pytest.mark.parametrize("name", HALF_STEPS)
def test_each_format_is_the_truth_to_half_a_step(name: str) -> None:
    worst = dict.fromkeys(("accel_m_s2", "gyro_rad_s", "temperature_c", "euler_rad"), 0.0)
    for instant_ns, measured in zip(INSTANTS, read(name), strict=True):
        truth = MOTION.at((instant_ns - EPOCH_NS) / 1e9)
        true_values = truth._asdict() | {"euler_rad": euler_zyx_from_quat(truth.quat_wxyz)}
        for field in worst:
            value = getattr(measured, field)
            assert (value is not None) is (field in HALF_STEPS[name])
            if field in ("accel_m_s2", "gyro_rad_s", "euler_rad") and value is not None:
                errors = [abs(x - y) for x, y in zip(value, true_values[field], strict=True)]
                worst[field] = max(worst[field], *errors)
            elif value is not None:
                worst[field] = max(worst[field], abs(value - truth.temperature_c))
    for field, half_step in HALF_STEPS[name].items():
        assert worst[field] <= half_step * ROUNDING, field
        assert worst[field] > 0.2 * half_step, f"{field}: the resolution is worse than it need be said"
