"""Execution of request scripts: their requests are sent over the link, the device's messages are passed to them."""

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from imud.contracts.script import Message, Outcome, Rejection, Reply, Request, RequestScript, Silence
from imud.formats.can import CanFilter
from imud.model.errors import CommandError, LinkError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_S

REPLY_MESSAGES_MAX = 256
"""Limit of messages per reply: the longest reply of any manual has some dozens; more means that its end was lost."""
LATE_WINDOW_NS = 5 * NS_PER_S
"""A matching message up to this long after a time-out counts as the late reply to the request that timed out."""


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


T = TypeVar("T")


class Exchange:
    """Executor of one request script at a time. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        ledger: Ledger,
        write: Callable[[bytes], None],
        now_ns: Callable[[], int],
        set_baud: Callable[[int], None] | None = None,
        follow: Callable[[Any], None] | None = None,
        listen: Callable[[Sequence[CanFilter]], None] | None = None,
        on_busy: Callable[[bool], None] = lambda _busy: None,
    ) -> None:
        """`now_ns` reads CLOCK_MONOTONIC; `set_baud` changes the rate of the link, None where it has none; `follow`
        listens to the device by other settings of its driver, `listen` for further frames of a CAN bus, None where the
        device has no number on a bus. `on_busy` is called when a script begins (True) and when it has ended."""
        self._session = Session(ledger)
        self._write = write
        self._now_ns = now_ns
        self._set_baud = set_baud
        self._follow = follow
        self.answered_ns = 0
        """CLOCK_MONOTONIC of the newest complete reply; 0 before the first."""
        self._listen = listen
        self._on_busy = on_busy
        self._lock = asyncio.Lock()
        self._outcome: asyncio.Future[Outcome] | None = None
        self.wants_samples = False
        """Whether a request waits for a measurement; read once per batch, so an attribute."""

    async def run(self, script: RequestScript[T]) -> T:
        """Run `script` to its end and return its value. Raises what it raises, and LinkError when unplugged.

        Cancelled or failed in the middle of a request, it sends that request's `undo`.
        """
        async with self._lock:
            undo = b""
            self._on_busy(True)
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
                    with suppress(LinkError, CommandError):  # the device is gone, and its state with it
                        self._write(undo)
                self._on_busy(False)

    @property
    def busy(self) -> bool:
        """Whether a script is running."""
        return self._lock.locked()

    def on_message(self, message: Message, t_rx_ns: int) -> None:
        """Pass on one line of text or one reply frame from the codec."""
        self._settle(self._session.on_message(message, t_rx_ns))

    def on_sample(self, sample: Measurement) -> None:
        """Pass on one measurement from the codec."""
        self._settle(self._session.on_sample(sample))

    async def _ask(self, request: Request) -> Outcome:
        if request.baud:
            self._change_rate(request)
        if request.settings is not None:
            self._change_number(request)
        if request.also:
            self._hear(request, request.also)
        loop = asyncio.get_running_loop()
        timer = loop.call_later(request.timeout_ns / NS_PER_S, self._expire)
        try:
            payload = self._session.start(request, self._now_ns())
            self.wants_samples = self._session.wants_samples
            if payload:
                self._write(payload)
            if request.silent:
                return Reply(())
            self._outcome = loop.create_future()
            return await self._outcome
        finally:
            timer.cancel()
            self._outcome = None
            self.wants_samples = False
            self._session.cancel()
            if request.also:
                self._hear(request, ())

    def _hear(self, request: Request, filters: Sequence[CanFilter]) -> None:
        if self._listen is None:
            raise CommandError(f"{request.name}: expected a CAN bus, on which other devices are heard, got none")
        self._listen(filters)

    def _change_rate(self, request: Request) -> None:
        if self._set_baud is None:
            raise CommandError(f"{request.name}: expected a serial line to set to {request.baud} baud, got none")
        self._set_baud(request.baud)

    def _change_number(self, request: Request) -> None:
        if self._follow is None:
            raise CommandError(f"{request.name}: expected a bus on which the device has a number, got none")
        self._follow(request.settings)

    def _expire(self) -> None:
        deadline_ns = self._session.deadline_ns
        if deadline_ns is not None:  # the loop's timer may fire a little early against CLOCK_MONOTONIC
            self._settle(self._session.on_time(max(self._now_ns(), deadline_ns)))

    def _settle(self, outcome: Outcome | None) -> None:
        if outcome is not None and self._outcome is not None and not self._outcome.done():
            self._outcome.set_result(outcome)
            if not isinstance(outcome, Silence):
                self.answered_ns = self._now_ns()
