"""Commands to the Forsense IMU61x on a UART. Manual "IMU61X Interface Protocol", section 1.6, tables 10 to 12.

    55 AA | command u16 | 24 u16 | param1 f32 | 0 f32 | param3 u32 | 0 u32 | 0 i32 | 0 i32 | CRC-32

Each function returns a `Request`. Values are checked where they enter, by the annotations of `actions.py`: for one that
the device does not have it would silently use a default instead. Settings last until power is off unless `save`
follows. Whether the device accepts more than `output_mode` while it streams is not documented; `session.py` does not
depend on it.

Commands that change something are acknowledged (K1). Its result is not judged here, because its codes are not
documented: any K1 for the command ends the reply. `contact.py` judges it, by one option of the driver.
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
    Parameter,
    Status,
    encode_frame,
    pack_parameters,
    parse_acknowledgement,
    parse_parameter,
    parse_status,
)
from imud.model.errors import BadArgument, CommandError, NoReply, Rejected
from imud.model.options import Options
from imud.model.sample import Measurement, Vector3
from imud.model.units import BITS_PER_UART_BYTE, NS_PER_MS, NS_PER_S

BaudRate = Literal[115200, 921600, 460800, 230400, 1500000]
"""A rate of table 12, bit/s."""
BAUD_RATES: Final[tuple[BaudRate, ...]] = get_args(BaudRate)
"""All baud rates, the factory setting first, then those usual for 200 and 400 Hz."""
RateHz = Literal[1, 10, 50, 100, 200, 400]
"""An AHRS output rate of table 12."""
RATES_HZ: Final[tuple[RateHz, ...]] = get_args(RateHz)
"""All of them."""
REPLY_TIMEOUT_NS: Final = 300 * NS_PER_MS
"""A reply of 76 bytes takes 7 ms at 115200 baud, and a USB adapter holds it for 16 ms; the manual gives no time."""
FLASH_TIMEOUT_NS: Final = 5 * NS_PER_S
"""Erasing and writing flash may take 2 s; the manual gives no time."""
CALIBRATION_TIMEOUT_NS: Final = 10 * NS_PER_S
"""A calibration until its acknowledgement, which may come at its begin or at its end; assumed."""


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

    STREAM = 1
    """Sends AHRS frames."""
    COMMAND = 100
    """Sends nothing but replies."""


class BusMode(Enum):
    """The second bus of the device, next to the UART (parameter 27)."""

    UART_ONLY = 0
    SPI = 1
    """Factory setting."""
    I2C = 2
    BY_PIN = 3
    """A pin decides: open or low is SPI, high is I2C."""


# --- questions --------------------------------------------------------------------------------------------------------


def ask_status() -> Request:
    """Ask for S1: versions, model, serial number, status (CMD 1)."""
    return _command(Command.STATUS, "status", is_end=lambda message: parse_status(message) is not None)


def ask_ahrs() -> Request:
    """Ask for one AHRS frame (CMD 2). It comes as a measurement, which ends the reply, and is published as any other.

    While the device streams, the measurement may be the next of the stream.
    """
    return _command(Command.AHRS, "AHRS once", is_end=never, is_sample=any_sample)


def await_sample(timeout_ns: int) -> Request:
    """Wait for the next measurement without a command."""
    return Request(b"", "sample", never, never, never, timeout_ns, is_sample=any_sample)


def any_sample(_sample: Measurement) -> bool:
    """Return True: every measurement of the device will do."""
    return True


def read_parameter(parameter: Parameter) -> Request:
    """Ask for a parameter (CMD 6)."""

    def is_end(message: Message) -> bool:
        value = parse_parameter(message)
        return value is not None and value.index == parameter

    return _command(Command.READ_PARAMETER, f"read parameter {parameter.name}", param3=parameter, is_end=is_end)


def ask_installation_status() -> Request:
    """Ask for the state of the installation error calibration (CMD 8).

    Whether K1 or S1 carries the answer is not documented: both are accepted.
    """
    command = Command.INSTALLATION_STATUS
    acknowledged = _acknowledges(command)
    return _command(
        command,
        "installation calibration status",
        is_end=lambda message: acknowledged(message) or parse_status(message) is not None,
    )


# --- orders -----------------------------------------------------------------------------------------------------------


def output_mode(mode: OutputMode, *, baud: int = 0) -> Request:
    """Stream AHRS frames, or only reply (CMD 3). With `baud`, the line is set to that rate first."""
    return _command(Command.OUTPUT_MODE, f"output mode {mode.name}", param1=mode.value, baud=baud)


def reset_heading(heading_deg: float) -> Request:
    """Make the heading of the AHRS 0° … 360° (CMD 4)."""
    return _command(Command.HEADING, "heading reset", param1=heading_deg)


def save() -> Request:
    """Write the present parameters to flash, the output mode included (CMD 5)."""
    return _command(Command.SAVE, "save", timeout_ns=FLASH_TIMEOUT_NS)


def start_installation_calibration() -> Request:
    """Begin to measure the mounting error (CMD 7); `ask_installation_status` asks for its progress."""
    return _command(Command.CALIBRATE_INSTALLATION, "installation calibration", timeout_ns=CALIBRATION_TIMEOUT_NS)


def restart() -> Request:
    """Start the device's software anew (CMD 9)."""
    return _command(Command.RESTART, "restart")


def calibrate_gyro() -> Request:
    """Measure the zero bias of the gyroscope (CMD 10); the device must be at rest."""
    return _command(Command.CALIBRATE_GYRO, "gyro calibration", timeout_ns=CALIBRATION_TIMEOUT_NS)


def set_baud(baud: int) -> Request:
    """Set the rate of the UART (CMD 14, parameter 3). `session.change_baud` does it without losing the device."""
    return _set(Parameter.BAUD, baud)


def set_rate(rate_hz: int, *, baud: int = 0) -> Request:
    """Set the AHRS output rate (CMD 14, parameter 21). With `baud`, raises BadArgument if it does not fit."""
    if baud:
        require_fit(rate_hz, baud)
    return _set(Parameter.AHRS_RATE, rate_hz)


def set_bus_mode(mode: BusMode) -> Request:
    """Choose the second bus, next to the UART (CMD 14, parameter 27)."""
    return _set(Parameter.BUS_MODE, mode.value)


def set_i2c_address(address: int) -> Request:
    """Set the 7-bit I2C address, 0x18 … 0x1B (CMD 14, parameter 30)."""
    return _set(Parameter.I2C_ADDRESS, address)


def set_filter(accel: int, gyro: int) -> Request:
    """Set the low-pass filters by their codes, indices of `FILTERS` (CMD 14, parameter 31)."""
    return _set(Parameter.FILTER, filter_control(accel, gyro))


def factory_reset() -> Request:
    """Restore the factory settings, the baud rate included (CMD 15). `session.factory_reset` follows the device."""
    return _command(Command.FACTORY_RESET, "factory reset", timeout_ns=FLASH_TIMEOUT_NS)


def max_rate_hz(baud: int) -> int:
    """Highest output rate that fits through a line of `baud` (200 Hz at 115200, note 1 of table 3)."""
    return max(rate_hz for rate_hz in RATES_HZ if rate_hz * AHRS_FRAME_BYTES * BITS_PER_UART_BYTE <= baud)


def min_baud(rate_hz: float) -> int:
    """Lowest baud rate of the device that carries an output rate; its highest where none does."""
    return next((baud for baud in sorted(BAUD_RATES) if rate_hz <= max_rate_hz(baud)), max(BAUD_RATES))


def require_fit(rate_hz: float, baud: int) -> None:
    """Raise BadArgument, with figures and what to change, for an output rate that the line does not carry."""
    if rate_hz > max_rate_hz(baud):
        needed = round(rate_hz * AHRS_FRAME_BYTES * BITS_PER_UART_BYTE)
        raise BadArgument(
            f"expected at most {max_rate_hz(baud)} Hz at {baud} baud, got {rate_hz:g} Hz, which is {needed} bit/s on "
            f"the wire: samples would be lost; {rate_hz:g} Hz need {min_baud(rate_hz)} baud"
        )


# --- encoding ---------------------------------------------------------------------------------------------------------


def encode_command(command: Command, param1: float = 0.0, param3: int = 0) -> bytes:
    """The frame of a command, without any check of its arguments."""
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
) -> Request:
    acknowledged = _acknowledges(command)
    payload = encode_command(command, param1, param3)
    # an acknowledgement of a question is part of its reply but does not end it
    ends = is_end or acknowledged
    return Request(payload, name, ends, never, acknowledged, timeout_ns, baud=baud, is_sample=is_sample)


def _acknowledges(command: Command) -> Callable[[Message], bool]:
    def holds(message: Message) -> bool:
        reply = parse_acknowledgement(message)
        return reply is not None and reply.command == command.value

    return holds


T = TypeVar("T")

STREAM_TRIES: Final = 5
"""Number of requests to stream until one is acknowledged: a device left silent is worth four repetitions."""
SETTLE_TRIES: Final = 10
"""Questions after an order that may take long, until one is answered: 3 s."""
CONTACT_TRIES: Final = 5
"""The same after any other: 1.5 s."""
ENTER_TRIES: Final = 2
"""Orders to enter command mode; a device that acknowledges none and answers no question is not there."""
STREAM: Final = output_mode(OutputMode.STREAM).payload
"""The bytes that make it stream: the undo of every script that may leave it in command mode."""


class Imu61xUartOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an IMU61x on a UART: codes that the manual does not give."""

    result_done: Annotated[int, Meta(ge=0, le=0xFFFF)] = RESULT_DONE
    """Result in the device's acknowledgements (K1) that means done; 0 is assumed."""
    calibration_done: Annotated[int, Meta(ge=0, le=0xFF)] = 0
    """`calibration_status` in the device's status (S1) while no calibration is in progress; 0 is assumed."""


# --- contact ----------------------------------------------------------------------------------------------------------


def in_contact(ask: Callable[[], RequestScript[T]], patience: int = 1) -> RequestScript[T]:
    """Run `ask` once, in command mode if the device answers only there, and leave it as it was. Raises NoReply.

    `patience` is the number of questions without an answer that show that it does not answer as it is: more than one
    where it must not be taken into command mode only because it is quiet for a while.
    """
    for _ in range(patience):
        if isinstance((yield ask_status()), Reply):
            return (yield from ask())

    entered = False

    def in_command_mode() -> RequestScript[T]:
        nonlocal entered
        yield from _enter_command_mode()
        entered = True
        return (yield from ask())

    try:
        value = yield from with_undo(in_command_mode(), STREAM)
    except CommandError:
        yield from resume_streaming(STREAM_TRIES if entered else ENTER_TRIES)
        raise
    yield from resume_streaming()
    return value


def _enter_command_mode() -> RequestScript[None]:
    """Enter command mode (CMD 3, mode 100) and wait until the device answers there. Raises NoReply.

    One that is quiet after the script before may miss the first order.
    """
    for left in reversed(range(ENTER_TRIES)):
        heard = isinstance((yield output_mode(OutputMode.COMMAND)), Reply)
        if heard or not left:
            yield from settled(CONTACT_TRIES if heard else 1)
            return
        if isinstance((yield ask_status()), Reply):
            return


def resume_streaming(tries: int = STREAM_TRIES) -> RequestScript[bool]:
    """Have AHRS frames streamed again (CMD 3, mode 1); return whether the device acknowledged, with any result."""
    for _ in range(tries):
        if isinstance((yield output_mode(OutputMode.STREAM)), Reply):
            return True
    return False


def settled(tries: int = SETTLE_TRIES) -> RequestScript[Status]:
    """Ask for the status until it comes: the device may still be busy with an order. Raises NoReply."""
    for _ in range(tries - 1):
        outcome = yield ask_status()
        if isinstance(outcome, Reply):
            return _status_in(outcome.messages[-1])
    return _status_in((yield from answered(ask_status())))


def _status_in(message: Message) -> Status:
    status = parse_status(message)
    assert status is not None  # nothing else ends the request
    return status


# --- answers ----------------------------------------------------------------------------------------------------------


def answered(request: Request) -> RequestScript[Message]:
    """The message that ended the reply. Raises NoReply."""
    outcome = yield request
    if isinstance(outcome, Reply):
        return outcome.messages[-1]
    results = _results(outcome)
    heard = f"got only acknowledgement {', '.join(map(str, results))}" if results else "got nothing"
    raise NoReply(
        f"{request.name}: expected a reply, {heard}; is the host's transmit line connected, and the baud rate right?"
    )


def ordered(request: Request, done: int) -> RequestScript[bool]:
    """Send an order; return whether the device acknowledged that it is done. Raises Rejected for another result."""
    outcome = yield request
    result = result_of(outcome)
    if result is not None and result != done:
        raise Rejected(
            f"{request.name}: expected result {done} (done), got {result}: it refused, "
            "or `options.result_done` is not the code of this device"
        )
    return result is not None


def acknowledged(request: Request, done: int) -> RequestScript[None]:
    """Send an order whose effect cannot be read. Raises NoReply without an acknowledgement, and Rejected."""
    if not (yield from ordered(request, done)):
        yield from settled()  # raises NoReply where the device itself is not heard
        raise NoReply(
            f"{request.name}: expected an acknowledgement, got none, though the device answers: "
            "whether it is done is not known"
        )


def result_of(outcome: Outcome) -> int | None:
    """The result in an acknowledgement; None where none came."""
    return next(iter(_results(outcome)), None)


def _results(outcome: Outcome) -> list[int]:
    return [reply.result for m in outcome.messages if (reply := parse_acknowledgement(m)) is not None]


def sample() -> RequestScript[Measurement]:
    """Ask for one AHRS frame (CMD 2), or have the next of the stream. Raises NoReply, and Rejected for a refusal."""
    request = ask_ahrs()
    outcome = yield request
    if isinstance(outcome, Reply) and outcome.sample is not None:
        return outcome.sample
    result = result_of(outcome)
    if result is not None:
        raise Rejected(f"{request.name}: expected a sample, got an acknowledgement with result {result}")
    raise NoReply(f"{request.name}: expected a sample, got nothing")


# --- parameters -------------------------------------------------------------------------------------------------------


def read(parameter: Parameter, tries: int = CONTACT_TRIES) -> RequestScript[float]:
    """Read a parameter, asking so often until it is answered. Raises NoReply."""
    for _ in range(tries - 1):
        outcome = yield read_parameter(parameter)
        if isinstance(outcome, Reply):
            return _value_in(outcome.messages[-1])
    return _value_in((yield from answered(read_parameter(parameter))))


def _value_in(message: Message) -> float:
    value = parse_parameter(message)
    assert value is not None  # nothing else ends the request
    return value.value


def read3(parameters: tuple[Parameter, Parameter, Parameter]) -> RequestScript[Vector3]:
    """Read the parameters of three axes. Raises NoReply."""
    x, y, z = parameters
    return ((yield from read(x)), (yield from read(y)), (yield from read(z)))
