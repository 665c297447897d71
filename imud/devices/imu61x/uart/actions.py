"""Actions of an IMU61x on a UART: commands of sections 1.4 to 1.6 of the manual, each with what must follow it.

The annotations are the only check and description of the arguments; `extra` has the unit and the manual's section.
"""

from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions, Risk, Target
from imud.contracts.session import RequestScript
from imud.devices.imu61x.common.family import FilterCode, I2cAddress, filter_control
from imud.devices.imu61x.uart import session
from imud.devices.imu61x.uart.commands import BaudRate, BusMode, RateHz
from imud.devices.imu61x.uart.replies import Parameter

Baud = Annotated[
    BaudRate, Meta(description="rate of the UART", extra={"unit": "bit/s", "section": "1.6, table 12, parameter 3"})
]
OutputRate = Annotated[
    RateHz, Meta(description="AHRS frames per second", extra={"unit": "Hz", "section": "1.6, table 12, parameter 21"})
]
AccelFilter = Annotated[FilterCode, Meta(description="code of table 21 (11: 47 Hz)")]
GyroFilter = Annotated[FilterCode, Meta(description="the same of the gyroscope")]
Address = Annotated[
    I2cAddress, Meta(description="7-bit I2C address, 24 is 0x18", extra={"section": "1.6, table 12, parameter 30"})
]
SecondBus = Annotated[
    Literal["uart_only", "spi", "i2c", "by_pin"],
    Meta(
        description="`by_pin`: a pin that is open or low selects SPI, high selects I2C",
        extra={"section": "1.6, table 12, parameter 27"},
    ),
]
Heading = Annotated[
    float, Meta(ge=0, le=360, description="the new heading", extra={"unit": "°", "section": "1.6, table 12, CMD 4"})
]


def _factory_reset(target: Target) -> RequestScript[session.BaudChange]:
    return session.factory_reset(target.baud)


def _baud(target: Target, *, baud: Baud) -> RequestScript[session.BaudChange]:
    return session.change_baud(baud, target.baud)


def _rate(_target: Target, *, rate_hz: OutputRate) -> RequestScript[None]:
    return session.write_parameter(Parameter.AHRS_RATE, rate_hz)


def _filter(_target: Target, *, accel_filter: AccelFilter, gyro_filter: GyroFilter) -> RequestScript[None]:
    return session.write_parameter(Parameter.FILTER, filter_control(accel_filter, gyro_filter))


def _i2c_address(_target: Target, *, address: Address) -> RequestScript[None]:
    return session.write_parameter(Parameter.I2C_ADDRESS, address)


def _bus(_target: Target, *, bus: SecondBus) -> RequestScript[None]:
    return session.write_parameter(Parameter.BUS_MODE, BusMode[bus.upper()])


def _heading(_target: Target, *, heading_deg: Heading = 0.0) -> RequestScript[None]:
    return session.reset_heading(heading_deg)


ACTIONS: Final[Actions] = {
    "start_streaming": Action("send samples", lambda _target: session.start_streaming()),
    "stop_streaming": Action("command mode: send nothing but replies", lambda _target: session.stop_streaming()),
    "save": Action("write all parameters to flash; answers whether it acknowledged", lambda _target: session.save()),
    "restart": Action(
        "restart it and wait until it answers; what was not saved is lost", lambda _target: session.restart()
    ),
    "factory_reset": Action("factory settings, and follow it to their baud rate", _factory_reset, Risk.RESET),
    "baud": Action("set and save the baud rate and follow", _baud, Risk.CONNECTION),
    "rate": Action("set the output rate", _rate),
    "filter": Action("set the low-pass filters", _filter),
    "i2c_address": Action("set the I2C address", _i2c_address),
    "bus": Action("set the second bus, next to the UART", _bus),
    "heading": Action("set the heading", _heading),
    "calibrate_gyro": Action(
        "measure the gyroscope's bias, the device at rest; answers it in °/s",
        lambda _target: session.calibrate_gyro(),
    ),
    "calibrate_installation": Action(
        "measure the mounting error and wait for its end; answers the angles in °",
        lambda _target: session.calibrate_installation(),
    ),
    "installation_status": Action(
        "state of the installation calibration, as sent", lambda _target: session.installation_status()
    ),
}
