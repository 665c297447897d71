"""Reset line of a device: imud pulses it on request, and after a long search without success.

With `at_start`, imud also pulses it once before the first search. An automatic pulse is the last resort: a device that
restarts by itself is also missing for `wait_s`, and a pulse does not help an unplugged device. It needs ROUNDS failed
search rounds and a search longer than `wait_s`. The minimum time between two automatic pulses is one minute.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Final

from imud.contracts.lines import DeviceLines, LineFactory, OutputLine, ResetOptions
from imud.contracts.link import DeviceLink
from imud.host.clock import HostClock
from imud.lines.watched_line import RETRY_NS
from imud.model.errors import CommandError, LinkError
from imud.model.event import EventKind, RaiseEvent
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.sampling.clock import SampleClock

MS_PER_S: Final = 1000
ROUNDS: Final = 3  # number of failed search rounds before an automatic pulse
MARGIN_NS: Final = 1 * NS_PER_S  # additional search time after `wait_s` before an automatic pulse, ns
AGAIN_NS: Final = 60 * NS_PER_S  # minimum time between two automatic pulses, ns

Sleep = Callable[[float], Awaitable[None]]  # `asyncio.sleep`, or its replacement in a test


async def reset(line: OutputLine, settings: ResetOptions, sleep: Sleep = asyncio.sleep) -> None:
    """Pulse the open line, and wait for the start of the device. Raises LinkError.

    The line becomes inactive, also if the coroutine is cancelled.
    """
    line.set(True)
    try:
        await sleep(settings.hold_ms / MS_PER_S)
    finally:
        line.set(False)
    await sleep(settings.wait_s)


class ResetLine:
    """Reset line, kept open and inactive. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        line: OutputLine,
        settings: ResetOptions,
        raise_event: RaiseEvent,
        host: HostClock,
        link: DeviceLink,
    ) -> None:
        """`link.on_reset` is called right before each pulse."""
        self.problem = ""  # reason why imud cannot drive the line, one sentence; empty if it can
        self._line = line
        self._settings = settings
        self._raise_event, self._host = raise_event, host
        self._link = link
        self._is_open = False
        self._closed = False
        self._open_ns = 0
        self._rounds = 0  # failed search rounds since the last sample or pulse
        self._since_ns = 0  # start of the search
        self._again_ns = 0  # earliest time of the next automatic pulse
        self._pulsing = asyncio.Lock()
        self._due_at_start = settings.at_start

    def start(self, clock: SampleClock) -> None:
        """Do nothing. The device is found at its first sample (`found`)."""

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Open the line if due. Call this method at 10 Hz."""
        if self._is_open or self._closed or now_ns < self._open_ns:
            return
        try:
            self._line.open()
        except LinkError as error:
            self._fail(error, now_ns)
        else:
            self._is_open, self.problem = True, ""

    def stop(self) -> None:
        """Do nothing. The line stays open while the device's link is closed."""

    def close(self) -> None:
        """Set the line inactive and release it. `tick` does not open it again. A second call does nothing."""
        self._is_open, self._closed = False, True
        self._line.close()

    async def pulse(self) -> None:
        """Reset the device and wait for its start. Raises CommandError."""
        async with self._pulsing:
            if not self._is_open:
                raise CommandError(f"reset: {self.problem or 'the line is not open'}")
            self._rounds = 0
            self._link.on_reset()
            try:
                await reset(self._line, self._settings)
            except LinkError as error:
                self._fail(error, self._host.now_ns())
                raise CommandError(f"reset: {error}") from error

    async def settled(self) -> None:
        """Wait until no pulse and no start of the device is in progress.

        With `at_start`, pulse the line at the first call.
        """
        if self._due_at_start and self._is_open:
            self._due_at_start = False
            self._raise_event(
                self._host.now_ns(), EventKind.LINK, "restarted by its reset line at the start", line="reset"
            )
            with suppress(CommandError):  # `pulse` has raised the event
                await self.pulse()
        async with self._pulsing:
            return

    def found(self) -> None:
        """End the search: the device sends samples."""
        self._rounds = 0

    async def not_found(self, now_ns: int) -> None:
        """Count a failed search round, and pulse the line if due."""
        if self._rounds == 0:
            self._since_ns = now_ns
        self._rounds += 1
        searched_ns = now_ns - self._since_ns
        patience_ns = self._settings.wait_s * NS_PER_S + MARGIN_NS
        if self._rounds < ROUNDS or searched_ns < patience_ns or now_ns < self._again_ns or not self._is_open:
            return
        self._again_ns = now_ns + AGAIN_NS
        words = f"not found for {searched_ns / NS_PER_S:.0f} s: restarted by its reset line"
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
    host: HostClock,
    link: DeviceLink,
) -> ResetLine | None:
    """Return the reset line of a device; None if it has no reset line."""
    if lines is None or lines.reset is None:
        return None
    output = factory.make_output(lines.reset, f"{device} reset")
    return ResetLine(output, lines.reset, raise_event, host, link)
