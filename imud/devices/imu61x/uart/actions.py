"""Actions of an IMU61x on a UART: commands of sections 1.4 to 1.6 of the manual, each with what must follow it.

The annotations, here and in `settings.py`, are the only check and description of the arguments; `extra` has the unit
and the manual's section.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final

from msgspec import Meta

from imud.contracts.action import Action, Actions, Risk, Target
from imud.contracts.session import RequestScript
from imud.devices.imu61x.common.family import FILTER_CODES, FILTERS, filter_code, i2c_address
from imud.devices.imu61x.uart import calibrating, following, session
from imud.devices.imu61x.uart.commands import BusMode, require_fit
from imud.devices.imu61x.uart.replies import Parameter
from imud.devices.imu61x.uart.settings import AccelFilter, Address, Baud, GyroFilter, OutputRate, SecondBus, codes_of
from imud.errors import BadArgument
from imud.sample import Vector3

Heading = Annotated[
    float, Meta(ge=0, le=360, description="the new heading", extra={"unit": "°", "section": "1.6, table 12, CMD 4"})
]
Answer = Mapping[str, Any]
"""What an action answers, by name."""

_BUS_NOTE: Final = (
    "in force at once or at the next start, which the manual leaves open; a host on the bus that was selected before "
    "loses the device: there, a driver and link of the new bus belong in the configuration"
)
_ADDRESS_NOTE: Final = (
    "in force at once or at the next start, which the manual leaves open; a host that reads it at the old address "
    "loses it: there, `i2c.address` must be the new one, or `auto`"
)
_STOP_NOTE: Final = "no samples until `start_streaming`; saved now, it starts silent at every power-on"


def _done(target: Target) -> int:
    return codes_of(target).result_done


def _factory_reset(target: Target) -> RequestScript[following.BaudChange]:
    return following.with_advice(following.factory_reset(target.baud, done=_done(target)), target.fixed_baud)


def _baud(target: Target, *, baud: Baud) -> RequestScript[following.BaudChange]:
    script = following.change_baud(baud, target.baud, done=_done(target))
    return following.with_advice(script, target.fixed_baud)


def _rate(target: Target, *, rate_hz: OutputRate) -> RequestScript[None]:
    if target.baud:
        try:
            require_fit(rate_hz, target.baud)
        except BadArgument as error:
            raise BadArgument(f"rate_hz: {error}; set that first (`baud`)") from None
    return session.write_parameter(Parameter.AHRS_RATE, rate_hz)


def _filter(_target: Target, *, accel_filter: AccelFilter, gyro_filter: GyroFilter) -> RequestScript[Answer]:
    accel, gyro = filter_code(accel_filter), filter_code(gyro_filter)
    yield from session.write_filters(accel, gyro)
    return {"accel_filter": FILTERS[accel], "gyro_filter": FILTERS[gyro]}


def _i2c_address(_target: Target, *, address: Address) -> RequestScript[Answer]:
    number = i2c_address(address)
    yield from session.write_parameter(Parameter.I2C_ADDRESS, number)
    return {"i2c_address": f"{number:#04x}", "configuration": _ADDRESS_NOTE}


def _bus(_target: Target, *, bus: SecondBus) -> RequestScript[Answer]:
    yield from session.write_parameter(Parameter.BUS_MODE, BusMode[bus.upper()])
    return {"second_bus": bus, "configuration": _BUS_NOTE}


def _stop(target: Target) -> RequestScript[Answer]:
    yield from session.stop_streaming(done=_done(target))
    return {"output_mode": "command", "configuration": _STOP_NOTE}


def _heading(target: Target, *, heading_deg: Heading = 0.0) -> RequestScript[None]:
    return session.reset_heading(heading_deg, done=_done(target))


def _gyro(target: Target) -> RequestScript[Vector3]:
    return calibrating.calibrate_gyro(done=_done(target), rest=codes_of(target).calibration_done)


def _installation(target: Target) -> RequestScript[Vector3]:
    return calibrating.calibrate_installation(done=_done(target), rest=codes_of(target).calibration_done)


ACTIONS: Final[Actions] = {
    "status": Action(
        "ask for versions, model and state, by name; names that end in _raw have no documented unit",
        lambda _target: session.device_status(),
    ),
    "settings": Action(
        "read all settings from the device, units in their names", lambda _target: session.read_settings()
    ),
    "sample_once": Action(
        "ask for one sample, also in command mode; answers and publishes it", lambda _target: session.sample_once()
    ),
    "start_streaming": Action(
        "send samples; waits for the first", lambda target: session.start_streaming(done=_done(target))
    ),
    "stop_streaming": Action(
        "command mode: send nothing but replies, until `start_streaming`; cuts off all programs that read samples",
        _stop,
    ),
    "save": Action("write all parameters to flash", lambda target: session.save(done=_done(target)), saves=True),
    "restart": Action(
        "restart it, wait until it answers, and see that its timer began again; what was not saved is lost",
        lambda target: following.restart(done=_done(target)),
    ),
    "factory_reset": Action(
        "factory settings, read back, saved, and followed to their 115200 baud, which a fixed `uart.baud` must then be",
        _factory_reset,
        Risk.RESET,
        saves=True,
    ),
    "baud": Action(
        "set and save the baud rate and follow; a fixed `uart.baud` in the configuration must then be the new one",
        _baud,
        Risk.CONNECTION,
        saves=True,
    ),
    "rate": Action("set the output rate, as far as the baud rate carries it", _rate),
    "filter": Action(f"set the low-pass filters, by name or code: {FILTER_CODES}", _filter),
    "i2c_address": Action(
        "set the I2C address; a host that reads the device at the old one loses it until `i2c.address` there is the "
        "new one",
        _i2c_address,
    ),
    "bus": Action(
        "set the second bus, next to the UART; a host on the other bus loses the device, and needs the other link and "
        "driver",
        _bus,
    ),
    "heading": Action("set the heading", _heading),
    "calibrate_gyro": Action(
        "measure the gyroscope's bias, the device at rest, and wait for the end; answers it in °/s", _gyro
    ),
    "calibrate_installation": Action(
        "measure the mounting error and wait for its end; answers the angles in °", _installation
    ),
    "installation_status": Action(
        "state of the installation calibration, as sent", lambda _target: calibrating.installation_status()
    ),
}
