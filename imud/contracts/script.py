"""Contract of requests and replies on a link that also carries samples: messages to outcomes, without I/O or clock.

A message is a line of text or a reply frame. A request script is a generator (`RequestScript`): it yields a `Request`
and receives the `Outcome`. The daemon's event loop, a blocking probe and tests run the same generator.
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
    """A line of text between binary frames, without its line end."""

    text: str


class ReplyFrame(msgspec.Struct, frozen=True, gc=False):
    """Binary frame that answers a command and contains no sample. On CAN, a reply frame may contain a sample."""

    frame_id: int  # kind of the frame by the protocol; on CAN the identifier
    payload: bytes


Message = str | ReplyFrame  # possible reply to a command: a line of text without its end, or a binary frame

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Request:
    """Bytes of a request, and the tests that recognize its reply."""

    payload: bytes  # bytes for the link; empty sends nothing
    name: str  # command as written in the manual, for error messages
    is_end: Callable[[Message], bool]  # returns whether this message ends a positive reply
    is_rejection: Callable[[Message], bool]  # returns whether this message ends a negative reply
    # Returns whether this message can be part of the reply. Other messages are unsolicited.
    is_part: Callable[[Message], bool]
    timeout_ns: int = NS_PER_S // 2
    # The device never replies to this request, for example because it restarts. The request is complete when sent.
    silent: bool = False
    # Minimum number of messages in a positive reply, with its end. An earlier end belongs to a late reply.
    messages_min: int = 1
    # Kind of the reply. The replies to two requests of the same kind look alike. Empty: only the replies to two equal
    # requests look alike. A request with a kind and without payload waits for a further reply to the last request.
    kind: str = ""
    # The reply to an equal earlier request also answers this request, if imud sent no other request between them: the
    # request reads a value.
    repeatable: bool = False
    # Request with a reply that no other request of the driver has. imud sends it before this request if a late reply
    # could count as the reply to this request. None for the probe itself, and for requests that must be sent first.
    probe: "Request | None" = None
    # New baud rate of the link for this and all following requests, bit/s; 0: unchanged. Serial ports only.
    baud: int = 0
    # New driver options for this and all following requests, after the node number changed; None: unchanged. CAN only.
    # A script without a reply from the new node number restores the former options.
    settings: Any = None
    # Additional filters for reply frames of any device, CAN only. The codec counts these frames as usual: frames of
    # other devices are skipped.
    also: tuple[CanFilter, ...] = ()
    # Bytes that imud sends if the script is cancelled at this request while the link is open. imud does not wait for a
    # reply. The field exists because a closed generator cannot send.
    undo: bytes = b""
    # Returns whether this measurement ends a positive reply (`Reply.sample`). None: no measurement ends it. imud also
    # publishes the measurement. Byte links only.
    is_sample: Callable[[Measurement], bool] | None = None


def never(_message: Message) -> bool:
    """Return False: no message matches."""
    return False


def pause(duration_ns: int, *, baud: int = 0) -> Request:
    """Return a request that waits, at another baud rate if `baud` is given. Its outcome is `Silence`."""
    return Request(b"", "pause", never, never, never, duration_ns, baud=baud)


def with_undo(script: "RequestScript[T]", undo: bytes) -> "RequestScript[T]":
    """Return the same script with `undo` in every request."""
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
        """Text messages of the outcome."""
        return tuple(message for message in self.messages if isinstance(message, str))

    @property
    def frames(self) -> tuple[ReplyFrame, ...]:
        """Frames of the outcome."""
        return tuple(message for message in self.messages if isinstance(message, ReplyFrame))


@dataclass(frozen=True, slots=True)
class Reply(_Messages):
    """Positive reply. Its last message ends it."""

    sample: Measurement | None = None  # measurement that ended the reply, if the request had `is_sample`


@dataclass(frozen=True, slots=True)
class Rejection(_Messages):
    """Negative reply. Its last message is the rejection."""


@dataclass(frozen=True, slots=True)
class Silence(_Messages):
    """No complete reply before the deadline. `messages` contains the received part."""


Outcome = Reply | Rejection | Silence
RequestScript = Generator[Request, Outcome, T]


def says_nothing(value: T) -> RequestScript[T]:
    """Return a script without requests, with `value` as its result, for a device that never replies."""
    return value
    yield  # makes it a generator


@dataclass(frozen=True, slots=True)
class Transfer:
    """One transaction on a polled bus, in one system call."""

    # SPI: bytes of each assertion of chip select; the device returns the same number of bytes. I2C: one item to write.
    sends: tuple[bytes, ...]
    read_bytes: int = 0  # I2C: number of bytes to read after a repeated start; 0: write only
    gap_us: int = 0  # SPI: pause after each assertion of chip select, µs
    # I2C, RS-485: address for this transfer only, for example to look for a device at another address
    at: int | None = None
    # I2C, RS-485: address of the device after this transfer, also if the transfer fails, and after the script. A script
    # without a reply from the new address restores the former address (`at` and `then_at`).
    then_at: int | None = None
    # imud does not poll the device between this transfer and the next transfer of the script, because the device can be
    # at another address
    holds: bool = False
    # RS-485: maximum time to the start of the reply, ms. 0 or a smaller value than in the link options: the link
    # options.
    reply_ms: int = 0


# Script of transfers. It may catch TransferError to clean up. It must not catch DeviceRefused.
TransferScript = Generator[Transfer, bytes, T]


def run_transfer_script(script: TransferScript[T], transfer: Callable[[Transfer], bytes]) -> T:
    """Run a script to its end and return its result. Raises the errors of the script, and LinkError from `transfer`."""
    try:
        wanted = next(script)
        while True:
            wanted = step(script, wanted, transfer)
    except StopIteration as end:
        value: T = end.value
        return value


def step(script: TransferScript[Any], wanted: Transfer, transfer: Callable[[Transfer], bytes]) -> Transfer:
    """Make the wanted transfer and return the next transfer. Raises StopIteration with the result at the end."""
    try:
        data = transfer(wanted)
    except TransferError as error:
        return script.throw(error)
    return script.send(data)
