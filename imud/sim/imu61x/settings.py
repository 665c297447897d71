"""Parameters of a simulated Forsense IMU61x in RAM and flash, and the commands that change them.

Manual "IMU61X Interface Protocol and Instructions", tables 9 and 12. A value that the device does not have becomes the
default where the manual names one, and is refused otherwise (assumed).
"""

from dataclasses import dataclass, replace
from typing import Final

from imud.devices.imu61x.common.family import FILTER_DEFAULT, I2C_ADDRESSES
from imud.devices.imu61x.uart.commands import BAUD_RATES, RATES_HZ, BusMode, OutputMode
from imud.devices.imu61x.uart.replies import Parameter
from imud.sample import Vector3

GYRO_OFFSETS: Final = (Parameter.GYRO_X_OFF, Parameter.GYRO_Y_OFF, Parameter.GYRO_Z_OFF)
INSTALLATION_ANGLES: Final = (Parameter.INSTALL_X_OFF, Parameter.INSTALL_Y_OFF, Parameter.INSTALL_Z_OFF)


class ParameterRefused(ValueError):
    """A parameter or value that the device does not have."""


@dataclass(frozen=True, slots=True)
class Imu61xSettings:
    """Settings that CMD 5 saves. The defaults are the factory's."""

    mode: OutputMode = OutputMode.STREAM
    baud: int = 115_200
    rate_hz: int = 100
    bus_mode: BusMode = BusMode.SPI
    i2c_address: int = I2C_ADDRESSES[0]
    filter_control: int = FILTER_DEFAULT
    gyro_off_deg_s: Vector3 = (0.0, 0.0, 0.0)
    """Taken off what the gyroscope measures."""
    install_off_deg: Vector3 = (0.0, 0.0, 0.0)

    def value(self, index: int) -> float:
        """A parameter by its index. Raises ParameterRefused."""
        values: dict[int, float] = {
            Parameter.BAUD: self.baud,
            Parameter.AHRS_RATE: self.rate_hz,
            Parameter.BUS_MODE: self.bus_mode.value,
            Parameter.I2C_ADDRESS: self.i2c_address,
            Parameter.FILTER: self.filter_control,
            **dict(zip(GYRO_OFFSETS, self.gyro_off_deg_s, strict=True)),
            **dict(zip(INSTALLATION_ANGLES, self.install_off_deg, strict=True)),
        }
        if index not in values:
            raise ParameterRefused(f"parameter {index}")
        return values[index]


def changed(settings: Imu61xSettings, index: int, value: float) -> Imu61xSettings:
    """The settings after CMD 14. Raises ParameterRefused."""
    factory = Imu61xSettings()
    match index:
        case Parameter.BAUD:
            return replace(settings, baud=int(value) if value in BAUD_RATES else factory.baud)
        case Parameter.AHRS_RATE:
            return replace(settings, rate_hz=int(value) if value in RATES_HZ else factory.rate_hz)
        case Parameter.BUS_MODE if value in [mode.value for mode in BusMode]:
            return replace(settings, bus_mode=BusMode(int(value)))
        case Parameter.I2C_ADDRESS if value in I2C_ADDRESSES:
            return replace(settings, i2c_address=int(value))
        case Parameter.FILTER if 0 <= value <= 0xFF and value == int(value):
            return replace(settings, filter_control=int(value))
    raise ParameterRefused(f"parameter {index} = {value}")
