"""The reset line of a device: pulsed when asked, and when a search for the device has found nothing for long.

A pulse is the last resort: a device that restarted by itself is not there for `wait_s` either, and one that was pulled
out is not helped. So it takes ROUNDS rounds of search without an answer and more than `wait_s`, and then comes once a
minute at most.
"""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Final

from imud.contracts.lines import DeviceLines, LineFactory, OutputLine, ResetSettings
from imud.errors import CommandError, LinkError
from imud.event import EventKind, RaiseEvent
from imud.signals.watched_line import RETRY_NS
from imud.units import NS_PER_S

MS_PER_S: Final = 1000
ROUNDS: Final = 3
MARGIN_NS: Final = 1 * NS_PER_S
"""So much longer than `wait_s` a search lasts before the line is pulsed."""
AGAIN_NS: Final = 60 * NS_PER_S
"""Between two pulses that nobody asked for."""

Sleep = Callable[[float], Awaitable[None]]
"""`asyncio.sleep`, or a test's."""


async def reset(line: OutputLine, settings: ResetSettings, sleep: Sleep = asyncio.sleep) -> None:
    """Hold the open line active, let it go, and wait as long as the device needs. Raises LinkError.

    Cancelled at any moment, it leaves the line inactive.
    """
    line.set(True)
    try:
        await sleep(settings.hold_ms / MS_PER_S)
    finally:
        line.set(False)
    await sleep(settings.wait_s)


class ResetLine:
    """Owns the line, which is kept open and inactive. Synchronization: the loop's thread only."""

    def __init__(
        self, line: OutputLine, settings: ResetSettings, raise_event: RaiseEvent, on_pulse: Callable[[], None]
    ) -> None:
        """`on_pulse` is told right before the device is reset."""
        self.problem = ""
        """Why it cannot be driven now, one sentence; empty when it can."""
        self._line = line
        self._settings = settings
        self._raise_event = raise_event
        self._on_pulse = on_pulse
        self._is_open = False
        self._stopped = False
        self._open_ns = 0
        self._now_ns = 0
        self._rounds = 0
        self._since_ns = 0
        self._again_ns = 0
        self._pulsing = asyncio.Lock()

    def tick(self, now_ns: int) -> None:
        """Ten times a second: open it, and again when it failed."""
        self._now_ns = now_ns
        if self._is_open or self._stopped or now_ns < self._open_ns:
            return
        try:
            self._line.open()
        except LinkError as error:
            self._fail(error)
        else:
            self._is_open, self.problem = True, ""

    def close(self) -> None:
        """Leave it inactive and let go of it for good; may be called twice."""
        self._is_open, self._stopped = False, True
        self._line.close()

    async def pulse(self) -> None:
        """Reset the device and wait until it works again. Raises CommandError."""
        async with self._pulsing:
            if not self._is_open:
                raise CommandError(f"reset: {self.problem or 'the line is not open'}")
            self._rounds = 0
            self._on_pulse()
            try:
                await reset(self._line, self._settings)
            except LinkError as error:
                self._fail(error)
                raise CommandError(f"reset: {error}") from error

    async def settled(self) -> None:
        """Return when no pulse is on its way and the device had its time."""
        async with self._pulsing:
            return

    def found(self) -> None:
        """The device is there."""
        self._rounds = 0

    async def not_found(self, now_ns: int) -> None:
        """A round of search ended without it: pulse the line if it is time to."""
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
            return  # told where it failed

    def _fail(self, error: LinkError) -> None:
        self._is_open = False
        self._line.close()
        self._open_ns = self._now_ns + RETRY_NS
        if str(error) != self.problem:
            self.problem = str(error)
            self._raise_event(self._now_ns, EventKind.LINK, f"line reset: {self.problem}", line="reset")


def make_reset(
    device: str, lines: DeviceLines | None, maker: LineFactory, raise_event: RaiseEvent, on_pulse: Callable[[], None]
) -> ResetLine | None:
    """The reset line of a device that has one."""
    if lines is None or lines.reset is None:
        return None
    return ResetLine(maker.make_output(lines.reset, f"{device} reset"), lines.reset, raise_event, on_pulse)
