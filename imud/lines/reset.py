"""The reset line of a device: pulsed on request, and after a long unsuccessful search for the device.

With `at_start` it is also pulsed once, before the first search. Otherwise a pulse is the last resort: a device that
restarts by itself is absent for `wait_s` as well, and one that was unplugged is not helped. It needs ROUNDS failed
rounds of search and more than `wait_s`, and comes once a minute at most.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Final

from imud.contracts.lines import DeviceLines, LineFactory, OutputLine, ResetOptions
from imud.lines.watched_line import RETRY_NS
from imud.model.errors import CommandError, LinkError
from imud.model.event import EventKind, RaiseEvent
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.sampling.clock import SampleClock

MS_PER_S: Final = 1000
ROUNDS: Final = 3
"""Failed rounds of search before the line is pulsed."""
MARGIN_NS: Final = 1 * NS_PER_S
"""The line is pulsed after a search of `wait_s` and this."""
AGAIN_NS: Final = 60 * NS_PER_S
"""Least interval between two automatic pulses."""

Sleep = Callable[[float], Awaitable[None]]
"""`asyncio.sleep`, or a replacement of it."""


async def reset(line: OutputLine, settings: ResetOptions, sleep: Sleep = asyncio.sleep) -> None:
    """Pulse the open line, and wait for the device's start-up. Raises LinkError.

    The line is left inactive, also when the coroutine is cancelled.
    """
    line.set(True)
    try:
        await sleep(settings.hold_ms / MS_PER_S)
    finally:
        line.set(False)
    await sleep(settings.wait_s)


class ResetLine:
    """Reset line, kept open and inactive. Synchronization: the loop's thread only."""

    def __init__(
        self,
        line: OutputLine,
        settings: ResetOptions,
        raise_event: RaiseEvent,
        now_ns: Callable[[], int],
        on_pulse: Callable[[], None],
    ) -> None:
        """`now_ns` is CLOCK_MONOTONIC. `on_pulse` is called right before each pulse."""
        self.problem = ""
        """Why the line cannot be driven, one sentence; empty if it can."""
        self._line = line
        self._settings = settings
        self._raise_event, self._now_ns = raise_event, now_ns
        self._on_pulse = on_pulse
        self._is_open = False
        self._closed = False
        self._open_ns = 0
        self._rounds = 0
        self._since_ns = 0
        self._again_ns = 0
        self._pulsing = asyncio.Lock()
        self._due_at_start = settings.at_start

    def start(self, clock: SampleClock) -> None:
        """Do nothing: a device counts as found when its first sample comes (`found`)."""

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Open the line if that is due. Call it at 10 Hz."""
        if self._is_open or self._closed or now_ns < self._open_ns:
            return
        try:
            self._line.open()
        except LinkError as error:
            self._fail(error, now_ns)
        else:
            self._is_open, self.problem = True, ""

    def stop(self) -> None:
        """Do nothing: the line stays open while the device's link is down."""

    def close(self) -> None:
        """Release the line, inactive; may be called twice. `tick` does not open it again."""
        self._is_open, self._closed = False, True
        self._line.close()

    async def pulse(self) -> None:
        """Reset the device and wait for its start-up. Raises CommandError."""
        async with self._pulsing:
            if not self._is_open:
                raise CommandError(f"reset: {self.problem or 'the line is not open'}")
            self._rounds = 0
            self._on_pulse()
            try:
                await reset(self._line, self._settings)
            except LinkError as error:
                self._fail(error, self._now_ns())
                raise CommandError(f"reset: {error}") from error

    async def settled(self) -> None:
        """Wait until no pulse and no start-up is in progress; at the start pulse first, if that is wanted."""
        if self._due_at_start and self._is_open:
            self._due_at_start = False
            self._raise_event(self._now_ns(), EventKind.LINK, "reset by its line at the start", line="reset")
            with suppress(CommandError):  # `pulse` has raised the event
                await self.pulse()
        async with self._pulsing:
            return

    def found(self) -> None:
        """End the search: the device sends samples."""
        self._rounds = 0

    async def not_found(self, now_ns: int) -> None:
        """Count a failed round of search, and pulse the line if that is due."""
        if self._rounds == 0:
            self._since_ns = now_ns
        self._rounds += 1
        searched_ns = now_ns - self._since_ns
        patience_ns = self._settings.wait_s * NS_PER_S + MARGIN_NS
        if self._rounds < ROUNDS or searched_ns < patience_ns or now_ns < self._again_ns or not self._is_open:
            return
        self._again_ns = now_ns + AGAIN_NS
        words = f"not found for {searched_ns / NS_PER_S:.0f} s: reset by its line"
        self._raise_event(now_ns, EventKind.LINK, words, line="reset", rounds=self._rounds)
        try:
            await self.pulse()
        except CommandError:
            return  # `pulse` has raised the event

    def _fail(self, error: LinkError, now_ns: int) -> None:
        self._is_open = False
        self._line.close()
        self._open_ns = now_ns + RETRY_NS
        if str(error) != self.problem:
            self.problem = str(error)
            self._raise_event(now_ns, EventKind.LINK, f"line reset: {self.problem}", line="reset")


def make_reset(
    device: str,
    lines: DeviceLines | None,
    factory: LineFactory,
    raise_event: RaiseEvent,
    now_ns: Callable[[], int],
    on_pulse: Callable[[], None],
) -> ResetLine | None:
    """Make the reset line of a device; None if it has none."""
    if lines is None or lines.reset is None:
        return None
    output = factory.make_output(lines.reset, f"{device} reset")
    return ResetLine(output, lines.reset, raise_event, now_ns, on_pulse)
