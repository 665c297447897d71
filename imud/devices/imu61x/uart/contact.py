"""Steps of the request scripts of an IMU61x on a UART: contact in either mode, answers, results, read-back.

Manual "IMU61X Interface Protocol and Instructions", sections 1.4 to 1.7. It says that questions belong to command mode
and leaves open what a device does with them while it streams. `in_contact` therefore asks for the status first. An
answer means that all else can be asked as it is; no answer, that the device streams and needs command mode for it:
then that is entered, and streaming is started again at the end, whatever happened. A device that was in command mode
answers at once and stays there. Where the host's transmit line is not connected nothing is changed and NoReply raised.
If only the script is stopped, the order to stream is the last that is sent (`Request.undo`).

The codes of acknowledgements are not documented: `Imu61xUartSettings.result_done` says which one means done, and
everything that judges a result is in `ordered`. After an order the device may be quiet for a while, for example because
it writes to flash: `settled` waits until it answers again.
"""

from collections.abc import Callable
from typing import Annotated, Final, TypeVar

from msgspec import Meta

from imud.contracts.codec import Message
from imud.contracts.session import Outcome, Reply, Request, RequestScript, with_undo
from imud.contracts.settings import Settings
from imud.devices.imu61x.uart import commands
from imud.devices.imu61x.uart.commands import OutputMode
from imud.devices.imu61x.uart.replies import (
    RESULT_DONE,
    Parameter,
    Status,
    parse_acknowledgement,
    parse_parameter,
    parse_status,
)
from imud.errors import CommandError, NoReply, Rejected
from imud.sample import Measurement, Vector3

T = TypeVar("T")

STREAM_TRIES: Final = 5
"""Number of requests to stream until one is acknowledged: a device left silent is worth four repetitions."""
SETTLE_TRIES: Final = 10
"""Questions after an order that may take long, until one is answered: 3 s."""
CONTACT_TRIES: Final = 5
"""The same after any other: 1.5 s."""
ENTER_TRIES: Final = 2
"""Orders to enter command mode; a device that acknowledges none and answers no question is not there."""
STREAM: Final = commands.output_mode(OutputMode.STREAM).payload
"""The bytes that make it stream: the undo of every script that may leave it in command mode."""


class Imu61xUartSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
        if isinstance((yield commands.ask_status()), Reply):
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
        heard = isinstance((yield commands.output_mode(OutputMode.COMMAND)), Reply)
        if heard or not left:
            yield from settled(CONTACT_TRIES if heard else 1)
            return
        if isinstance((yield commands.ask_status()), Reply):
            return


def resume_streaming(tries: int = STREAM_TRIES) -> RequestScript[bool]:
    """Have AHRS frames streamed again (CMD 3, mode 1); return whether the device acknowledged, with any result."""
    for _ in range(tries):
        if isinstance((yield commands.output_mode(OutputMode.STREAM)), Reply):
            return True
    return False


def settled(tries: int = SETTLE_TRIES) -> RequestScript[Status]:
    """Ask for the status until it comes: the device may still be busy with an order. Raises NoReply."""
    for _ in range(tries - 1):
        outcome = yield commands.ask_status()
        if isinstance(outcome, Reply):
            return _status_in(outcome.messages[-1])
    return _status_in((yield from answered(commands.ask_status())))


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
    request = commands.ask_ahrs()
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
        outcome = yield commands.read_parameter(parameter)
        if isinstance(outcome, Reply):
            return _value_in(outcome.messages[-1])
    return _value_in((yield from answered(commands.read_parameter(parameter))))


def _value_in(message: Message) -> float:
    value = parse_parameter(message)
    assert value is not None  # nothing else ends the request
    return value.value


def read3(parameters: tuple[Parameter, Parameter, Parameter]) -> RequestScript[Vector3]:
    """Read the parameters of three axes. Raises NoReply."""
    x, y, z = parameters
    return ((yield from read(x)), (yield from read(y)), (yield from read(z)))
