"""Settings that an IMU61x on a UART keeps: parameters of tables 9 and 12, and the output mode. Manual, 1.5 and 1.6.

Values are numbers with the unit in the name of the setting, or names in place of the device's codes. Whether parameters
27 and 30 come into force at once or at the next start is not documented.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.contracts.action import Target
from imud.contracts.device_settings import DeviceSettings, Setting
from imud.contracts.session import Reply, RequestScript
from imud.devices.imu61x.common.family import (
    ACCEL_FILTER,
    FILTERS,
    GYRO_FILTER,
    FilterChoice,
    I2cAddressChoice,
    filter_code,
    filter_codes,
    i2c_address,
    same_address,
    same_filter,
)
from imud.devices.imu61x.uart import commands, following, session
from imud.devices.imu61x.uart.commands import BaudRate, BusMode, RateHz
from imud.devices.imu61x.uart.contact import Imu61xUartSettings, in_contact
from imud.devices.imu61x.uart.replies import Parameter
from imud.devices.imu61x.uart.session import BUS_NAMES, GYRO_OFFSETS, INSTALLATION_ANGLES, QUIET_NS
from imud.errors import BadArgument

Baud = Annotated[
    BaudRate, Meta(description="rate of the UART", extra={"unit": "bit/s", "section": "1.6, table 12, parameter 3"})
]
OutputRate = Annotated[
    RateHz, Meta(description="AHRS frames per second", extra={"unit": "Hz", "section": "1.6, table 12, parameter 21"})
]
OutputModeName = Annotated[
    Literal["stream", "command"],
    Meta(
        description="`stream`: sends AHRS frames; `command`: sends nothing but replies",
        extra={"section": "1.6, table 12, CMD 3"},
    ),
]
Address = Annotated[
    I2cAddressChoice,
    Meta(description="7-bit I2C address, 0x18 to 0x1b", extra={"section": "1.6, table 12, parameter 30"}),
]
SecondBus = Annotated[
    Literal["uart_only", "spi", "i2c", "by_pin"],
    Meta(
        description="the bus next to the UART; `by_pin`: a pin that is open or low selects SPI, high selects I2C",
        extra={"section": "1.6, table 12, parameter 27"},
    ),
]
AccelFilter = Annotated[FilterChoice, ACCEL_FILTER]
GyroFilter = Annotated[FilterChoice, GYRO_FILTER]
_Three = Annotated[list[float], Meta(min_length=3, max_length=3)]
GyroOffset = Annotated[
    _Three,
    Meta(
        description="zero bias about X, Y, Z, as the static calibration found it",
        extra={"unit": "°/s", "section": "1.5, table 9, parameters 8 to 10"},
    ),
]
InstallationAngles = Annotated[
    _Three,
    Meta(
        description="mounting error about X, Y, Z, as the installation calibration found it",
        extra={"unit": "°", "section": "1.5, table 9, parameters 16 to 18"},
    ),
]


def codes_of(target: Target) -> Imu61xUartSettings:
    """The codes that the configuration gives, or the assumed ones."""
    return target.settings if isinstance(target.settings, Imu61xUartSettings) else Imu61xUartSettings()


# --- scripts ----------------------------------------------------------------------------------------------------------


def _read(_target: Target) -> RequestScript[Mapping[str, Any]]:
    streams = isinstance((yield commands.await_sample(QUIET_NS)), Reply)
    values = yield from in_contact(session.read_parameters)
    return {**settings_of(values), "output_mode": "stream" if streams else "command"}


def settings_of(values: session.ParameterValues) -> Mapping[str, Any]:
    """The settings in parameters as read; a value for which there are no words in the manual is left out."""
    whole = {parameter: int(value) for parameter, value in values.items() if value in range(2_000_000)}
    found: dict[str, Any] = {}
    for name, parameter in (("baud", Parameter.BAUD), ("output_rate_hz", Parameter.AHRS_RATE)):
        if parameter in whole:
            found[name] = whole[parameter]
    if (control := whole.get(Parameter.FILTER, -1)) in range(0x100):
        accel, gyro = filter_codes(control)
        found |= {"accel_filter": FILTERS[accel], "gyro_filter": FILTERS[gyro]}
    if (mode := whole.get(Parameter.BUS_MODE, -1)) in BUS_NAMES:
        found["second_bus"] = BUS_NAMES[mode]
    if (address := whole.get(Parameter.I2C_ADDRESS, -1)) in range(0x80):
        found["i2c_address"] = f"{address:#04x}"
    for name, three in (("gyro_offset_deg_s", GYRO_OFFSETS), ("installation_angles_deg", INSTALLATION_ANGLES)):
        if all(parameter in values for parameter in three):
            found[name] = [values[parameter] for parameter in three]
    return found


def _write_baud(target: Target, baud: BaudRate) -> RequestScript[following.BaudChange]:
    return following.change_baud(baud, target.baud, done=codes_of(target).result_done, save=False)


def _write_mode(target: Target, mode: str) -> RequestScript[None]:
    done = codes_of(target).result_done
    return session.start_streaming(done=done) if mode == "stream" else session.stop_streaming(done=done)


def _check(target: Target, values: Mapping[str, Any]) -> None:
    rate_hz, baud = values.get("output_rate_hz"), values.get("baud") or target.baud
    if rate_hz and baud:
        try:
            commands.require_fit(rate_hz, baud)
        except BadArgument as error:
            raise BadArgument(f"output_rate_hz and baud: {error}") from None


SETTINGS: Final = DeviceSettings(
    table={
        "output_rate_hz": Setting(
            type=OutputRate, write=lambda _target, hz: session.write_parameter(Parameter.AHRS_RATE, hz)
        ),
        "accel_filter": Setting(
            type=AccelFilter,
            write=lambda _target, choice: session.write_filters(filter_code(choice), None),
            agrees=same_filter,
        ),
        "gyro_filter": Setting(
            type=GyroFilter,
            write=lambda _target, choice: session.write_filters(None, filter_code(choice)),
            agrees=same_filter,
        ),
        "second_bus": Setting(
            type=SecondBus,
            write=lambda _target, bus: session.write_parameter(Parameter.BUS_MODE, BusMode[bus.upper()]),
        ),
        "i2c_address": Setting(
            type=Address,
            write=lambda _target, address: session.write_parameter(Parameter.I2C_ADDRESS, i2c_address(address)),
            agrees=same_address,
        ),
        "gyro_offset_deg_s": Setting(type=GyroOffset),
        "installation_angles_deg": Setting(type=InstallationAngles),
        "output_mode": Setting(type=OutputModeName, write=_write_mode),
        "baud": Setting(type=Baud, write=_write_baud, connection=True),
    },
    read=_read,
    save=lambda target: session.save(done=codes_of(target).result_done),
    restart=lambda target: following.restart(done=codes_of(target).result_done),
    check=_check,
)
"""What the device keeps; `output_rate_hz` and `baud` must go together.

Filters are two halves of one parameter, each written by itself. A baud rate is saved by its own script only where the
device changes at its next start.
"""
