"""Contract of requests and replies on a link that also carries samples: messages in, outcomes out; no I/O, no clock.

A message is a line of text or a reply frame. A request script is a generator (`RequestScript`): it yields a `Request`
and is sent the `Outcome`. The daemon's event loop, a blocking probe and tests run the same generator.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import msgspec

from imud.formats.can import CanFilter
from imud.model.errors import TransferError
from imud.model.sample import Measurement
from imud.model.units import NS_PER_S


class TextLine(msgspec.Struct, frozen=True, gc=False):
    """One line of text found between binary frames, without its line end."""

    text: str


class ReplyFrame(msgspec.Struct, frozen=True, gc=False):
    """One binary frame that answers a command and carries no sample; for CAN, a frame that does."""

    frame_id: int
    """Kind of the frame as the protocol numbers them; for CAN the identifier."""
    payload: bytes


Message = str | ReplyFrame
"""A message that can answer a command: a line of text without its end, or a binary frame."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Request:
    """A request: the bytes to send, and how to recognise the reply."""

    payload: bytes
    """Bytes for the link; empty sends nothing."""
    name: str
    """The command as written in the manual, for error messages."""
    is_end: Callable[[Message], bool]
    """Whether this message ends a positive reply."""
    is_rejection: Callable[[Message], bool]
    """Whether this message ends a negative reply."""
    is_part: Callable[[Message], bool]
    """Whether this message can be part of the reply; others are unsolicited."""
    timeout_ns: int = NS_PER_S // 2
    silent: bool = False
    """The device never answers this request (it reboots, for example): the request is complete once sent."""
    messages_min: int = 1
    """Fewest messages of a positive reply, its end included: an earlier end belongs to a late reply."""
    baud: int = 0
    """Bit rate of the line from this request on, bit/s; 0 leaves it unchanged. Serial lines only."""
    settings: Any = None
    """Settings of the driver from this request on: the device has another number on its bus. None leaves them as they
    are. CAN buses only; a script that does not hear the device there goes back by the former settings."""
    also: tuple[CanFilter, ...] = ()
    """CAN buses only: further frames that can answer, whichever device they are of, each a `ReplyFrame`. They are
    counted as the codec counts them, those of other devices as skipped."""
    undo: bytes = b""
    """Bytes to send if the script is cancelled at this request while the link is open: a closed generator cannot send.
    No reply is awaited."""
    is_sample: Callable[[Measurement], bool] | None = None
    """Whether this measurement ends a positive reply (`Reply.sample`); None: no measurement does. It is published too.

    For links of bytes: on others no measurement is passed on."""


def never(_message: Message) -> bool:
    """Return False: no message matches."""
    return False


def of_text(holds: Callable[[str], bool]) -> Callable[[Message], bool]:
    """Make a predicate that is true for text for which `holds` is."""
    return lambda message: isinstance(message, str) and holds(message)


def pause(duration_ns: int, *, baud: int = 0) -> Request:
    """Wait before the next request, at another rate if `baud` is given; its outcome is `Silence`."""
    return Request(b"", "pause", never, never, never, duration_ns, baud=baud)


def with_undo(script: "RequestScript[T]", undo: bytes) -> "RequestScript[T]":
    """Make the same script with `undo` in every request."""
    try:
        request = next(script)
        while True:
            request = script.send((yield replace(request, undo=undo)))
    except StopIteration as end:
        value: T = end.value
        return value
    finally:
        script.close()


@dataclass(frozen=True, slots=True)
class _Messages:
    messages: tuple[Message, ...]

    @property
    def lines(self) -> tuple[str, ...]:
        """The messages that are text."""
        return tuple(message for message in self.messages if isinstance(message, str))

    @property
    def frames(self) -> tuple[ReplyFrame, ...]:
        """The messages that are frames."""
        return tuple(message for message in self.messages if isinstance(message, ReplyFrame))


@dataclass(frozen=True, slots=True)
class Reply(_Messages):
    """Positive reply: its messages, the one that ends it last."""

    sample: Measurement | None = None
    """The measurement that ended it, where the request waited for one."""


@dataclass(frozen=True, slots=True)
class Rejection(_Messages):
    """Negative reply: its messages, the refusal last."""


@dataclass(frozen=True, slots=True)
class Silence(_Messages):
    """No complete reply before the deadline; `messages` is the part that arrived."""


Outcome = Reply | Rejection | Silence
RequestScript = Generator[Request, Outcome, T]


def says_nothing(value: T) -> RequestScript[T]:
    """Make the script for a device that answers nothing: no request, and `value` as its result."""
    return value
    yield  # makes it a generator


@dataclass(frozen=True, slots=True)
class Transfer:
    """One transaction, done by one system call."""

    sends: tuple[bytes, ...]
    """SPI: the bytes of each assertion of chip select, of which as many are read. I2C: one item, written first."""
    read_bytes: int = 0
    """I2C: number of bytes to read after a repeated start; 0 for a write alone."""
    gap_us: int = 0
    """SPI: pause after each assertion of chip select."""
    at: int | None = None
    """I2C, RS-485: address of this transfer alone, for example to see whether another device has it."""
    then_at: int | None = None
    """I2C, RS-485: the device's address after this transfer, whatever came of it, and also when the script has ended.
    A script that does not find the device there goes back: a transfer with the former address as `at` and `then_at`."""
    holds: bool = False
    """Whether the device is not read between this transfer and the script's next one: it may be elsewhere just then."""
    reply_ms: int = 0
    """RS-485: longest time to the beginning of the reply; 0, or less than that of the link, for that of the link."""


TransferScript = Generator[Transfer, bytes, T]
"""A script of transfers. It may catch TransferError to clean up; DeviceRefused passes through it."""


def run_transfer_script(script: TransferScript[T], transfer: Callable[[Transfer], bytes]) -> T:
    """Run a script to its end and return its result. Raises what it raises, and LinkError from `transfer`."""
    try:
        wanted = next(script)
        while True:
            wanted = step(script, wanted, transfer)
    except StopIteration as end:
        value: T = end.value
        return value


def step(script: TransferScript[Any], wanted: Transfer, transfer: Callable[[Transfer], bytes]) -> Transfer:
    """Make the wanted transfer and return the next one. Raises StopIteration with the value at the end."""
    try:
        data = transfer(wanted)
    except TransferError as error:
        return script.throw(error)
    return script.send(data)
