"""Table: the row `DRIVER` of the Forsense IMU61x on SPI."""

from random import Random
from typing import Final

from imud.devices.imu61x.common.family import random_vector
from imud.devices.imu61x.common.register_driver import register_driver
from imud.devices.imu61x.spi.codec import Imu61xSpiCodec, encode_standard
from imud.devices.imu61x.spi.session import MODES, PIPELINE_BYTES, SpiDeviceSettings, probe, set_up


def _example_reading(random: Random) -> bytes:
    """A standard burst with random values, the words of the pipeline before it."""
    pipeline = random.randbytes(PIPELINE_BYTES)
    return pipeline + encode_standard(accel_m_s2=random_vector(random, 9.8), gyro_rad_s=random_vector(random, 2))


DRIVER: Final = register_driver("spi", SpiDeviceSettings, MODES, probe, set_up, Imu61xSpiCodec, _example_reading)
