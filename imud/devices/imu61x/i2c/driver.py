"""Table: the row `DRIVER` of the Forsense IMU61x on I2C."""

from random import Random
from typing import Final

from imud.devices.imu61x.common.family import I2C_ADDRESSES, random_vector
from imud.devices.imu61x.common.register_driver import RegisterSettings, register_driver
from imud.devices.imu61x.i2c.codec import Imu61xI2cCodec, encode_burst
from imud.devices.imu61x.i2c.session import probe, set_up


def _example_reading(random: Random) -> bytes:
    """A burst with random values."""
    accel_m_s2, gyro_rad_s = random_vector(random, 9.8), random_vector(random, 2)
    return encode_burst(accel_m_s2=accel_m_s2, gyro_rad_s=gyro_rad_s, temperature_c=random.uniform(-40, 85))


DRIVER: Final = register_driver("i2c", RegisterSettings, I2C_ADDRESSES, probe, set_up, Imu61xI2cCodec, _example_reading)
