"""Execution of request scripts: one request at a time on the link, and its reply from the codec."""

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import dropwhile
from typing import TypeVar

from imud.contracts.script import Message, Outcome, Rejection, Reply, Request, RequestScript, Silence, pause
from imud.formats.can import CanFilter
from imud.host.clock import HostClock
from imud.model.errors import CommandError, LinkError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S

REPLY_MESSAGES_MAX = 256  # maximum number of messages in a reply. The longest reply of any manual has some dozens.
PATIENCE_MAX_NS = 3 * NS_PER_S  # maximum timeout by the observed replies, ns
PATIENCE_FACTOR = 2  # timeout as a multiple of the slowest reply
# Requests with a longer timeout do not change the timeout of other requests: the device writes flash or calibrates.
ORDINARY_TIMEOUT_NS = NS_PER_S // 2
PROBES = 3  # maximum number of probes before a request; each has twice the timeout of the previous probe
# Maximum number of requests whose late replies imud recognizes: 16 requests without a reply, with their probes
OWED_MAX = 64

T = TypeVar("T")


class RequestPort(ABC):
    """Link of a device, as a script runner uses it."""

    busy = False  # whether a request script is running

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

    def on_change(self) -> None:  # noqa: B027 - `imud probe` makes no samples
        """Note that imud sends a request that can change the sample rate."""

    def on_busy(self, busy: bool) -> None:
        """Note that a script starts (True) or has ended (False)."""
        self.busy = busy


class _Owed:
    """A request without a reply: its late reply can still arrive."""

    __slots__ = ("partial", "request", "sent_ns")

    def __init__(self, request: Request, sent_ns: int, partial: bool) -> None:
        self.request = request
        self.sent_ns = sent_ns  # CLOCK_MONOTONIC when imud sent the request
        self.partial = partial  # whether a part of the reply arrived before the timeout: its end can look like any end

    def resembles(self, request: Request) -> bool:
        """Return whether the complete replies to both requests look alike."""
        mine = self.request
        return (mine.kind, mine.kind or mine.payload) == (request.kind, request.kind or request.payload)

    def reads_like(self, request: Request) -> bool:
        """Return whether this request changes no value, and its reply also answers `request` if it looks like it."""
        return self.request.repeatable and (not self.resembles(request) or self.request.payload == request.payload)


class ScriptRunner:
    """Runner of one request script at a time. Synchronization: one thread.

    Devices reply in the order of the requests. A message is late if it can belong to a request that timed out and not
    to the outstanding request, or if it ends a reply with late messages. The runner skips a copy of the newest reply if
    its lines show the difference. Before a request whose reply looks like a late reply, the runner sends the `probe` of
    the request. The reply to the probe shows that no earlier reply can follow. If no reply to a probe arrives, the next
    matching reply counts for the oldest request without a reply.

    The timeout of a request is at least PATIENCE_FACTOR times the slowest reply of the device, at most
    PATIENCE_MAX_NS. Before the first reply, each timeout doubles the next timeout.

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
        self._sent_ns = 0  # CLOCK_MONOTONIC when imud sent the outstanding request
        # time of the slowest ordinary reply, ns; before the first reply, the newest timeout
        self._slowest_ns = 0
        self._replied = False  # whether the time of a reply is known
        self._owed: deque[_Owed] = deque(maxlen=OWED_MAX)  # requests without a reply, oldest first
        self._baud = 0  # baud rate that a script has set; 0: unchanged
        self._late_messages = 0  # number of messages of the late reply or the copy that is arriving
        self._newest: tuple[Request, tuple[Message, ...]] = pause(0), ()  # newest complete reply, with its request
        self.deadline_ns: int | None = None
        """CLOCK_MONOTONIC of the deadline of the outstanding request; None without a request."""
        self.answered_ns = 0  # CLOCK_MONOTONIC of the newest complete reply; 0 before the first reply
        self.wants_samples = False
        """Whether a request waits for a measurement. An attribute, because the path reads it for each batch."""

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
                    for factor in range(PROBES):  # before a request whose reply could be a late reply
                        if request.probe is None or not self._owed or not self.is_owed(request):
                            break
                        timeout_ns = request.probe.timeout_ns << factor
                        await self._exchange(replace(request.probe, timeout_ns=timeout_ns))
                    if request.payload and not request.repeatable:
                        self._port.on_change()
                    outcome = await self._exchange(request)
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

    async def _exchange(self, request: Request) -> Outcome:
        port = self._port
        if request.baud:
            port.change_rate(request)
            if request.baud != self._baud:
                self._baud = request.baud
                self._owed.clear()  # at the new rate, a reply at the old rate is not readable
        if request.settings is not None:
            port.follow(request)
        if request.also:
            port.listen(request, request.also)
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(self._timeout_ns(request) / NS_PER_S, self._expire)
        try:
            payload = self.start(request, self._host.now_ns())
            if not request.silent:
                self._outcome = loop.create_future()
            if payload:
                port.write(payload)
            return Reply(()) if self._outcome is None else await self._outcome
        finally:
            self._timer.cancel()
            self._outcome = None
            if self._request is not None:
                self.cancel()
            if request.also:
                port.listen(request, ())

    def is_owed(self, request: Request) -> bool:
        """Return whether a late reply could count as the reply to `request`."""
        if request.silent or not request.payload or (request.baud and request.baud != self._baud):
            return False
        similar = list(dropwhile(lambda owed: not (owed.partial or owed.resembles(request)), self._owed))
        return bool(similar) and not (request.repeatable and all(owed.reads_like(request) for owed in similar))

    def _timeout_ns(self, request: Request) -> int:
        """Return the timeout of a request by the slowest reply. A pause keeps its time."""
        if not (request.payload or request.kind):
            return request.timeout_ns
        return max(request.timeout_ns, min(PATIENCE_FACTOR * self._slowest_ns, PATIENCE_MAX_NS))

    def _expire(self) -> None:
        if self.deadline_ns is None:
            return
        now_ns = self._host.now_ns()
        left_ns = self.deadline_ns - now_ns
        if left_ns > NS_PER_MS:  # a late reply has extended the timeout
            self._timer = asyncio.get_running_loop().call_later(left_ns / NS_PER_S, self._expire)
        else:  # the timer of the loop can fire a little early
            self.on_time(max(now_ns, self.deadline_ns))

    # --- a request ---------------------------------------------------------------------------------------------------

    def start(self, request: Request, now_ns: int) -> bytes:
        """Make `request` the outstanding request and return its bytes. Raises CommandError if one is outstanding."""
        if self._request is not None:
            raise CommandError(f"{request.name}: still waiting for the reply to {self._request.name}")
        self._messages.clear()
        if not request.silent:
            self._request = request
            self._sent_ns = now_ns
            self.deadline_ns = now_ns + self._timeout_ns(request)
            self.wants_samples = request.is_sample is not None
        return request.payload

    def on_message(self, message: Message, now_ns: int) -> Outcome | None:
        """Process a text line or a reply frame. Return the outcome if it ends the outstanding request."""
        request = self._request
        ends = request is not None and _ends(request, message)
        is_alone = ends and not self._messages
        if (
            request is None
            or not (ends or request.is_part(message))
            or (is_alone and request.messages_min > 1 and request.is_end(message))  # too short
            or (is_alone and self._late_messages > 0)  # the end of a late reply, or of a copy of the newest reply
            or (is_alone and self._owed and self.is_owed(request) and self._owing(message) is not None)
        ):
            self._count_stray(message, now_ns)
            return None
        self._late_messages = 0
        self._messages.append(message)
        if not ends:
            return None
        newest, messages = self._newest
        if len(messages) > 1 and newest.payload != request.payload and tuple(self._messages) == messages:
            # the device sent its newest reply again: the lines of a report in the reply to another request
            self._ledger.replies_unsolicited += len(self._messages)
            self._messages.clear()
            return None
        # it can be the reply to the oldest similar request, and no earlier one follows
        if request.timeout_ns <= ORDINARY_TIMEOUT_NS and not self._owed:
            self._note_reply_time(now_ns - self._sent_ns)
        while request.kind and self._owed and not self._owed[0].resembles(request):
            self._owed.popleft()
        if request.kind and self._owed:
            self._owed[0].partial = False  # a complete reply of this kind can follow
        self._newest = request, tuple(self._messages)
        made = Rejection if request.is_rejection(message) else Reply
        return self._finish(made(tuple(self._messages)))

    def on_sample(self, sample: Measurement) -> Outcome | None:
        """Process a measurement. Return the outcome if it ends the outstanding request."""
        request = self._request
        if request is None or request.is_sample is None or not request.is_sample(sample):
            return None
        return self._finish(Reply(tuple(self._messages), sample))

    def on_time(self, now_ns: int) -> Outcome | None:
        """Return `Silence` if the deadline has passed."""
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return None
        self._expect_late(now_ns)
        return self._finish(Silence(tuple(self._messages)))

    def cancel(self) -> None:
        """Discard the outstanding request. Its reply can arrive late."""
        self._expect_late(self._host.now_ns())
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

    def _note_reply_time(self, duration_ns: int) -> None:
        """Follow the slowest reply, also with the timeout of the outstanding request."""
        self._slowest_ns = max(self._slowest_ns, duration_ns) if self._replied else duration_ns
        self._replied = True
        if self._request is not None:
            self.deadline_ns = max(self.deadline_ns or 0, self._sent_ns + self._timeout_ns(self._request))

    def _expect_late(self, now_ns: int) -> None:
        """Expect the late reply to the outstanding request. No late reply can follow a pause."""
        request = self._request
        if request is not None and (request.payload or request.kind):
            self._owed.append(_Owed(request, self._sent_ns, bool(self._messages)))
            if not self._replied:
                self._slowest_ns = max(self._slowest_ns, now_ns - self._sent_ns)
            self._late_messages = len(self._messages)

    def _owing(self, message: Message) -> _Owed | None:
        """Return the oldest request without a reply that `message` can belong to; None if there is none."""
        return next(
            (owed for owed in self._owed if _ends(owed.request, message) or owed.request.is_part(message)), None
        )

    def _count_stray(self, message: Message, now_ns: int) -> None:
        """Count a message that belongs to no outstanding request: part of a late reply, or unsolicited."""
        late = self._owing(message)
        if late is None:
            self._ledger.replies_unsolicited += 1
            *lines, end = self._newest[1] or ("",)
            if message in lines:  # the device sends its newest reply again: the next end belongs to this copy
                self._late_messages += 1
            elif message == end:
                self._late_messages = 0
            return
        self._late_messages += 1
        if _ends(late.request, message):
            self._ledger.replies_late += 1
            if late.request.timeout_ns <= ORDINARY_TIMEOUT_NS:
                self._note_reply_time(now_ns - late.sent_ns)
            while self._owed.popleft() is not late:
                pass  # the device replies in order
            self._late_messages = 0


def _ends(request: Request, message: Message) -> bool:
    return request.is_end(message) or request.is_rejection(message)
