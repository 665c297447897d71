"""Execution of request scripts: their requests are sent over the link, the device's messages are passed to them."""

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from imud.contracts.codec import Message
from imud.contracts.session import Outcome, Reply, Request, RequestScript, Session, Silence
from imud.errors import CommandError, LinkError
from imud.formats.can import CanFilter
from imud.ledger import Ledger
from imud.sample import Measurement
from imud.units import NS_PER_S

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
