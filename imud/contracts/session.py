"""Contract of requests and replies on a link that also carries samples: messages in, outcomes out; no I/O, no clock.

A message is a line of text or a reply frame. A request script is a generator (`RequestScript`): it yields a `Request`
and is sent the `Outcome`. The daemon's event loop, a blocking probe and tests run the same generator.
"""

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from imud.contracts.codec import Message, ReplyFrame
from imud.errors import CommandError
from imud.formats.can import CanFilter
from imud.ledger import Ledger
from imud.sample import Measurement
from imud.units import NS_PER_S

T = TypeVar("T")

REPLY_MESSAGES_MAX = 256
"""Limit of messages per reply: the longest reply of any manual has some dozens; more means that its end was lost."""
LATE_WINDOW_NS = 5 * NS_PER_S
"""A matching message up to this long after a time-out counts as the late reply to the request that timed out."""


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


class Session:
    """Exchange of one request at a time; distinguishes late replies from current ones and counts them.

    Devices answer in the order they were asked. A message is late when it can belong to the request that timed out and
    not to the outstanding one, or when it ends a reply whose messages were late. Two requests whose replies are the
    same single message cannot be distinguished: the first message counts for the outstanding request.

    Synchronization: one thread. The owner sends `start()`'s bytes, passes every message to `on_message()`, and calls
    `on_time()` at `deadline_ns`.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._request: Request | None = None
        self._messages: deque[Message] = deque(maxlen=REPLY_MESSAGES_MAX)
        self._timed_out: Request | None = None
        self._timed_out_ns = 0
        self._late_messages = 0
        """Messages of the late reply that is just arriving."""
        self.deadline_ns: int | None = None
        """Deadline of the outstanding request (CLOCK_MONOTONIC), or None."""

    @property
    def busy(self) -> bool:
        """Whether a request is outstanding."""
        return self._request is not None

    def start(self, request: Request, now_ns: int) -> bytes:
        """Make `request` the outstanding one and return its bytes. Raises CommandError when one is outstanding."""
        if self._request is not None:
            raise CommandError(f"{request.name}: still waiting for the reply to {self._request.name}")
        self._messages.clear()
        if not request.silent:
            self._request = request
            self.deadline_ns = now_ns + request.timeout_ns
        return request.payload

    def on_message(self, message: Message, now_ns: int) -> Outcome | None:
        """Process one message; return the outcome when it ends the outstanding request."""
        request = self._request
        if request is None or not self._belongs(request, message) or self._ends_late(request, message, now_ns):
            self._count_stray(message, now_ns)
            return None
        self._late_messages = 0
        self._messages.append(message)
        if request.is_rejection(message):
            return self._finish(Rejection)
        if request.is_end(message):
            return self._finish(Reply)
        return None

    @property
    def wants_samples(self) -> bool:
        """Whether the outstanding request waits for a measurement."""
        return self._request is not None and self._request.is_sample is not None

    def on_sample(self, sample: Measurement) -> Reply | None:
        """Process one measurement; return the outcome when it ends the outstanding request."""
        request = self._request
        if request is None or request.is_sample is None or not request.is_sample(sample):
            return None
        self._request = self.deadline_ns = None
        return Reply(tuple(self._messages), sample)

    def on_time(self, now_ns: int) -> Silence | None:
        """Return `Silence` when the deadline has passed."""
        if self._request is None or self.deadline_ns is None or now_ns < self.deadline_ns:
            return None
        if self._request.payload:  # no request, no late reply
            self._timed_out, self._timed_out_ns = self._request, now_ns
            self._late_messages = len(self._messages)
        self._request = self.deadline_ns = None
        return Silence(tuple(self._messages))

    def cancel(self) -> None:
        """Discard the outstanding request: the link is closed."""
        self._request = self.deadline_ns = None
        self._messages.clear()

    def _belongs(self, request: Request, message: Message) -> bool:
        return _ends(request, message) or request.is_part(message)

    def _ends_late(self, request: Request, message: Message, now_ns: int) -> bool:
        """Whether `message` is an end, but not that of the outstanding request: its own messages have not come."""
        if not _ends(request, message) or self._messages:
            return False
        late_is_arriving = self._late_messages > 0 and self._expects_late(now_ns)
        return late_is_arriving or (request.is_end(message) and request.messages_min > 1)

    def _expects_late(self, now_ns: int) -> bool:
        return self._timed_out is not None and now_ns - self._timed_out_ns <= LATE_WINDOW_NS

    def _finish(self, outcome: type[Reply] | type[Rejection]) -> Reply | Rejection:
        self._request = self.deadline_ns = None
        return outcome(tuple(self._messages))

    def _count_stray(self, message: Message, now_ns: int) -> None:
        late = self._timed_out
        if late is None or not self._expects_late(now_ns) or not self._belongs(late, message):
            self._ledger.replies_unsolicited += 1
            return
        self._late_messages += 1
        if _ends(late, message):
            self._ledger.replies_late += 1
            self._timed_out = None
            self._late_messages = 0


def _ends(request: Request, message: Message) -> bool:
    return request.is_end(message) or request.is_rejection(message)
