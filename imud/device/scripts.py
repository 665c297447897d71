"""Execution of request scripts: one request at a time on the link, and its reply from the codec."""

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import TypeVar

from imud.contracts.script import Message, Outcome, Rejection, Reply, Request, RequestScript, Silence
from imud.formats.can import CanFilter
from imud.host.clock import HostClock
from imud.model.errors import CommandError, LinkError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_S

REPLY_MESSAGES_MAX = 256  # maximum number of messages in a reply. The longest reply of any manual has some dozens.
LATE_WINDOW_NS = 5 * NS_PER_S  # time after a timeout in which a matching message counts as part of the late reply, ns

T = TypeVar("T")


class RequestPort(ABC):
    """Link of a device, as a script runner uses it."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send the bytes of a request. Raises CommandError or LinkError."""

    def change_rate(self, request: Request) -> None:
        """Set the link to the new baud rate of the device. Raises CommandError if the link has no baud rate."""
        raise CommandError(f"{request.name}: expected a serial port to set to {request.baud} baud, got another link")

    def follow(self, request: Request) -> None:
        """Follow the device to its new number on the bus. Raises CommandError if it has no number."""
        raise CommandError(f"{request.name}: expected a bus on which the device has a number, got another link")

    def listen(self, request: Request, filters: Sequence[CanFilter]) -> None:
        """Receive further CAN frames; empty: only frames of the device. Raises CommandError if there is no CAN bus."""
        raise CommandError(f"{request.name}: expected a CAN bus, to receive other devices, got another link")

    def on_busy(self, busy: bool) -> None:  # noqa: B027  # most links have nothing to do
        """Note that a script starts (True) or has ended (False)."""


class ScriptRunner:
    """Runner of one request script at a time. Synchronization: one thread.

    Devices reply in the order of the requests. A message is late if it can belong to the request that timed out and
    not to the outstanding request, or if it ends a reply with late messages. Two requests with the same one-message
    reply cannot be distinguished: the first message counts for the outstanding request.

    `run` needs the event loop. A test without a loop calls `start`, `on_message`, `on_sample`, and `on_time` at
    `deadline_ns`.
    """

    def __init__(self, port: RequestPort, ledger: Ledger, host: HostClock) -> None:
        self._port = port
        self._ledger = ledger
        self._host = host
        self._lock = asyncio.Lock()
        self._outcome: asyncio.Future[Outcome] | None = None
        self._request: Request | None = None
        self._messages: deque[Message] = deque(maxlen=REPLY_MESSAGES_MAX)
        self._timed_out: Request | None = None
        self._timed_out_ns = 0
        self._late_messages = 0  # number of messages of the late reply that is arriving
        self.deadline_ns: int | None = None
        """CLOCK_MONOTONIC of the deadline of the outstanding request; None without a request."""
        self.answered_ns = 0  # CLOCK_MONOTONIC of the newest complete reply; 0 before the first reply
        self.wants_samples = False
        """Whether a request waits for a measurement. An attribute, because the path reads it for each batch."""

    @property
    def busy(self) -> bool:
        """Whether a script is running."""
        return self._lock.locked()

    # --- a script ----------------------------------------------------------------------------------------------------

    async def run(self, script: RequestScript[T]) -> T:
        """Run `script` to its end and return its value.

        Raises the errors of the script, and LinkError if the link is missing. If the script is cancelled or fails
        during a request, the runner sends the `undo` of this request.
        """
        async with self._lock:
            undo = b""
            self._port.on_busy(True)
            try:
                request = next(script)
                while True:
                    undo = request.undo
                    outcome = await self._ask(request)
                    undo = b""
                    request = script.send(outcome)
            except StopIteration as end:
                value: T = end.value
                return value
            finally:
                script.close()
                if undo:
                    with suppress(LinkError, CommandError):  # the link is missing: nothing to undo
                        self._port.write(undo)
                self._port.on_busy(False)

    async def _ask(self, request: Request) -> Outcome:
        port = self._port
        if request.baud:
            port.change_rate(request)
        if request.settings is not None:
            port.follow(request)
        if request.also:
            port.listen(request, request.also)
        loop = asyncio.get_running_loop()
        timer = loop.call_later(request.timeout_ns / NS_PER_S, self._expire)
        try:
            payload = self.start(request, self._host.now_ns())
            if not request.silent:
                self._outcome = loop.create_future()
            if payload:
                port.write(payload)
            return Reply(()) if self._outcome is None else await self._outcome
        finally:
            timer.cancel()
            self._outcome = None
            self.cancel()
            if request.also:
                port.listen(request, ())

    def _expire(self) -> None:
        if self.deadline_ns is not None:  # the timer of the loop can fire a little early
            self.on_time(max(self._host.now_ns(), self.deadline_ns))

    # --- a request ---------------------------------------------------------------------------------------------------

    def start(self, request: Request, now_ns: int) -> bytes:
        """Make `request` the outstanding request and return its bytes. Raises CommandError if one is outstanding."""
        if self._request is not None:
            raise CommandError(f"{request.name}: still waiting for the reply to {self._request.name}")
        self._messages.clear()
        if not request.silent:
            self._request = request
            self.deadline_ns = now_ns + request.timeout_ns
            self.wants_samples = request.is_sample is not None
        return request.payload

    def on_message(self, message: Message, now_ns: int) -> Outcome | None:
        """Process a text line or a reply frame. Return the outcome if it ends the outstanding request."""
        request = self._request
        if request is None or not _belongs(request, message) or self._ends_late(request, message, now_ns):
            self._count_stray(message, now_ns)
            return None
        self._late_messages = 0
        self._messages.append(message)
        if request.is_rejection(message):
            return self._finish(Rejection(tuple(self._messages)))
        if request.is_end(message):
            return self._finish(Reply(tuple(self._messages)))
        return None

    def on_sample(self, sample: Measurement) -> Outcome | None:
        """Process a measurement. Return the outcome if it ends the outstanding request."""
        request = self._request
        if request is None or request.is_sample is None or not request.is_sample(sample):
            return None
        return self._finish(Reply(tuple(self._messages), sample))

    def on_time(self, now_ns: int) -> Outcome | None:
        """Return `Silence` if the deadline has passed."""
        if self._request is None or self.deadline_ns is None or now_ns < self.deadline_ns:
            return None
        if self._request.payload:  # a pause sends nothing: no late reply can follow
            self._timed_out, self._timed_out_ns = self._request, now_ns
            self._late_messages = len(self._messages)
        return self._finish(Silence(tuple(self._messages)))

    def cancel(self) -> None:
        """Discard the outstanding request."""
        self._request = self.deadline_ns = None
        self.wants_samples = False
        self._messages.clear()

    def _finish(self, outcome: Outcome) -> Outcome:
        self._request = self.deadline_ns = None
        self.wants_samples = False
        if self._outcome is not None and not self._outcome.done():
            self._outcome.set_result(outcome)
            if not isinstance(outcome, Silence):
                self.answered_ns = self._host.now_ns()
        return outcome

    # --- late replies ------------------------------------------------------------------------------------------------

    def _ends_late(self, request: Request, message: Message, now_ns: int) -> bool:
        """Return whether `message` ends a late reply: no message of the outstanding reply has arrived yet."""
        if not _ends(request, message) or self._messages:
            return False
        late_is_arriving = self._late_messages > 0 and self._expects_late(now_ns)
        return late_is_arriving or (request.is_end(message) and request.messages_min > 1)

    def _expects_late(self, now_ns: int) -> bool:
        return self._timed_out is not None and now_ns - self._timed_out_ns <= LATE_WINDOW_NS

    def _count_stray(self, message: Message, now_ns: int) -> None:
        """Count a message that belongs to no outstanding request: part of a late reply, or unsolicited."""
        late = self._timed_out
        if late is None or not self._expects_late(now_ns) or not _belongs(late, message):
            self._ledger.replies_unsolicited += 1
            return
        self._late_messages += 1
        if _ends(late, message):
            self._ledger.replies_late += 1
            self._timed_out = None
            self._late_messages = 0


def _belongs(request: Request, message: Message) -> bool:
    return _ends(request, message) or request.is_part(message)


def _ends(request: Request, message: Message) -> bool:
    return request.is_end(message) or request.is_rejection(message)
