"""Table: the row `DRIVER` of the Forsense IMU61x on I2C."""

from random import Random
from typing import Any, Final

from imud.devices.imu61x.common.family import I2C_ADDRESSES, random_vector
from imud.devices.imu61x.common.register_driver import RegisterSettings, register_driver
from imud.devices.imu61x.i2c.codec import READ_BURST, Imu61xI2cCodec, encode_burst
from imud.devices.imu61x.i2c.session import probe, set_up
from imud.devices.imu61x.i2c.settings import SETTINGS
from imud.units import NS_PER_S


def _example_reading(random: Random) -> bytes:
    """A burst with random values."""
    accel_m_s2, gyro_rad_s = random_vector(random, 9.8), random_vector(random, 2)
    return encode_burst(accel_m_s2=accel_m_s2, gyro_rad_s=gyro_rad_s, temperature_c=random.uniform(-40, 85))


BUS_HZ: Final = 400_000
"""The fastest clock of table 25; the one that the bus has is set in the system."""
BITS_PER_BYTE: Final = 9
"""Eight and the acknowledgement."""
OVERHEAD_BITS: Final = 2 * BITS_PER_BYTE + 3
"""The address twice, start, repeated start and stop."""


def _read_ns(_options: RegisterSettings, _link: Any) -> int:
    """318 bits, 795 µs."""
    (register,) = READ_BURST.sends
    bits = OVERHEAD_BITS + (len(register) + READ_BURST.read_bytes) * BITS_PER_BYTE
    return bits * NS_PER_S // BUS_HZ


DRIVER: Final = register_driver(
    "i2c", RegisterSettings, I2C_ADDRESSES, probe, set_up, Imu61xI2cCodec, _example_reading, _read_ns, SETTINGS
)
