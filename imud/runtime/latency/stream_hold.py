"""The wait of a stream of bytes: samples of a device are read and published together, a latency apart.

    ── watched ──▶ a sample is complete: dated by its arrival, kept
                      └─ paused: bytes gather in the kernel ──latency──▶ one read: dated by the fit of arrivals
                                   ▲                                       │ all kept samples are published as one batch
                                   └──────────── until WATCH_NS ───────────┤
         ◀───────────────────────────────── then ──────────────────────────┘

One message in WATCH_NS, or in each round, is read as it comes, so the fit of arrivals (`imud.clock`) goes on to learn
from undelayed ones, and those that waited are dated by it. Where a message is dated by its own arrival (a device
without time, a fit that is not used yet), or by edges, pulses or UTC, nothing waits; nor does anything while a request
is unanswered.
"""

import asyncio
from collections.abc import Callable
from typing import Final

from imud.contracts.link import StreamLink
from imud.runtime.latency.budget import MOST_NS
from imud.runtime.path import StreamPath
from imud.sample import Sync
from imud.units import NS_PER_MS, NS_PER_S

GRID_NS: Final = NS_PER_MS
"""Rounds end at whole ms, so that many devices are served in one turn of the loop."""
FIRST_NS: Final = 5 * NS_PER_MS
"""The first round is so long at most, before it is seen how much gathers; each next one at most twice as long."""
WATCH_NS: Final = MOST_NS
"""Time from one message that is read as it comes to the next: as with the longest latency. Each is a wake-up more.
Behind an adapter with a latency timer it is each round: there the error of stamps would grow by half."""
PERIODS_LEAST: Final = 2
"""With fewer samples in a round nothing is saved."""


class StreamHold:
    """Receiver of a link's bytes in place of the path. Synchronization: the event loop's thread only."""

    def __init__(
        self, link: StreamLink, path: StreamPath, is_busy: Callable[[], bool], now_ns: Callable[[], int]
    ) -> None:
        """`is_busy` says whether a request of the device is unanswered."""
        self.latency_ns = 0
        """How long samples may wait; set by the owner."""
        self.hold_ns = 0
        """How long they wait at present."""
        self._link = link
        self._path = path
        self._is_busy = is_busy
        self._now_ns = now_ns
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._paused_ns = self._watch_ns = 0
        """When bytes began to gather, and when one is to be read as it comes again."""
        self._most_ns = FIRST_NS
        """Time in which no more gathers than may wait, by what gathered last."""

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Process bytes that were read as they came."""
        path = self._path
        self.hold_ns = hold_ns = self._allowed_ns()
        if not hold_ns:
            path.on_data(data, t_rx_ns)
        elif not path.gather(data, t_rx_ns):
            return
        elif path.gathered[-1].sync is not Sync.REGRESSION:
            self.hold_ns = 0
            path.publish_gathered()
        else:
            self._link.pause()
            self._watch_ns = t_rx_ns if self._link.hold_ns else t_rx_ns + WATCH_NS
            self._begin_round(t_rx_ns, hold_ns)

    def release(self) -> None:
        """Read and publish what waits now; the next samples may wait again. No-op while nothing waits."""
        self._watch_ns = 0  # publishing may have led here: no round follows
        if self._timer is not None:
            self._timer.cancel()
            self._end_round()

    def _allowed_ns(self) -> int:
        """How long samples may wait now."""
        latency_ns, path = min(self.latency_ns, self._most_ns), self._path
        if latency_ns < PERIODS_LEAST * path.period_ns or path.clock.utc_reference is not None or self._is_busy():
            return 0
        return latency_ns

    def _begin_round(self, now_ns: int, hold_ns: int) -> None:
        """Let bytes gather in the kernel from now on."""
        self._paused_ns = now_ns
        wait_ns = hold_ns - (now_ns + hold_ns) % GRID_NS
        self._timer = self._loop.call_later(wait_ns / NS_PER_S, self._end_round)

    def _end_round(self) -> None:
        self._timer = None
        link, path = self._link, self._path
        data = link.take()
        now_ns = self._now_ns()
        waited_ns = now_ns - self._paused_ns
        most_ns = 2 * self._most_ns
        if data:
            path.gather(data, now_ns, waited_ns)
            most_ns = min(most_ns, link.waiting_bytes * waited_ns // len(data))
        self._most_ns = min(max(most_ns, 1), MOST_NS)
        by_fit = bool(path.gathered) and path.gathered[-1].sync is Sync.REGRESSION
        path.publish_gathered()
        hold_ns = self._allowed_ns()
        if data and by_fit and hold_ns and now_ns + hold_ns <= self._watch_ns:
            self.hold_ns = hold_ns
            self._begin_round(now_ns, hold_ns)
        else:
            link.resume()
