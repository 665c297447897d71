"""Settings of an IMU61x on a UART: parameters of tables 9 and 12, and the output mode. Manual, 1.5 and 1.6.

Values are numbers with the unit in the name of the setting, or names in place of the device's codes. The manual does
not state whether parameters 27 and 30 take effect immediately or after the next start.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isfinite
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.contracts.command import Target
from imud.contracts.driver import Identity
from imud.contracts.script import Reply, Request, RequestScript, pause, with_undo
from imud.contracts.setting import DeviceReport, Reports, Setting, SettingsTable
from imud.drivers.imu61x.common import (
    ACCEL_FILTER,
    FILTER_DEFAULT,
    FILTERS,
    GYRO_FILTER,
    I2C_ADDRESSES,
    FilterChoice,
    I2cAddressChoice,
    filter_code,
    filter_codes,
    i2c_address,
    same_address,
    same_filter,
)
from imud.drivers.imu61x.uart import commands
from imud.drivers.imu61x.uart.codec import RESULT_DONE, Parameter, Status
from imud.drivers.imu61x.uart.commands import (
    BAUD_RATES,
    CONTACT_TRIES,
    STREAM,
    BaudRate,
    BusMode,
    Imu61xUartOptions,
    OutputMode,
    RateHz,
    acknowledged,
    answered,
    in_command_mode,
    ordered,
    read,
    result_of,
    resume_streaming,
    sample,
    settled,
)
from imud.model.errors import BadArgument, NoReply, NotApplied, Rejected
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

# Maximum time to the first sample after the command to stream, ns: three times the longest period, 1 s
SAMPLE_NS: Final = 3 * NS_PER_S
# Time without a sample after which the stream has stopped, ns: more than the longest period
QUIET_NS: Final = 1200 * NS_PER_MS
# Time for samples in buffers when the stream stops, ns: 512 bytes at 115200 baud, and an adapter
DRAIN_NS: Final = 200 * NS_PER_MS
PARAMETER_ROUNDS: Final = 2  # maximum number of requests for a parameter: one reply can be lost, or late

GYRO_OFFSETS: Final = (Parameter.GYRO_X_OFF, Parameter.GYRO_Y_OFF, Parameter.GYRO_Z_OFF)
INSTALLATION_ANGLES: Final = (Parameter.INSTALL_X_OFF, Parameter.INSTALL_Y_OFF, Parameter.INSTALL_Z_OFF)

ParameterValues = Mapping[Parameter, float]  # parameters as read, without parameters that the device does not report

# --- identity and status ----------------------------------------------------------------------------------------------


def identify() -> RequestScript[Identity]:
    """Read versions, model and serial number (CMD 1). Raises NoReply.

    If the device replies only in command mode, the samples of about 20 ms are lost.
    """

    def ask() -> RequestScript[Identity]:
        return identity_of((yield from settled(CONTACT_TRIES)))

    return in_command_mode(ask)


def identity_of(status: Status) -> Identity:
    """Return the identity in S1. The manual does not document the model numbers."""
    details = {"hardware_version": str(status.hardware_version), "model_number": str(status.model)}
    return Identity("IMU61x", _serial_number(status), str(status.software_version), details)


def _serial_number(status: Status) -> str:
    return "".join(f"{word:08X}" for word in status.serial_number)


def device_status() -> RequestScript[Mapping[str, Any]]:
    """Read S1 (CMD 1). Return its members by name, see `status_words`. Raises NoReply."""

    def ask() -> RequestScript[Mapping[str, Any]]:
        return status_words((yield from settled(CONTACT_TRIES)))

    return in_command_mode(ask)


def status_words(status: Status) -> Mapping[str, Any]:
    """Return the present members of S1 by name. Names that end in `_raw` have no documented unit.

    The bits of the system status and of `imu_health`, 32 bytes, are hexadecimal.
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
        "user_config_fault_raw": status.user_config_fault,
        "calibration_fault_raw": status.calibration_fault,
        "imu_health_bits": None if status.imu_health is None else status.imu_health.hex(),
    }
    return {name: value for name, value in words.items() if value is not None}


def sample_once() -> RequestScript[Mapping[str, Any]]:
    """Read one sample (CMD 2), or the next sample of the stream. Return it in SI units. Raises NoReply."""

    def ask() -> RequestScript[Mapping[str, Any]]:
        return sample_words((yield from sample()))

    return in_command_mode(ask)


def sample_words(measurement: Measurement) -> Mapping[str, Any]:
    """Return the finite values of an AHRS frame by name."""
    words = {
        "timer_us": measurement.dev_ticks,
        "accel_m_s2": measurement.accel_m_s2,
        "gyro_rad_s": measurement.gyro_rad_s,
        "euler_rad": measurement.euler_rad,
        "temperature_c": measurement.temperature_c,
    }
    return {name: value for name, value in words.items() if value is not None}


# --- settings ---------------------------------------------------------------------------------------------------------


def read_parameters(wanted: Sequence[Parameter]) -> RequestScript[ParameterValues]:
    """Read parameters of table 9. Raises NoReply if the device does not reply for the first parameter either.

    The result does not contain other parameters without a reply: some models lack some parameters (assumed).
    """
    first, *others = wanted
    values = {first: (yield from read(first))}
    for _ in range(PARAMETER_ROUNDS):
        for parameter in others:
            if parameter not in values:
                with suppress(NoReply):
                    values[parameter] = yield from read(parameter, 1)
    return values


def parameter_words(values: ParameterValues) -> Mapping[str, str]:
    """Return parameters as text by the names of imud's settings. Undocumented values are numbers."""
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


# Values of parameter 27 by number: `uart_only`, `spi`, `i2c`, `by_pin`
BUS_NAMES: Final[Mapping[float, str]] = {mode.value: mode.name.lower() for mode in BusMode}


def _number(value: float) -> str:
    return str(int(value)) if isfinite(value) and value == int(value) else f"{value:.7g}"


# --- modes and saving -------------------------------------------------------------------------------------------------


def start_streaming(*, done: int = RESULT_DONE) -> RequestScript[None]:
    """Start streaming of AHRS frames (CMD 3, mode 1). Raises Rejected; NoReply without a sample."""
    for _ in range(CONTACT_TRIES):
        if (yield from ordered(commands.output_mode(OutputMode.STREAM), done)):
            break
    if not isinstance((yield commands.await_sample(SAMPLE_NS)), Reply):
        raise NoReply(
            f"output mode STREAM: expected a sample within {SAMPLE_NS / NS_PER_S:.0f} s, got none; "
            "check the transmit wire of the host"
        )


def wake() -> RequestScript[bool]:
    """Start streaming, unsaved. Return whether the device acknowledged with any result. Raises NoReply."""
    yield from answered(commands.ask_status())
    return (yield from resume_streaming())


def stop_streaming(*, done: int = RESULT_DONE) -> RequestScript[None]:
    """Enter command mode (CMD 3, mode 100), in which the device only replies, and check that samples end.

    Raises NoReply without a reply, and Rejected if the device rejects the command or continues to stream.
    """
    yield from ordered(commands.output_mode(OutputMode.COMMAND), done)
    yield from settled()
    yield pause(DRAIN_NS)
    if isinstance((yield commands.await_sample(QUIET_NS)), Reply):
        raise Rejected("output mode COMMAND: expected no more samples, got one")


def save(*, done: int = RESULT_DONE) -> RequestScript[None]:
    """Write all parameters to flash (CMD 5). Raises Rejected; NoReply without an acknowledgement."""

    def ask() -> RequestScript[None]:
        yield from acknowledged(commands.save(), done)
        yield from settled()

    # The output mode is a parameter too. A device that accepts commands while it streams therefore stays in this mode:
    # saved in command mode, it would be silent after power-on. A device that accepts commands only in command mode
    # cannot keep that mode (assumed: otherwise it could never save streaming).
    return in_command_mode(ask, CONTACT_TRIES)


# --- parameters and heading -------------------------------------------------------------------------------------------

_SETTERS: Final[Mapping[Parameter, Callable[[int], Request]]] = {
    Parameter.AHRS_RATE: commands.set_rate,
    Parameter.I2C_ADDRESS: commands.set_i2c_address,
    Parameter.FILTER: lambda value: commands.set_filter(*filter_codes(value)),
}


def write_parameter(parameter: Parameter, value: int | BusMode) -> RequestScript[None]:
    """Set a parameter and read it back; not saved. Raises BadArgument, NoReply, and Rejected if the value differs.

    `change_baud` sets the baud rate; calibrations set offsets and angles.
    """
    if isinstance(value, BusMode) and parameter is Parameter.BUS_MODE:
        request = commands.set_bus_mode(value)
    elif parameter in _SETTERS and not isinstance(value, BusMode):
        request = _SETTERS[parameter](value)
    else:
        settable = ", ".join(name.name for name in (*_SETTERS, Parameter.BUS_MODE))
        raise BadArgument(f"parameter {parameter.name} = {value}: expected one of {settable} with a value of its type")
    wanted = value.value if isinstance(value, BusMode) else value
    return in_command_mode(lambda: _write(request, parameter, wanted))


def _write(request: Request, parameter: Parameter, wanted: int) -> RequestScript[None]:
    result = result_of((yield request))
    found = yield from read(parameter)
    if found != wanted:
        word = "" if result is None else f", acknowledged with result {result}"
        raise NotApplied(f"{request.name}: expected {wanted} after the write, got {found:g}{word}")


def write_filters(accel: int | None, gyro: int | None) -> RequestScript[None]:
    """Set the codes of the low-pass filters, None: unchanged, and read them back. Raises the errors of
    `write_parameter`.
    """

    def ask() -> RequestScript[None]:
        present = yield from read(Parameter.FILTER)
        if present not in range(0x100):
            raise Rejected(f"parameter FILTER: expected 0 to 255, got {present:g}")
        present_accel, present_gyro = filter_codes(int(present))
        codes = (present_accel if accel is None else accel, present_gyro if gyro is None else gyro)
        request = commands.set_filter(*codes)
        yield from _write(request, Parameter.FILTER, codes[0] << 4 | codes[1])

    return in_command_mode(ask)


def reset_heading(heading_deg: float, *, done: int = RESULT_DONE) -> RequestScript[None]:
    """Set the heading, 0° … 360° (CMD 4). Raises NoReply, Rejected."""

    def ask() -> RequestScript[None]:
        yield from acknowledged(commands.reset_heading(heading_deg), done)
        yield from settled()

    return in_command_mode(ask)


# Number of tries per baud rate. Bytes at another baud rate, or a busy device, can cost two of them.
LOOK_TRIES: Final = 3
BOOT_NS: Final = NS_PER_S
BOOT_TRIES: Final = 5  # number of searches after a restart; with their timeouts longer than the 3 s in section 2.2
US_PER_S: Final = NS_PER_S // NS_PER_US
TIMER_US: Final = 2**32
# Minimum age of the timer before a restart, µs: longer than the search after it, so that a restarted timer is smaller
OLD_US: Final = 15 * US_PER_S

# Factory settings of tables 1, 9 and 12
FACTORY: Final[Mapping[Parameter, int]] = {
    Parameter.BAUD: BAUD_RATES[0],
    Parameter.AHRS_RATE: 100,
    Parameter.BUS_MODE: BusMode.SPI.value,
    Parameter.I2C_ADDRESS: I2C_ADDRESSES[0],
    Parameter.FILTER: FILTER_DEFAULT,
}
FACTORY_BAUD: Final = FACTORY[Parameter.BAUD]


@dataclass(frozen=True, slots=True)
class BaudChange:
    """Result of a successful change of the baud rate."""

    baud: int  # baud rate of the last reply; the serial port uses it too
    saved: bool  # whether the device acknowledged the save of its parameters
    configuration: str = ""  # necessary change of the configuration; empty if none is necessary


def with_advice(script: RequestScript[BaudChange], fixed_baud: int) -> RequestScript[BaudChange]:
    """Return the same script; its result contains the change for a configuration with another baud rate (0: none
    fixed).
    """
    change = yield from script
    if fixed_baud in (0, change.baud):
        return change
    words = f"change `uart.baud` from {fixed_baud} to {change.baud} or auto: imud uses it at its next start"
    return replace(change, configuration=words)


# --- restart ----------------------------------------------------------------------------------------------------------


def restart(*, done: int = RESULT_DONE) -> RequestScript[Identity]:
    """Restart the device (CMD 9) and wait until it replies. Unsaved parameters are lost.

    Raises NoReply if the device does not reply or sends no AHRS frame, and Rejected if its timer did not restart.
    """
    before_us = yield from _old_timer()
    result = yield from in_command_mode(_restart)
    yield pause(BOOT_NS)
    identity, after_us = yield from _back()
    if after_us >= before_us:
        word = "no acknowledgement" if result is None else f"acknowledgement {result}"
        raise Rejected(
            f"restart: expected a restarted timer, got {before_us / US_PER_S:.1f} s before and "
            f"{after_us / US_PER_S:.1f} s after it, and {word} ({done} is done)"
        )
    return identity


def _old_timer() -> RequestScript[int]:
    """Return the timer, µs, once it is older than a restarted timer can be and does not wrap soon."""
    while True:
        timer_us = (yield from in_command_mode(sample)).dev_ticks
        assert timer_us is not None  # every AHRS frame contains it
        if timer_us < OLD_US:
            yield pause((OLD_US - timer_us) * NS_PER_US)
        elif timer_us > TIMER_US - 2 * OLD_US:
            yield pause((TIMER_US - timer_us) * NS_PER_US)
        else:
            return timer_us


def _restart() -> RequestScript[int | None]:
    return result_of((yield commands.restart()))


def _back() -> RequestScript[tuple[Identity, int]]:
    def ask() -> RequestScript[tuple[Identity, int]]:
        status = yield from settled(CONTACT_TRIES)
        return identity_of(status), (yield from sample()).dev_ticks or 0

    for _ in range(BOOT_TRIES - 1):
        try:
            return (yield from in_command_mode(ask))
        except NoReply:
            continue
    return (yield from in_command_mode(ask))


# --- baud rate --------------------------------------------------------------------------------------------------------


def change_baud(baud: int, present_baud: int, *, done: int = RESULT_DONE) -> RequestScript[BaudChange]:
    """Set the baud rate of device and serial port from `present_baud` to `baud`. The device streams afterwards.

    The script saves only if the device changes at its next start. Raises BadArgument for a baud rate that is too low
    for the output rate, Rejected if the device keeps the old baud rate (the serial port then too), and NoReply if it
    does not reply; if nothing was saved, power-off restores the old baud rate.
    """
    return with_undo(_change_baud(baud, present_baud, done), STREAM)


def _change_baud(baud: int, present_baud: int, done: int) -> RequestScript[BaudChange]:
    request = commands.set_baud(baud)
    if (yield from _look((present_baud,))) is None:
        yield from resume_streaming()
        raise NoReply(_unheard(f"{request.name}: nothing was changed", (present_baud,)))
    try:
        commands.require_fit((yield from read(Parameter.AHRS_RATE)), baud)
    except NoReply:
        yield from resume_streaming()
        raise
    except BadArgument as error:
        yield from resume_streaming()
        raise BadArgument(f"baud: {error}; lower the output rate first") from None
    yield request
    saved = False
    # The manual does not state whether the change is immediate or at the next start: look at both baud rates. Save only
    # after a reply at the new baud rate, or if the device reports it at the old one.
    found = yield from _look((baud, present_baud))
    if found == (present_baud, baud) != (baud, baud):  # set, but effective only after the next start
        yield from resume_streaming()
        saved = yield from _save(done)
        yield from in_command_mode(_restart)
        yield pause(BOOT_NS)
        found = yield from _look((baud, present_baud), BOOT_TRIES)
    if found is None:
        yield from resume_streaming()  # at the present baud rate, at which the search ended
        kept = "it may have been saved" if saved else "nothing was saved: switch the device off and on"
        raise NoReply(_unheard(f"{request.name}: {kept}", (baud, present_baud)))
    yield from resume_streaming()
    if found[0] != baud:
        raise Rejected(f"{request.name}: the device keeps {present_baud} baud")
    return BaudChange(baud, saved)


# --- factory reset ----------------------------------------------------------------------------------------------------


def factory_reset(present_baud: int, *, done: int = RESULT_DONE) -> RequestScript[BaudChange]:
    """Restore and save the factory settings (CMD 15), follow the device to its baud rate, and read its parameters back.

    The script restarts a device that changes only at its next start. The device streams afterwards. Raises NoReply, and
    Rejected if a parameter differs from `FACTORY`.
    """
    return with_undo(_factory_reset(present_baud, done), STREAM)


def _factory_reset(present_baud: int, done: int) -> RequestScript[BaudChange]:
    bauds = (FACTORY_BAUD, present_baud)
    if (yield from _look((present_baud,))) is None:
        yield from resume_streaming()
        raise NoReply(_unheard("factory reset: nothing was changed", (present_baud,)))
    result = result_of((yield commands.factory_reset()))
    found = yield from _look(bauds)
    others = {} if found is None else (yield from _not_factory())
    refused = result is not None and result != done
    pending = found is not None and found[0] != FACTORY_BAUD == found[1]
    if found is not None and (pending or (others and not refused)):
        yield from resume_streaming()
        if pending:  # the restart must not lose the new values
            yield from _save(done)
        yield from in_command_mode(_restart)
        yield pause(BOOT_NS)
        found = yield from _look(bauds, BOOT_TRIES)
        others = {} if found is None else (yield from _not_factory())
    yield from resume_streaming()
    if found is None:
        raise NoReply(_unheard("factory reset", bauds))
    if others:
        words = ", ".join(f"{parameter.name} {value:g}" for parameter, value in others.items())
        expected = ", ".join(f"{parameter.name} {FACTORY[parameter]}" for parameter in others)
        word = "none" if result is None else str(result)
        raise Rejected(f"factory reset: expected {expected}, got {words}; acknowledgement {word} ({done} is done)")
    return BaudChange(found[0], (yield from _save(done)))


def read_differences_from_factory() -> RequestScript[Mapping[Parameter, float]]:
    """Read the parameters that differ from the factory settings. Raises NoReply."""
    return in_command_mode(_not_factory)


def _not_factory() -> RequestScript[Mapping[Parameter, float]]:
    """Read the parameters that differ from the factory settings, without parameters that the device lacks."""
    others = {}
    for parameter, expected in FACTORY.items():
        try:
            value = yield from read(parameter)
        except NoReply:
            continue
        if value != expected:
            others[parameter] = value
    return others


# --- steps ------------------------------------------------------------------------------------------------------------


def _save(done: int) -> RequestScript[bool]:
    """Save. Return whether the device acknowledged. Raises Rejected."""
    return (yield from in_command_mode(lambda: ordered(commands.save(), done), CONTACT_TRIES))


def _look(bauds: Sequence[int], tries: int = LOOK_TRIES) -> RequestScript[tuple[int, float] | None]:
    """Find the device and enter command mode. Return the baud rate of the reply and the baud rate that it reports.

    The serial port keeps this baud rate, or the last of `bauds` without a reply.
    """
    for baud in tuple(dict.fromkeys(bauds)) * tries:
        heard = yield commands.output_mode(OutputMode.COMMAND, baud=baud)
        try:
            return baud, (yield from read(Parameter.BAUD, CONTACT_TRIES if isinstance(heard, Reply) else 1))
        except NoReply:
            continue
    return None


def _unheard(what: str, bauds: Sequence[int]) -> str:
    rates = " and ".join(str(baud) for baud in dict.fromkeys(bauds))
    return f"{what}; expected a reply at {rates} baud, got none; check the transmit wire of the host"


Baud = Annotated[
    BaudRate,
    Meta(description="baud rate of the UART", extra={"unit": "bit/s", "section": "1.6, table 12, parameter 3"}),
]
OutputRate = Annotated[
    RateHz, Meta(description="AHRS frames per second", extra={"unit": "Hz", "section": "1.6, table 12, parameter 21"})
]
OutputModeName = Annotated[
    Literal["stream", "command"],
    Meta(
        description="`stream`: AHRS frames; `command`: only replies",
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
        description="bus in addition to the UART; `by_pin`: a pin selects it, SPI if open or low, I2C if high",
        extra={"section": "1.6, table 12, parameter 27"},
    ),
]
AccelFilter = Annotated[FilterChoice, ACCEL_FILTER]
GyroFilter = Annotated[FilterChoice, GYRO_FILTER]
_Three = Annotated[list[float], Meta(min_length=3, max_length=3)]
GyroOffset = Annotated[
    _Three,
    Meta(
        description="zero bias about X, Y, Z from the static calibration",
        extra={"unit": "°/s", "section": "1.5, table 9, parameters 8 to 10"},
    ),
]
InstallationAngles = Annotated[
    _Three,
    Meta(
        description="mounting error about X, Y, Z from the installation calibration",
        extra={"unit": "°", "section": "1.5, table 9, parameters 16 to 18"},
    ),
]


def codes_of(target: Target) -> Imu61xUartOptions:
    """Return the codes of the configuration, or the assumed codes."""
    return target.settings if isinstance(target.settings, Imu61xUartOptions) else Imu61xUartOptions()


# --- scripts ----------------------------------------------------------------------------------------------------------


MODE_REPORT: Final = "output mode"
# Parameters of each report
REPORTS: Final[Mapping[str, tuple[Parameter, ...]]] = {
    **{
        parameter.name: (parameter,)
        for parameter in Parameter
        if parameter not in (*GYRO_OFFSETS, *INSTALLATION_ANGLES)
    },
    "gyro offsets": GYRO_OFFSETS,
    "installation angles": INSTALLATION_ANGLES,
}


def _read(_target: Target, names: Collection[str] | None) -> RequestScript[Reports]:
    reports = {}
    if names is None or MODE_REPORT in names:
        streams = isinstance((yield commands.await_sample(QUIET_NS)), Reply)
        reports[MODE_REPORT] = DeviceReport({}, {"output_mode": "stream" if streams else "command"})
    groups = {name: group for name, group in REPORTS.items() if names is None or name in names}
    if groups:
        wanted = [parameter for group in groups.values() for parameter in group]
        values = yield from in_command_mode(lambda: read_parameters(wanted))
        for name, group in groups.items():
            found = {parameter: values[parameter] for parameter in group if parameter in values}
            reports[name] = DeviceReport(parameter_words(found), settings_of(found))
    return reports


def settings_of(values: ParameterValues) -> Mapping[str, Any]:
    """Return the settings in parameters, without undocumented values."""
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


def _write_baud(target: Target, baud: BaudRate) -> RequestScript[BaudChange]:
    return change_baud(baud, target.baud, done=codes_of(target).result_done)


def _write_mode(target: Target, mode: str) -> RequestScript[None]:
    done = codes_of(target).result_done
    return start_streaming(done=done) if mode == "stream" else stop_streaming(done=done)


def _check(target: Target, values: Mapping[str, Any]) -> None:
    rate_hz, baud = values.get("output_rate_hz"), values.get("baud") or target.baud
    if rate_hz and baud:
        try:
            commands.require_fit(rate_hz, baud)
        except BadArgument as error:
            raise BadArgument(f"output_rate_hz and baud: {error}") from None


# Settings of the device. `output_rate_hz` and `baud` depend on each other.
# The two filters are halves of one parameter; each has its own write. The script of the baud rate saves only if the
# device changes at its next start.
SETTINGS: Final = SettingsTable(
    table={
        "output_rate_hz": Setting(
            type=OutputRate,
            write=lambda _target, hz: write_parameter(Parameter.AHRS_RATE, hz),
            report=Parameter.AHRS_RATE.name,
        ),
        "accel_filter": Setting(
            type=AccelFilter,
            write=lambda _target, choice: write_filters(filter_code(choice), None),
            report=Parameter.FILTER.name,
            agrees=same_filter,
        ),
        "gyro_filter": Setting(
            type=GyroFilter,
            write=lambda _target, choice: write_filters(None, filter_code(choice)),
            report=Parameter.FILTER.name,
            agrees=same_filter,
        ),
        "second_bus": Setting(
            type=SecondBus,
            write=lambda _target, bus: write_parameter(Parameter.BUS_MODE, BusMode[bus.upper()]),
            note="effective immediately or after the next start (not documented); a host on the previous bus "
            "loses the device: change driver and link in its configuration",
            report=Parameter.BUS_MODE.name,
        ),
        "i2c_address": Setting(
            type=Address,
            write=lambda _target, address: write_parameter(Parameter.I2C_ADDRESS, i2c_address(address)),
            report=Parameter.I2C_ADDRESS.name,
            agrees=same_address,
            note="effective immediately or after the next start (not documented); a host that uses the old address "
            "loses the device: change `i2c.address` in its configuration to the new address or `auto`",
        ),
        "gyro_offset_deg_s": Setting(type=GyroOffset, report="gyro offsets"),
        "installation_angles_deg": Setting(type=InstallationAngles, report="installation angles"),
        "output_mode": Setting(type=OutputModeName, write=_write_mode, report=MODE_REPORT),
        "baud": Setting(type=Baud, write=_write_baud, connection=True, report=Parameter.BAUD.name),
    },
    read=_read,
    save=lambda target: save(done=codes_of(target).result_done),
    restart=lambda target: restart(done=codes_of(target).result_done),
    check=_check,
)
