"""What an IMU61x on a UART can be told by name: sections 1.4 to 1.6 of the manual, each with what must follow it."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions, Target
from imud.contracts.session import RequestScript
from imud.contracts.settings import Settings
from imud.devices.imu61x.common.family import FILTERS, filter_control
from imud.devices.imu61x.uart import session
from imud.devices.imu61x.uart.commands import BusMode
from imud.devices.imu61x.uart.replies import Parameter

FilterCode = Annotated[int, Meta(ge=0, le=len(FILTERS) - 1)]


class BaudParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A rate."""

    baud: int


class RateParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An output rate."""

    rate_hz: int


class HeadingParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A heading."""

    heading_deg: float = 0.0


class FilterParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Codes of table 21."""

    accel_filter: FilterCode
    gyro_filter: FilterCode


class AddressParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A 7-bit I2C address."""

    address: int


class BusParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The bus besides the UART."""

    bus: Literal["uart_only", "spi", "i2c", "by_pin"]


def _filter(_target: Target, params: FilterParams) -> RequestScript[None]:
    return session.write_parameter(Parameter.FILTER, filter_control(params.accel_filter, params.gyro_filter))


ACTIONS: Final[Actions] = {
    "start_streaming": Action("send samples", lambda _t, _p: session.start_streaming()),
    "stop_streaming": Action("command mode: send nothing but replies", lambda _t, _p: session.stop_streaming()),
    "save": Action("write all parameters to flash; says whether it acknowledged", lambda _t, _p: session.save()),
    "restart": Action(
        "restart it and wait until it answers; what was not saved is lost", lambda _t, _p: session.restart()
    ),
    "factory_reset": Action(
        "factory settings, and follow it to their baud rate", lambda t, _p: session.factory_reset(t.baud)
    ),
    "baud": Action(
        "set and save the baud rate and follow", lambda t, p: session.change_baud(p.baud, t.baud), BaudParams
    ),
    "rate": Action(
        "set the output rate", lambda _t, p: session.write_parameter(Parameter.AHRS_RATE, p.rate_hz), RateParams
    ),
    "filter": Action("set the low-pass filters", _filter, FilterParams),
    "i2c_address": Action(
        "set the I2C address", lambda _t, p: session.write_parameter(Parameter.I2C_ADDRESS, p.address), AddressParams
    ),
    "bus": Action(
        "set the bus besides the UART",
        lambda _t, p: session.write_parameter(Parameter.BUS_MODE, BusMode[p.bus.upper()]),
        BusParams,
    ),
    "heading": Action("set the heading", lambda _t, p: session.reset_heading(p.heading_deg), HeadingParams),
    "calibrate_gyro": Action(
        "measure the gyroscope's bias, the device at rest; answers it in °/s", lambda _t, _p: session.calibrate_gyro()
    ),
    "calibrate_installation": Action(
        "measure the mounting error and wait for its end; answers the angles in °",
        lambda _t, _p: session.calibrate_installation(),
    ),
    "installation_status": Action(
        "how the installation calibration stands, as sent", lambda _t, _p: session.installation_status()
    ),
}
