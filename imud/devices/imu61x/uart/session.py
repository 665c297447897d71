"""Request scripts of the Forsense IMU61x on a UART: identity, settings, and changes that keep contact with it.

Manual "IMU61X Interface Protocol and Instructions", sections 1.4 to 1.6. It says that questions belong to command mode
and leaves open what a device does with them while it streams. Every script therefore asks for the status first.
An answer means that all else can be asked as it is; no answer, that the device streams and needs command mode for it:
then that is entered, and streaming is started again at the end, whatever happened. A device that was in command mode
answers at once and stays there. Where the host's transmit line is not connected nothing is changed and NoReply raised.
Command mode is never saved: a device that loses its host in the middle streams again after its next power-on. If only
the script is stopped, the order to stream is the last that is sent (`Request.undo`). For a device that was saved in
command mode there is `wake`.

The codes of acknowledgements are not documented. Changes are confirmed by reading them back where they can
be; elsewhere result 0 counts as done (assumed), which `done` changes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Final, TypeVar

from imud.contracts.codec import Message
from imud.contracts.driver import Identity
from imud.contracts.session import Reply, Request, RequestScript, pause, with_undo
from imud.devices.imu61x.common.family import filter_codes
from imud.devices.imu61x.uart import commands
from imud.devices.imu61x.uart.commands import BAUD_RATES, BusMode, OutputMode
from imud.devices.imu61x.uart.replies import (
    RESULT_DONE,
    Parameter,
    Status,
    parse_acknowledgement,
    parse_parameter,
    parse_status,
)
from imud.errors import BadArgument, CommandError, NoReply, Rejected
from imud.sample import Vector3
from imud.units import NS_PER_MS, NS_PER_S

T = TypeVar("T")

FACTORY_BAUD: Final = BAUD_RATES[0]
STREAM_TRIES: Final = 3
"""Number of requests to stream until one is acknowledged: a device left silent is worth two repetitions."""
LOOK_TRIES: Final = 2
"""A device in the middle of a false frame, made of bytes at another rate, may miss one request."""
BOOT_NS: Final = NS_PER_S
BOOT_TRIES: Final = 5
"""Number of searches after a restart; with their time-outs longer than the 3 s that section 2.2 names."""
POLL_NS: Final = 500 * NS_PER_MS
POLLS_MAX: Final = 120
"""Installation calibration: a minute; the manual gives no time."""

GYRO_OFFSETS: Final = (Parameter.GYRO_X_OFF, Parameter.GYRO_Y_OFF, Parameter.GYRO_Z_OFF)
INSTALLATION_ANGLES: Final = (Parameter.INSTALL_X_OFF, Parameter.INSTALL_Y_OFF, Parameter.INSTALL_Z_OFF)
_NAMED_OTHERWISE: Final = ("software_version", "serial_number", "imu_health")
_STREAM: Final = commands.output_mode(OutputMode.STREAM).payload
_HEXADECIMAL: Final = (Parameter.I2C_ADDRESS, Parameter.FILTER)


@dataclass(frozen=True, slots=True)
class BaudChange:
    """Result of a successful change of the baud rate."""

    baud: int
    """The rate at which the device answered last; the line has it as well."""
    saved: bool
    """Whether the device acknowledged that it saved its parameters."""


# --- identity and settings --------------------------------------------------------------------------------------------


def identify() -> RequestScript[Identity]:
    """Ask for versions, model and serial number (CMD 1). Raises NoReply.

    `details` has the other members of S1 that were sent, `imu_health` in hexadecimal unless it is all zeros. A device
    that answers only in command mode misses the samples of the exchange, some 20 ms.
    """
    return _in_contact(_identity)


def read_settings() -> RequestScript[Mapping[str, str]]:
    """Read all parameters of table 9 (CMD 6), by their names of `Parameter`. Raises NoReply.

    A parameter that the device does not answer for is left out: not every model has every one (assumed).
    """
    return _in_contact(_settings)


def _identity() -> RequestScript[Identity]:
    status = parse_status((yield from _answered(commands.ask_status())))
    assert status is not None  # nothing else ends the request
    return identity_of(status)


def identity_of(status: Status) -> Identity:
    """Make the identity from S1. The numbers of the models are not documented."""
    numbers = {
        name: str(value)
        for name in Status.__dataclass_fields__
        if name not in _NAMED_OTHERWISE and (value := getattr(status, name)) is not None
    }
    if status.imu_health is not None and any(status.imu_health):
        numbers["imu_health"] = status.imu_health.hex()
    serial_number = "".join(f"{word:08X}" for word in status.serial_number)
    return Identity("IMU61x", serial_number, str(status.software_version), numbers)


def _settings() -> RequestScript[Mapping[str, str]]:
    baud = yield from _read(Parameter.BAUD)
    settings = {Parameter.BAUD.name: _shown(Parameter.BAUD, baud)}
    for parameter in Parameter:
        if parameter is Parameter.BAUD:
            continue
        try:
            settings[parameter.name] = _shown(parameter, (yield from _read(parameter)))
        except NoReply:
            continue
    return settings


def _shown(parameter: Parameter, value: float) -> str:
    if not isfinite(value) or value != int(value):
        return f"{value:.7g}"
    return f"0x{int(value):02X}" if parameter in _HEXADECIMAL and value >= 0 else str(int(value))


# --- modes, saving, restart -------------------------------------------------------------------------------------------


def start_streaming() -> RequestScript[bool]:
    """Start streaming of AHRS frames (CMD 3, mode 1); return whether the device acknowledged."""
    for _ in range(STREAM_TRIES):
        if isinstance((yield commands.output_mode(OutputMode.STREAM)), Reply):
            return True
    return False


def wake() -> RequestScript[bool]:
    """Start streaming if the device answers; return whether it acknowledged. Not saved. Raises NoReply."""
    yield from _answered(commands.ask_status())
    return (yield from start_streaming())


def stop_streaming() -> RequestScript[None]:
    """Enter command mode (CMD 3, mode 100), in which the device only replies. Raises NoReply for no answer."""
    yield commands.output_mode(OutputMode.COMMAND)
    yield from _answered(commands.ask_status())


def save() -> RequestScript[bool]:
    """Write all parameters to flash; return whether it acknowledged.

    The output mode is one of them, so a device that obeys while it streams is not taken out of that: what is saved in
    command mode starts silent. One that obeys in command mode only cannot keep that mode (assumed: it could never be
    saved as streaming).
    """
    return _in_contact(_save)


def _save() -> RequestScript[bool]:
    return isinstance((yield commands.save()), Reply)


def restart() -> RequestScript[Identity]:
    """Restart and wait until it answers again. Parameters that were not saved are lost. Raises NoReply."""
    yield from _in_contact(_restart)
    yield pause(BOOT_NS)
    for _ in range(BOOT_TRIES - 1):
        try:
            return (yield from identify())
        except NoReply:
            continue
    return (yield from identify())


def _restart() -> RequestScript[None]:
    yield commands.restart()


# --- parameters -------------------------------------------------------------------------------------------------------

_SETTERS: Final[Mapping[Parameter, Callable[[int], Request]]] = {
    Parameter.AHRS_RATE: commands.set_rate,
    Parameter.I2C_ADDRESS: commands.set_i2c_address,
    Parameter.FILTER: lambda value: commands.set_filter(*filter_codes(value)),
}


def write_parameter(parameter: Parameter, value: int | BusMode) -> RequestScript[None]:
    """Set a parameter and read it back; not saved. Raises BadArgument, NoReply, and Rejected if it reads otherwise.

    The baud rate is not set this way, see `change_baud`; offsets and angles come from calibrations.
    """
    if isinstance(value, BusMode) and parameter is Parameter.BUS_MODE:
        request = commands.set_bus_mode(value)
    elif parameter in _SETTERS and not isinstance(value, BusMode):
        request = _SETTERS[parameter](value)
    else:
        settable = ", ".join(name.name for name in (*_SETTERS, Parameter.BUS_MODE))
        raise BadArgument(f"parameter {parameter.name} = {value}: expected one of {settable}, with a value of its kind")
    wanted = value.value if isinstance(value, BusMode) else value

    def write() -> RequestScript[None]:
        yield request
        found = yield from _read(parameter)
        if found != wanted:
            raise Rejected(f"{request.name}: reads back as {found:g}")

    return _in_contact(write)


def reset_heading(heading_deg: float, *, done: int = RESULT_DONE) -> RequestScript[None]:
    """Make the heading 0° … 360°. Raises BadArgument, NoReply, Rejected."""
    request = commands.reset_heading(heading_deg)

    def reset() -> RequestScript[None]:
        yield from _done(request, done)

    return _in_contact(reset)


# --- calibrations -----------------------------------------------------------------------------------------------------


def calibrate_gyro(*, done: int = RESULT_DONE) -> RequestScript[Vector3]:
    """Measure the gyroscope's zero bias, the device at rest; return it in °/s. Not saved. Raises NoReply, Rejected."""

    def calibrate() -> RequestScript[Vector3]:
        yield from _done(commands.calibrate_gyro(), done)
        return (yield from _read3(GYRO_OFFSETS))

    return _in_contact(calibrate)


def calibrate_installation(*, done: int = RESULT_DONE) -> RequestScript[Vector3]:
    """Measure the mounting error and wait for the end; return the angles about X, Y, Z in °. Not saved.

    `done` is the status that means finished, and the result that means accepted. Raises NoReply, Rejected.
    """

    def calibrate() -> RequestScript[Vector3]:
        yield from _done(commands.start_installation_calibration(), done)
        status: int | None = None
        for _ in range(POLLS_MAX):
            yield pause(POLL_NS)
            status = yield from _installation_status()
            if status == done:
                return (yield from _read3(INSTALLATION_ANGLES))
        raise NoReply(
            f"installation calibration: expected status {done} within {POLLS_MAX * POLL_NS / NS_PER_S:.0f} s, "
            f"got {'none' if status is None else status}; is the device at rest?"
        )

    return _in_contact(calibrate)


def installation_status() -> RequestScript[int | None]:
    """Read the state of the installation calibration; None where the reply has none. Raises NoReply."""
    return _in_contact(_installation_status)


def _installation_status() -> RequestScript[int | None]:
    message = yield from _answered(commands.ask_installation_status())
    if (reply := parse_acknowledgement(message)) is not None:
        return reply.result
    status = parse_status(message)
    return status.calibration_status if status is not None else None


# --- steps that can lose the device -----------------------------------------------------------------------------------


def change_baud(baud: int, present_baud: int) -> RequestScript[BaudChange]:
    """Set the baud rate of device and line from `present_baud` to `baud`, and save it.

    Whether the device changes at once or at its next start is not documented, so it is searched at both rates. The
    rate is saved only after a reply at the new rate, or a report of it at the old one. Ends streaming.
    Raises BadArgument, Rejected where it stays at the old rate (the line too), and NoReply where it is not heard; if
    nothing was saved, it has the old rate again after power-on.
    """
    return with_undo(_change_baud(baud, present_baud), _STREAM)


def _change_baud(baud: int, present_baud: int) -> RequestScript[BaudChange]:
    request = commands.set_baud(baud)
    if (yield from _look((present_baud,))) is None:
        yield from start_streaming()
        raise NoReply(_unheard(f"{request.name}: nothing was changed", (present_baud,)))
    yield request
    saved = False
    found = yield from _look((baud, present_baud))
    if found == (present_baud, baud) != (baud, baud):  # set, but in force at the next start only
        yield from start_streaming()
        saved = yield from save()
        yield from _in_contact(_restart)
        yield pause(BOOT_NS)
        found = yield from _look((baud, present_baud), BOOT_TRIES)
    if found is None:
        yield from start_streaming()  # at the present rate, where the search ended
        kept = "it may have been saved" if saved else "switch its power off and on: nothing was saved"
        raise NoReply(_unheard(f"{request.name}: {kept}", (baud, present_baud)))
    yield from start_streaming()
    if found[0] != baud:
        raise Rejected(f"{request.name}: the device stays at {present_baud} baud")
    saved = (yield from save()) or saved
    return BaudChange(baud, saved)


def factory_reset(present_baud: int) -> RequestScript[BaudChange]:
    """Restore and save the factory settings, and follow the device to its baud rate. Raises NoReply.

    Ends streaming, as delivered.
    """
    return with_undo(_factory_reset(present_baud), _STREAM)


def _factory_reset(present_baud: int) -> RequestScript[BaudChange]:
    bauds = (FACTORY_BAUD, present_baud)
    if (yield from _look((present_baud,))) is None:
        yield from start_streaming()
        raise NoReply(_unheard("factory reset: nothing was changed", (present_baud,)))
    yield commands.factory_reset()
    found = yield from _look(bauds)
    if found is not None and found[0] != FACTORY_BAUD == found[1]:
        yield from start_streaming()
        yield from save()
        yield from _in_contact(_restart)
        yield pause(BOOT_NS)
        found = yield from _look(bauds, BOOT_TRIES)
    if found is None:
        raise NoReply(_unheard("factory reset", bauds))
    yield from start_streaming()
    return BaudChange(found[0], (yield from save()))


def _look(bauds: Sequence[int], tries: int = LOOK_TRIES) -> RequestScript[tuple[int, float] | None]:
    """Find the device, and enter command mode; return the rate it answers at and the rate it reports.

    The line is left at that rate, or at the last of `bauds` where it is not heard.
    """
    for baud in tuple(dict.fromkeys(bauds)) * tries:
        yield commands.output_mode(OutputMode.COMMAND, baud=baud)
        try:
            return baud, (yield from _read(Parameter.BAUD))
        except NoReply:
            continue
    return None


def _unheard(what: str, bauds: Sequence[int]) -> str:
    rates = " and ".join(str(baud) for baud in dict.fromkeys(bauds))
    return f"{what}; expected an answer at {rates} baud, got none: is the host's transmit line connected?"


# --- steps of a script ------------------------------------------------------------------------------------------------


def _in_contact(ask: Callable[[], RequestScript[T]]) -> RequestScript[T]:
    """Run `ask` once, in command mode if the device answers only there, and leave it as it was."""
    if isinstance((yield commands.ask_status()), Reply):
        return (yield from ask())
    yield replace(commands.output_mode(OutputMode.COMMAND), undo=_STREAM)
    try:
        value = yield from with_undo(ask(), _STREAM)
    except CommandError:
        yield from start_streaming()
        raise
    yield from start_streaming()
    return value


def _answered(request: Request) -> RequestScript[Message]:
    """The message that ended the reply. Raises NoReply."""
    outcome = yield request
    if isinstance(outcome, Reply):
        return outcome.messages[-1]
    results = [str(reply.result) for m in outcome.messages if (reply := parse_acknowledgement(m)) is not None]
    heard = f"got only acknowledgement {', '.join(results)}" if results else "got nothing"
    raise NoReply(
        f"{request.name}: expected a reply, {heard}; is the host's transmit line connected, and the baud rate right?"
    )


def _done(request: Request, done: int) -> RequestScript[None]:
    """Send a command. Raises NoReply, and Rejected where the acknowledgement has another result than `done`."""
    reply = parse_acknowledgement((yield from _answered(request)))
    if reply is not None and reply.result != done:
        raise Rejected(f"{request.name}: expected result {done} (done), got {reply.result}")


def _read(parameter: Parameter) -> RequestScript[float]:
    value = parse_parameter((yield from _answered(commands.read_parameter(parameter))))
    assert value is not None  # nothing else ends the request
    return value.value


def _read3(parameters: tuple[Parameter, Parameter, Parameter]) -> RequestScript[Vector3]:
    x, y, z = parameters
    return ((yield from _read(x)), (yield from _read(y)), (yield from _read(z)))
