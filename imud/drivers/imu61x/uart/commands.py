"""Commands to the Forsense IMU61x on a UART. Manual "IMU61X Interface Protocol", section 1.6, tables 10 to 12.

    55 AA | command u16 | 24 u16 | param1 f32 | 0 f32 | param3 u32 | 0 u32 | 0 i32 | 0 i32 | CRC-32

The annotations of the verbs and settings check all values, because the device uses a default in place of an
unsupported value without an error. Settings are lost at power-off unless `save` follows. The manual does not state
whether the device accepts commands other than `output_mode` while it streams; `in_command_mode` handles both cases.

The device acknowledges commands that change something (K1). The manual does not document the result codes: any K1 for
the command ends the reply, and `ordered` compares the result with the option `result_done`.
"""

from collections.abc import Callable
from enum import Enum
from typing import Annotated, Final, Literal, TypeVar, get_args

from msgspec import Meta

from imud.contracts.script import Message, Outcome, Reply, Request, RequestScript, never, with_undo
from imud.drivers.imu61x.common import filter_control
from imud.drivers.imu61x.uart.codec import (
    AHRS_FRAME_BYTES,
    HOST_SYNC,
    RESULT_DONE,
    MagUnit,
    Parameter,
    Status,
    encode_frame,
    pack_parameters,
    parse_acknowledgement,
    parse_parameter,
    parse_status,
)
from imud.drivers.imu61x.uart.raw import RawFrame
from imud.model.errors import BadArgument, CommandError, NoReply, Rejected
from imud.model.options import Options
from imud.model.sample import Measurement, Vector3
from imud.model.units import BITS_PER_UART_BYTE, NS_PER_MS, NS_PER_S

BaudRate = Literal[115200, 921600, 460800, 230400, 1500000]  # baud rate of table 12, bit/s
# All baud rates: factory setting first, then the usual rates for 200 and 400 Hz
BAUD_RATES: Final[tuple[BaudRate, ...]] = get_args(BaudRate)
RateHz = Literal[1, 10, 50, 100, 200, 400]  # AHRS output rate of table 12
RATES_HZ: Final[tuple[RateHz, ...]] = get_args(RateHz)
# Timeout of a reply, ns. 76 bytes take 7 ms at 115200 baud, and a USB adapter holds them for 16 ms.
REPLY_TIMEOUT_NS: Final = 300 * NS_PER_MS
FLASH_TIMEOUT_NS: Final = 5 * NS_PER_S  # timeout while the device erases and writes flash, which may take 2 s, ns
# Timeout of the acknowledgement of a calibration, ns: it may arrive at its start or at its end (assumed)
CALIBRATION_TIMEOUT_NS: Final = 10 * NS_PER_S
Parameters3 = tuple[Parameter, Parameter, Parameter]  # parameters of X, Y and Z


class Command(Enum):
    """Numbers of commands (table 12)."""

    STATUS = 1
    AHRS = 2
    OUTPUT_MODE = 3
    HEADING = 4
    SAVE = 5
    READ_PARAMETER = 6
    CALIBRATE_INSTALLATION = 7
    INSTALLATION_STATUS = 8
    RESTART = 9
    CALIBRATE_GYRO = 10
    SET_PARAMETER = 14
    FACTORY_RESET = 15


class OutputMode(Enum):
    """Messages that the device sends without a request."""

    STREAM = 1  # AHRS frames
    COMMAND = 100  # only replies


class BusMode(Enum):
    """Bus in addition to the UART (parameter 27)."""

    UART_ONLY = 0
    SPI = 1  # factory setting
    I2C = 2
    BY_PIN = 3  # a pin decides: open or low is SPI, high is I2C


# --- requests for values -----------------------------------------------------------------------------------------


def ask_status() -> Request:
    """Return the request for S1: versions, model, serial number, status (CMD 1)."""
    return _command(Command.STATUS, "status", is_end=lambda message: parse_status(message) is not None, repeatable=True)


def ask_ahrs() -> Request:
    """Return the request for one AHRS frame (CMD 2). The measurement ends the reply, and imud publishes it.

    While the device streams, the measurement may be the next frame of the stream.
    """
    return _command(Command.AHRS, "AHRS once", is_end=never, is_sample=any_sample)


def await_sample(timeout_ns: int) -> Request:
    """Return a request that waits for the next measurement without a command."""
    return Request(b"", "sample", never, never, never, timeout_ns, is_sample=any_sample)


def any_sample(_sample: Measurement) -> bool:
    """Return True for every measurement."""
    return True


def read_parameter(parameter: Parameter) -> Request:
    """Return the request for a parameter (CMD 6)."""

    def is_end(message: Message) -> bool:
        value = parse_parameter(message)
        return value is not None and value.index == parameter

    return _command(
        Command.READ_PARAMETER, f"read parameter {parameter.name}", param3=parameter, is_end=is_end, repeatable=True
    )


def ask_installation_status() -> Request:
    """Return the request for the state of the installation calibration (CMD 8).

    The manual does not state whether K1 or S1 contains the state: both end the reply.
    """
    command = Command.INSTALLATION_STATUS
    acknowledged = _acknowledges(command)
    return _command(
        command,
        "installation calibration status",
        is_end=lambda message: acknowledged(message) or parse_status(message) is not None,
        repeatable=True,
    )


# --- commands ---------------------------------------------------------------------------------------------------


def output_mode(mode: OutputMode, *, baud: int = 0) -> Request:
    """Stream AHRS frames, or only reply (CMD 3). With `baud`, imud first sets the baud rate of the serial port."""
    return _command(Command.OUTPUT_MODE, f"output mode {mode.name}", param1=mode.value, baud=baud, repeatable=True)


def reset_heading(heading_deg: float) -> Request:
    """Set the heading of the AHRS, 0° … 360° (CMD 4)."""
    return _command(Command.HEADING, "heading reset", param1=heading_deg)


def save() -> Request:
    """Write the present parameters with the output mode to flash (CMD 5)."""
    return _command(Command.SAVE, "save", timeout_ns=FLASH_TIMEOUT_NS)


def start_installation_calibration() -> Request:
    """Start the measurement of the mounting error (CMD 7)."""
    return _command(Command.CALIBRATE_INSTALLATION, "installation calibration", timeout_ns=CALIBRATION_TIMEOUT_NS)


def restart() -> Request:
    """Restart the device software (CMD 9)."""
    return _command(Command.RESTART, "restart")


def calibrate_gyro() -> Request:
    """Measure the zero bias of the gyroscope (CMD 10). The device must be at rest."""
    return _command(Command.CALIBRATE_GYRO, "gyro calibration", timeout_ns=CALIBRATION_TIMEOUT_NS)


def set_baud(baud: int) -> Request:
    """Set the baud rate of the UART (CMD 14, parameter 3). `settings.change_baud` follows the device."""
    return _set(Parameter.BAUD, baud)


def set_rate(rate_hz: int, *, baud: int = 0) -> Request:
    """Set the AHRS output rate (CMD 14, parameter 21). With `baud`, raises BadArgument if the rate does not fit."""
    if baud:
        require_fit(rate_hz, baud)
    return _set(Parameter.AHRS_RATE, rate_hz)


def set_bus_mode(mode: BusMode) -> Request:
    """Select the bus in addition to the UART (CMD 14, parameter 27)."""
    return _set(Parameter.BUS_MODE, mode.value)


def set_i2c_address(address: int) -> Request:
    """Set the 7-bit I2C address, 0x18 … 0x1B (CMD 14, parameter 30)."""
    return _set(Parameter.I2C_ADDRESS, address)


def set_filter(accel: int, gyro: int) -> Request:
    """Set the low-pass filters by their codes, indices of `FILTERS` (CMD 14, parameter 31)."""
    return _set(Parameter.FILTER, filter_control(accel, gyro))


def factory_reset() -> Request:
    """Restore the factory settings with the baud rate (CMD 15). `settings.factory_reset` follows the device."""
    return _command(Command.FACTORY_RESET, "factory reset", timeout_ns=FLASH_TIMEOUT_NS)


def max_rate_hz(baud: int) -> int:
    """Return the maximum output rate at a baud rate (200 Hz at 115200, note 1 of table 3)."""
    return max(rate_hz for rate_hz in RATES_HZ if rate_hz * AHRS_FRAME_BYTES * BITS_PER_UART_BYTE <= baud)


def min_baud(rate_hz: float) -> int:
    """Return the minimum baud rate for an output rate; the maximum baud rate if none is high enough."""
    return next((baud for baud in sorted(BAUD_RATES) if rate_hz <= max_rate_hz(baud)), max(BAUD_RATES))


def require_fit(rate_hz: float, baud: int) -> None:
    """Raise BadArgument, with numbers and the next step, for an output rate that is too high for the baud rate."""
    if rate_hz > max_rate_hz(baud):
        needed = round(rate_hz * AHRS_FRAME_BYTES * BITS_PER_UART_BYTE)
        raise BadArgument(
            f"expected at most {max_rate_hz(baud)} Hz at {baud} baud, got {rate_hz:g} Hz ({needed} bit/s): "
            f"samples would be lost; {rate_hz:g} Hz need {min_baud(rate_hz)} baud"
        )


# --- encoding ---------------------------------------------------------------------------------------------------------


def encode_command(command: Command, param1: float = 0.0, param3: int = 0) -> bytes:
    """Return the frame of a command without checks of its arguments."""
    return encode_frame(HOST_SYNC, command.value, pack_parameters(param1, param3))


def _set(parameter: Parameter, value: int) -> Request:
    return _command(Command.SET_PARAMETER, f"set parameter {parameter.name} to {value}", param1=value, param3=parameter)


def _command(
    command: Command,
    name: str,
    *,
    param1: float = 0.0,
    param3: int = 0,
    is_end: Callable[[Message], bool] | None = None,
    timeout_ns: int = REPLY_TIMEOUT_NS,
    baud: int = 0,
    is_sample: Callable[[Measurement], bool] | None = None,
    repeatable: bool = False,
) -> Request:
    acknowledged = _acknowledges(command)
    payload = encode_command(command, param1, param3)
    # an acknowledgement of a request for values is part of its reply and does not end it
    ends = is_end or acknowledged
    # the acknowledgement contains the command and not the parameter
    kind = f"{command.name} {param3 if is_end else ''}"
    # outside of command mode, the device may reply to no probe
    probe = None if command in (Command.STATUS, Command.OUTPUT_MODE) else ask_status()
    return Request(
        payload, name, ends, never, acknowledged, timeout_ns,
        kind=kind, repeatable=repeatable, probe=probe, baud=baud, is_sample=is_sample,
    )  # fmt: skip


def _acknowledges(command: Command) -> Callable[[Message], bool]:
    def holds(message: Message) -> bool:
        reply = parse_acknowledgement(message)
        return reply is not None and reply.command == command.value

    return holds


T = TypeVar("T")

STREAM_TRIES: Final = 5  # maximum number of requests to stream: a silent device costs more than four repetitions
SETTLE_TRIES: Final = 10  # maximum number of status requests after a slow command: 3 s
CONTACT_TRIES: Final = 5  # maximum number of status requests after other commands: 1.5 s
# Maximum number of commands to enter command mode. Without acknowledgement and reply, the device is absent.
ENTER_TRIES: Final = 2
# Bytes that start streaming: undo of every script that may leave the device in command mode
STREAM: Final = output_mode(OutputMode.STREAM).payload


class Imu61xUartOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an IMU61x on a UART: a unit, a code and a layout that the manual does not state."""

    mag_unit: MagUnit = "ut"
    """Unit of the magnetic field in AHRS frames of 56 bytes, µT or mG. No source states it."""
    result_done: Annotated[int, Meta(ge=0, le=0xFFFF)] = RESULT_DONE
    """Result in acknowledgements (K1) of an executed command; 0 is assumed."""
    raw_frame: RawFrame | None = None
    """Layout of frame 0x0666. imud then makes the samples from these frames and ignores AHRS frames."""


# --- command mode -----------------------------------------------------------------------------------------------


def in_command_mode(ask: Callable[[], RequestScript[T]], patience: int = 1) -> RequestScript[T]:
    """Run `ask` once, in command mode if the device replies only there. Restore the previous mode. Raises NoReply.

    `patience` is the number of unanswered requests before the script enters command mode. A value above 1 avoids
    command mode for a device that is only quiet for a while.
    """
    for _ in range(patience):
        if isinstance((yield ask_status()), Reply):
            return (yield from ask())

    entered = False

    def enter_and_ask() -> RequestScript[T]:
        nonlocal entered
        yield from _enter_command_mode()
        entered = True
        return (yield from ask())

    try:
        value = yield from with_undo(enter_and_ask(), STREAM)
    except CommandError:
        yield from resume_streaming(STREAM_TRIES if entered else ENTER_TRIES)
        raise
    yield from resume_streaming()
    return value


def _enter_command_mode() -> RequestScript[None]:
    """Enter command mode (CMD 3, mode 100) and wait for a reply. Raises NoReply."""
    # a device that is quiet after the previous script may miss the first command
    for left in reversed(range(ENTER_TRIES)):
        heard = isinstance((yield output_mode(OutputMode.COMMAND)), Reply)
        if heard or not left:
            yield from settled(CONTACT_TRIES if heard else 1)
            return
        if isinstance((yield ask_status()), Reply):
            return


def resume_streaming(tries: int = STREAM_TRIES) -> RequestScript[bool]:
    """Start streaming again (CMD 3, mode 1). Return whether the device acknowledged with any result."""
    for _ in range(tries):
        if isinstance((yield output_mode(OutputMode.STREAM)), Reply):
            return True
    return False


def settled(tries: int = SETTLE_TRIES) -> RequestScript[Status]:
    """Request the status until the device replies, because it may be busy with a command. Raises NoReply."""
    for _ in range(tries - 1):
        outcome = yield ask_status()
        if isinstance(outcome, Reply):
            return _status_in(outcome.messages[-1])
    return _status_in((yield from answered(ask_status())))


def _status_in(message: Message) -> Status:
    status = parse_status(message)
    assert status is not None  # nothing else ends the request
    return status


# --- replies ----------------------------------------------------------------------------------------------------


def answered(request: Request) -> RequestScript[Message]:
    """Return the message that ended the reply. Raises NoReply."""
    outcome = yield request
    if isinstance(outcome, Reply):
        return outcome.messages[-1]
    results = _results(outcome)
    heard = f"got only acknowledgement {', '.join(map(str, results))}" if results else "got none"
    raise NoReply(f"{request.name}: expected a reply, {heard}; check the transmit wire of the host and the baud rate")


def ordered(request: Request, done: int) -> RequestScript[bool]:
    """Send a command. Return whether the device acknowledged its execution. Raises Rejected for another result."""
    outcome = yield request
    result = result_of(outcome)
    if result is not None and result != done:
        raise Rejected(
            f"{request.name}: expected result {done} (done), got {result}: the device rejected the command "
            "or `options.result_done` is not the code of this device"
        )
    return result is not None


def acknowledged(request: Request, done: int) -> RequestScript[None]:
    """Send a command with an unreadable effect. Raises NoReply without an acknowledgement, and Rejected."""
    if not (yield from ordered(request, done)):
        yield from settled()  # raises NoReply if the device does not reply at all
        raise no_acknowledgement(request)


def no_acknowledgement(request: Request) -> NoReply:
    """Return the error of a command that a device with other replies did not acknowledge."""
    return NoReply(
        f"{request.name}: expected an acknowledgement, got none from a device that replies: "
        "it is not known whether the device executed the command"
    )


def result_of(outcome: Outcome) -> int | None:
    """Return the result in an acknowledgement; None without an acknowledgement."""
    return next(iter(_results(outcome)), None)


def _results(outcome: Outcome) -> list[int]:
    return [reply.result for m in outcome.messages if (reply := parse_acknowledgement(m)) is not None]


def sample() -> RequestScript[Measurement]:
    """Request one AHRS frame (CMD 2), or wait for the next frame of the stream. Raises NoReply, Rejected."""
    request = ask_ahrs()
    outcome = yield request
    if isinstance(outcome, Reply) and outcome.sample is not None:
        return outcome.sample
    result = result_of(outcome)
    if result is not None:
        raise Rejected(f"{request.name}: expected a sample, got an acknowledgement with result {result}")
    raise NoReply(f"{request.name}: expected a sample, got none")


# --- parameters -------------------------------------------------------------------------------------------------------


def read(parameter: Parameter, tries: int = CONTACT_TRIES) -> RequestScript[float]:
    """Read a parameter with at most `tries` requests. Raises NoReply."""
    for _ in range(tries - 1):
        outcome = yield read_parameter(parameter)
        if isinstance(outcome, Reply):
            return _value_in(outcome.messages[-1])
    return _value_in((yield from answered(read_parameter(parameter))))


def _value_in(message: Message) -> float:
    value = parse_parameter(message)
    assert value is not None  # nothing else ends the request
    return value.value


def read3(parameters: Parameters3, tries: int = CONTACT_TRIES) -> RequestScript[Vector3]:
    """Read the parameters of three axes with at most `tries` requests each. Raises NoReply."""
    x, y, z = parameters
    return ((yield from read(x, tries)), (yield from read(y, tries)), (yield from read(z, tries)))
