"""RMC sentences made from the system clock, right after each second, while the kernel says that it is synchronised."""

import asyncio
from collections.abc import Callable
from time import monotonic_ns
from typing import Final

from imud.formats.rmc import build
from imud.units import NS_PER_MS, NS_PER_S
from imud.utc.adjtimex import KernelClock, kernel_clock, realtime_offset_ns
from imud.utc.source import MakePort, OnSentence, RmcSettings

AFTER_NS: Final = 200 * NS_PER_MS
"""A sentence comes so long after the instant it names: more than the clock may be off (60 ms, three sigma), so that it
never comes before the pulse of its second."""
LATEST_NS: Final = 800 * NS_PER_MS
"""None comes later in a second, when it could be taken for the next one's."""
LATE_NS: Final = 50 * NS_PER_MS
"""Woken later than this, a sentence is left out: the next one is near."""


class SystemClockSource:
    """The system clock as an `RmcSource`."""

    def __init__(
        self,
        settings: RmcSettings,
        ask: Callable[[], KernelClock] = kernel_clock,
        offset_ns: Callable[[], int] = realtime_offset_ns,
        now_ns: Callable[[], int] = monotonic_ns,
    ) -> None:
        self.title = "the system clock"
        self.problem = ""
        self.sentences = 0
        self._step_ns = NS_PER_S // settings.rate_hz
        self._most_ns = round(settings.error_ms * NS_PER_MS)
        self._ask, self._offset_ns, self._now_ns = ask, offset_ns, now_ns
        self._on_sentence: OnSentence = lambda _sentence, _t_rx_ns: None
        self._timer: asyncio.TimerHandle | None = None

    def start(self, on_sentence: OnSentence) -> None:
        """Give a sentence after each second, or part of one."""
        self._on_sentence = on_sentence
        self._wait()

    async def close(self) -> None:
        """Stop; may be called twice."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def tick(self) -> None:
        """Give the sentence that is due, if any is and the clock is good enough."""
        now_ns = self._now_ns()
        utc_ns = now_ns + self._offset_ns()
        named_ns = self._named_ns(utc_ns)
        if utc_ns % NS_PER_S < AFTER_NS or utc_ns % NS_PER_S >= LATEST_NS:
            return
        if not 0 <= utc_ns - AFTER_NS - named_ns < LATE_NS:
            return
        self.problem = self._complaint()
        if not self.problem:
            self.sentences += 1
            self._on_sentence(build(named_ns), now_ns)

    def wait_ns(self) -> int:
        """How long until the next sentence is due."""
        utc_ns = self._now_ns() + self._offset_ns()
        named_ns = self._named_ns(utc_ns)
        next_second_ns = (named_ns // NS_PER_S + 1) * NS_PER_S
        return min(named_ns + self._step_ns, next_second_ns) + AFTER_NS - utc_ns

    def _named_ns(self, utc_ns: int) -> int:
        """The last instant of which a sentence was due."""
        second, rest_ns = divmod(utc_ns - AFTER_NS, NS_PER_S)
        return second * NS_PER_S + rest_ns // self._step_ns * self._step_ns

    def _wait(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(self.wait_ns() / NS_PER_S, self._on_time)

    def _on_time(self) -> None:
        self._wait()
        self.tick()

    def _complaint(self) -> str:
        clock = self._ask()
        if not clock.synchronised:
            return "the system clock is not synchronised: is chronyd or another NTP client running?"
        if clock.error_ns > self._most_ns:
            error_ms, most_ms = clock.error_ns / NS_PER_MS, self._most_ns / NS_PER_MS
            return f"the system clock may be wrong by {error_ms:.1f} ms, allowed are {most_ms:g} ms"
        return ""


def make(settings: RmcSettings, _make_port: MakePort) -> SystemClockSource:
    """The source."""
    return SystemClockSource(settings)
