"""Table: the row `DRIVER` of the Forsense IMU61x on SPI."""

from random import Random
from typing import Any, Final

from imud.devices.imu61x.common.family import random_vector
from imud.devices.imu61x.common.register_driver import register_driver
from imud.devices.imu61x.spi.bursts import encode_standard
from imud.devices.imu61x.spi.codec import POLLS, Imu61xSpiCodec
from imud.devices.imu61x.spi.session import MODES, SpiDeviceSettings, probe, set_up
from imud.devices.imu61x.spi.settings import SETTINGS
from imud.devices.imu61x.spi.words import PIPELINE_BYTES
from imud.units import NS_PER_S, NS_PER_US


def _example_reading(random: Random) -> bytes:
    """A standard burst with random values, the words of the pipeline before it."""
    pipeline = random.randbytes(PIPELINE_BYTES)
    return pipeline + encode_standard(accel_m_s2=random_vector(random, 9.8), gyro_rad_s=random_vector(random, 2))


def _read_ns(options: SpiDeviceSettings, link: Any) -> int:
    """The bits at the bus's clock, and the pauses between words: 256 µs for a standard burst at 1 MHz."""
    transfer = POLLS[options.burst][0].transfer
    bits = 8 * sum(map(len, transfer.sends))
    speed_hz: int = link.speed_hz
    return bits * NS_PER_S // speed_hz + len(transfer.sends) * transfer.gap_us * NS_PER_US


DRIVER: Final = register_driver(
    "spi", SpiDeviceSettings, MODES, probe, set_up, Imu61xSpiCodec, _example_reading, _read_ns, SETTINGS
)
