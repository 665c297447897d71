"""Request scripts of the Forsense IMU61x on a UART: identity, status, settings, output mode, saving, heading.

Manual "IMU61X Interface Protocol and Instructions", sections 1.4 to 1.6. How the device is reached and its answers are
judged is in `contact.py`, what can lose it in `following.py`, calibrations in `calibrating.py`.

Command mode is never saved by imud's own scripts: a device that loses its host in the middle streams again after its
next power-on. For a device that was saved in command mode there is `wake`.
"""

from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any, Final

from imud.contracts.driver import Identity
from imud.contracts.session import Reply, Request, RequestScript, pause
from imud.devices.imu61x.common.family import FILTERS, filter_codes
from imud.devices.imu61x.uart import commands
from imud.devices.imu61x.uart.commands import BusMode, OutputMode
from imud.devices.imu61x.uart.contact import (
    CONTACT_TRIES,
    acknowledged,
    answered,
    in_contact,
    ordered,
    read,
    result_of,
    resume_streaming,
    sample,
    settled,
)
from imud.devices.imu61x.uart.replies import RESULT_DONE, Parameter, Status
from imud.errors import BadArgument, NoReply, Rejected
from imud.sample import Measurement
from imud.units import NS_PER_MS, NS_PER_S

SAMPLE_NS: Final = 3 * NS_PER_S
"""Wait for the first sample after the order to stream: three times the longest period, 1 s."""
QUIET_NS: Final = 1200 * NS_PER_MS
"""Without a sample for longer than the longest period, the stream has stopped."""
DRAIN_NS: Final = 200 * NS_PER_MS
"""Time for samples that were on their way when the stream stopped: 512 bytes at 115200 baud, and an adapter."""

GYRO_OFFSETS: Final = (Parameter.GYRO_X_OFF, Parameter.GYRO_Y_OFF, Parameter.GYRO_Z_OFF)
INSTALLATION_ANGLES: Final = (Parameter.INSTALL_X_OFF, Parameter.INSTALL_Y_OFF, Parameter.INSTALL_Z_OFF)

ParameterValues = Mapping[Parameter, float]
"""Parameters as read; one that the device does not answer for is left out."""

# --- identity and status ----------------------------------------------------------------------------------------------


def identify() -> RequestScript[Identity]:
    """Ask for versions, model and serial number (CMD 1). Raises NoReply.

    A device that answers only in command mode misses the samples of the exchange, some 20 ms.
    """

    def ask() -> RequestScript[Identity]:
        return identity_of((yield from settled(CONTACT_TRIES)))

    return in_contact(ask)


def identity_of(status: Status) -> Identity:
    """Make the identity from S1. The numbers of the models are not documented."""
    details = {"hardware_version": str(status.hardware_version), "model_number": str(status.model)}
    return Identity("IMU61x", _serial_number(status), str(status.software_version), details)


def _serial_number(status: Status) -> str:
    return "".join(f"{word:08X}" for word in status.serial_number)


def device_status() -> RequestScript[Mapping[str, Any]]:
    """Ask for S1 (CMD 1); return its members by name, see `status_words`. Raises NoReply."""

    def ask() -> RequestScript[Mapping[str, Any]]:
        return status_words((yield from settled(CONTACT_TRIES)))

    return in_contact(ask)


def status_words(status: Status) -> Mapping[str, Any]:
    """Name the members of S1 that were sent. Names that end in `_raw` have a number without a documented unit.

    Bits are in hexadecimal: of the system's status, and of `imu_health`, 32 bytes.
    """
    words = {
        "serial_number": _serial_number(status),
        "software_version": status.software_version,
        "hardware_version": status.hardware_version,
        "model_number": status.model,
        "system_status_bits": None if status.system_status is None else f"{status.system_status:#010x}",
        "cpu_load_raw": status.cpu_load,
        "drop_rate_raw": status.drop_rate,
        "i2c_master_raw": status.i2c_master,
        "voltage_raw": status.voltage,
        "user_config_status_raw": status.user_config_status,
        "calibration_status_raw": status.calibration_status,
        "imu_health_bits": None if status.imu_health is None else status.imu_health.hex(),
    }
    return {name: value for name, value in words.items() if value is not None}


def sample_once() -> RequestScript[Mapping[str, Any]]:
    """Ask for one sample (CMD 2), or have the next one while it streams; return it in SI units. Raises NoReply."""

    def ask() -> RequestScript[Mapping[str, Any]]:
        return sample_words((yield from sample()))

    return in_contact(ask)


def sample_words(measurement: Measurement) -> Mapping[str, Any]:
    """Name the values of an AHRS frame; those that were not finite are left out."""
    words = {
        "timer_us": measurement.dev_ticks,
        "accel_m_s2": measurement.accel_m_s2,
        "gyro_rad_s": measurement.gyro_rad_s,
        "euler_rad": measurement.euler_rad,
        "temperature_c": measurement.temperature_c,
    }
    return {name: value for name, value in words.items() if value is not None}


# --- settings ---------------------------------------------------------------------------------------------------------


def read_settings() -> RequestScript[Mapping[str, str]]:
    """Read all parameters of table 9 (CMD 6), by the names of imud's settings, for people. Raises NoReply.

    A parameter that the device does not answer for is left out: not every model has every one (assumed).
    """

    def ask() -> RequestScript[Mapping[str, str]]:
        return parameter_words((yield from read_parameters()))

    return in_contact(ask)


def read_parameters() -> RequestScript[ParameterValues]:
    """Read all parameters of table 9, in contact. Raises NoReply where it does not even answer for the baud rate."""
    values = {Parameter.BAUD: (yield from read(Parameter.BAUD))}
    for parameter in Parameter:
        if parameter is Parameter.BAUD:
            continue
        try:
            values[parameter] = yield from read(parameter, 1)
        except NoReply:
            continue
    return values


def parameter_words(values: ParameterValues) -> Mapping[str, str]:
    """Name parameters as imud's settings do, units in the names; a value that is none of the manual's as a number."""
    words: dict[str, str] = {}
    for name, parameter in (("baud", Parameter.BAUD), ("output_rate_hz", Parameter.AHRS_RATE)):
        if parameter in values:
            words[name] = _number(values[parameter])
    control = values.get(Parameter.FILTER)
    if control is not None and control in range(0x100):
        accel, gyro = filter_codes(int(control))
        words |= {"accel_filter": FILTERS[accel], "gyro_filter": FILTERS[gyro]}
    elif control is not None:
        words["filter"] = _number(control)
    mode, address = values.get(Parameter.BUS_MODE), values.get(Parameter.I2C_ADDRESS)
    if mode is not None:
        words["second_bus"] = BUS_NAMES.get(mode, _number(mode))
    if address is not None:
        words["i2c_address"] = f"{int(address):#04x}" if address in range(0x80) else _number(address)
    for name, three in (("gyro_offset_deg_s", GYRO_OFFSETS), ("installation_angles_deg", INSTALLATION_ANGLES)):
        if all(parameter in values for parameter in three):
            words[name] = ", ".join(_number(values[parameter]) for parameter in three)
    return words


BUS_NAMES: Final[Mapping[float, str]] = {mode.value: mode.name.lower() for mode in BusMode}
"""Values of parameter 27 by number: `uart_only`, `spi`, `i2c`, `by_pin`."""


def _number(value: float) -> str:
    return str(int(value)) if isfinite(value) and value == int(value) else f"{value:.7g}"


# --- modes and saving -------------------------------------------------------------------------------------------------


def start_streaming(*, done: int = RESULT_DONE) -> RequestScript[None]:
    """Start streaming of AHRS frames (CMD 3, mode 1), and wait for one. Raises Rejected, and NoReply for no sample."""
    for _ in range(CONTACT_TRIES):
        if (yield from ordered(commands.output_mode(OutputMode.STREAM), done)):
            break
    if not isinstance((yield commands.await_sample(SAMPLE_NS)), Reply):
        raise NoReply(
            f"output mode STREAM: expected a sample within {SAMPLE_NS / NS_PER_S:.0f} s, got none; "
            "is the host's transmit line connected?"
        )


def wake() -> RequestScript[bool]:
    """Start streaming if the device answers; return whether it acknowledged, with any result. Raises NoReply.

    Not saved. Whether it streams then, is seen by its samples.
    """
    yield from answered(commands.ask_status())
    return (yield from resume_streaming())


def stop_streaming(*, done: int = RESULT_DONE) -> RequestScript[None]:
    """Enter command mode (CMD 3, mode 100), in which the device only replies, and see that samples end.

    Raises NoReply for no answer, and Rejected where it refuses or streams on.
    """
    yield from ordered(commands.output_mode(OutputMode.COMMAND), done)
    yield from settled()
    yield pause(DRAIN_NS)
    if isinstance((yield commands.await_sample(QUIET_NS)), Reply):
        raise Rejected("output mode COMMAND: expected no more samples, got one")


def save(*, done: int = RESULT_DONE) -> RequestScript[None]:
    """Write all parameters to flash (CMD 5). Raises Rejected, and NoReply without an acknowledgement.

    The output mode is one of them, so a device that obeys while it streams is not taken out of that: what is saved in
    command mode starts silent. One that obeys in command mode only cannot keep that mode (assumed: it could never be
    saved as streaming).
    """

    def ask() -> RequestScript[None]:
        yield from acknowledged(commands.save(), done)
        yield from settled()

    return in_contact(ask, CONTACT_TRIES)


# --- parameters and heading -------------------------------------------------------------------------------------------

_SETTERS: Final[Mapping[Parameter, Callable[[int], Request]]] = {
    Parameter.AHRS_RATE: commands.set_rate,
    Parameter.I2C_ADDRESS: commands.set_i2c_address,
    Parameter.FILTER: lambda value: commands.set_filter(*filter_codes(value)),
}


def write_parameter(parameter: Parameter, value: int | BusMode) -> RequestScript[None]:
    """Set a parameter and read it back; not saved. Raises BadArgument, NoReply, and Rejected if it reads otherwise.

    The baud rate is not set this way, see `following.change_baud`; offsets and angles come from calibrations.
    """
    if isinstance(value, BusMode) and parameter is Parameter.BUS_MODE:
        request = commands.set_bus_mode(value)
    elif parameter in _SETTERS and not isinstance(value, BusMode):
        request = _SETTERS[parameter](value)
    else:
        settable = ", ".join(name.name for name in (*_SETTERS, Parameter.BUS_MODE))
        raise BadArgument(f"parameter {parameter.name} = {value}: expected one of {settable}, with a value of its kind")
    wanted = value.value if isinstance(value, BusMode) else value
    return in_contact(lambda: _write(request, parameter, wanted))


def _write(request: Request, parameter: Parameter, wanted: int) -> RequestScript[None]:
    result = result_of((yield request))
    found = yield from read(parameter)
    if found != wanted:
        word = "" if result is None else f", acknowledged with result {result}"
        raise Rejected(f"{request.name}: reads back as {found:g}{word}")


def write_filters(accel: int | None, gyro: int | None) -> RequestScript[None]:
    """Set the codes of the low-pass filters, None to leave one as it is, and read back. Raises as `write_parameter`."""

    def ask() -> RequestScript[None]:
        present = yield from read(Parameter.FILTER)
        if present not in range(0x100):
            raise Rejected(f"parameter FILTER: expected 0 to 255, read {present:g}")
        present_accel, present_gyro = filter_codes(int(present))
        codes = (present_accel if accel is None else accel, present_gyro if gyro is None else gyro)
        request = commands.set_filter(*codes)
        yield from _write(request, Parameter.FILTER, codes[0] << 4 | codes[1])

    return in_contact(ask)


def reset_heading(heading_deg: float, *, done: int = RESULT_DONE) -> RequestScript[None]:
    """Make the heading 0° … 360° (CMD 4). Raises NoReply, Rejected."""

    def ask() -> RequestScript[None]:
        yield from acknowledged(commands.reset_heading(heading_deg), done)
        yield from settled()

    return in_contact(ask)
