"""Counts of one device: samples, bytes and losses of the last minute, restarts of the last hour, and the rate.

The rate is the number of samples between two time stamps. It does not depend on the time at which imud reads the
samples: after a pause of the event loop, many samples arrive together, and their time stamps are correct.
"""

from collections import deque
from collections.abc import Mapping
from typing import Final, NamedTuple

from imud.contracts.status import RecentStatus
from imud.model.ledger import LOST_FIELDS, Ledger
from imud.model.units import NS_PER_S

MINUTE_NS: Final = 60 * NS_PER_S
HOUR_NS: Final = 60 * MINUTE_NS
CAUSES: Final = tuple(name.removeprefix("lost_") for name in LOST_FIELDS)
RATE_WINDOW_NS: Final = 10 * NS_PER_S  # time over which imud measures the rate, ns
RATE_SECONDS: Final = RATE_WINDOW_NS // NS_PER_S + 1  # minimum number of counts in this time: one per second
SHORT_NS: Final = 2 * NS_PER_S  # time of the rate in the status, ns: two samples of a device at 1 Hz
STEADY: Final = 0.01  # maximum change of the expected rate within the window of a rate, as a share
COUNTS_MAX: Final = 64  # maximum number of stored counts: one per second for a minute
RESTARTS_MAX: Final = 60  # maximum number of stored restarts, as in `ConditionLimits.restarts`

_Lost = tuple[int, ...]  # numbers of lost samples in the order of CAUSES


class _Count(NamedTuple):
    """Counters of the ledger at one time."""

    now_ns: int  # CLOCK_MONOTONIC
    samples: int
    bytes_in: int
    lost: _Lost
    newest_ns: int  # time stamp of the newest sample, CLOCK_MONOTONIC; 0 without a sample


def _by_cause(before: _Lost, after: _Lost) -> dict[str, int]:
    """Return the numbers of samples lost between two counts, without causes with no loss."""
    return {name: now - then for name, then, now in zip(CAUSES, before, after, strict=True) if now > then}


class RecentCounts:
    """Counts of a device. Synchronization: the loop's thread only."""

    def __init__(self, ledger: Ledger, begun_ns: int, *, timed: bool) -> None:
        """`timed`: the device sends in real time. A replay can be faster, so its rate is not known."""
        self._ledger = ledger
        self._begun_ns = begun_ns
        self._timed = timed
        first = _Count(begun_ns, ledger.samples, ledger.bytes_in, ledger.losses(), 0)
        self._counts: deque[_Count] = deque([first], maxlen=COUNTS_MAX)
        self._noted_lost = first.lost  # losses that are part of the last loss, or older
        # CLOCK_MONOTONIC since which the expected rate is the same, without a gap of unknown size
        self._steady_ns = begun_ns
        self._steady_hz = 0.0  # expected rate at this time; 0.0 while the rate is not known
        self._restarts: deque[int] = deque(maxlen=RESTARTS_MAX)
        self._resets = 0
        self._loss: dict[str, int] = {}  # number of samples in the last loss by cause
        self._loss_ns = 0

    def add(self, now_ns: int, rate_hz: float, resets: int, newest_ns: int) -> bool:
        """Add the present counts. Return whether samples were lost in the last minute.

        `rate_hz`: expected rate, 0 if the device does not run; `resets`: restarts of the device that imud did not
        request; `newest_ns`: time stamp of the newest sample, 0 without a sample.
        """
        ledger, counts = self._ledger, self._counts
        self.add_new_losses(now_ns)
        counts.append(_Count(now_ns, ledger.samples, ledger.bytes_in, self._noted_lost, newest_ns))

        minute_ns = now_ns - MINUTE_NS
        while counts[1].now_ns <= minute_ns:  # one count remains before the minute
            counts.popleft()

        if abs(rate_hz - self._steady_hz) > STEADY * self._steady_hz:
            self._steady_ns = now_ns
            self._steady_hz = rate_hz
        if resets != self._resets or self._restarts:
            self._add_restarts(now_ns, resets)
        return counts[0].lost != self._noted_lost

    def add_new_losses(self, now_ns: int) -> bool:
        """Add the losses of the ledger since the last call to the last loss. Return whether there were losses."""
        lost = self._ledger.losses()
        if lost == self._noted_lost:
            return False
        self._add_loss(now_ns, _by_cause(self._noted_lost, lost))
        self._noted_lost = lost
        return True

    def _add_loss(self, now_ns: int, lost: Mapping[str, int]) -> None:
        """Add a loss to the last loss, or start the next loss."""
        self._loss = {} if now_ns - self._loss_ns > MINUTE_NS else self._loss
        self._loss_ns = now_ns
        for name, count in lost.items():
            self._loss[name] = self._loss.get(name, 0) + count
        if "unknown" in lost:
            self._steady_ns = now_ns

    def _add_restarts(self, now_ns: int, resets: int) -> None:
        """Add the restarts since the last call, and forget restarts that are older than one hour."""
        self._restarts.extend([now_ns] * min(max(resets - self._resets, 0), RESTARTS_MAX))
        self._resets = resets
        while self._restarts and self._restarts[0] <= now_ns - HOUR_NS:
            self._restarts.popleft()

    def status(self, last_sample_ns: int) -> RecentStatus:
        """Return the counts at this moment. The losses are equal to the losses of the ledger."""
        first = self._counts[0]
        causes = _by_cause(first.lost, self._noted_lost)
        gaps = causes.pop("unknown", 0)
        known = dict(self._loss)
        known.pop("unknown", 0)
        return RecentStatus(
            begun_ns=self._begun_ns,
            rate_hz=self.steady_rate_hz(),
            samples=self._ledger.samples - first.samples,
            lost=causes,
            gaps=gaps,
            bytes_in=self._ledger.bytes_in - first.bytes_in,
            restarts=len(self._restarts),
            last_sample_ns=last_sample_ns,
            loss_ns=self._loss_ns,
            loss_samples=sum(known.values()),
            loss_cause=max(known, key=lambda name: known[name], default=""),
        )

    def rate_hz(self) -> float:
        """Return the rate of received samples over the last SHORT_NS; 0.0 without two counts."""
        last = self._counts[-1]
        first = next((count for count in reversed(self._counts) if count.now_ns <= last.now_ns - SHORT_NS), None)
        first = first or self._counts[0]
        span_ns = last.now_ns - first.now_ns
        return (last.samples - first.samples) * NS_PER_S / span_ns if span_ns > 0 else 0.0

    def _count_before(self, time_ns: int) -> _Count | None:
        """Return the newest count that is not after a time; None without such a count."""
        counts = self._counts
        index = len(counts) - RATE_SECONDS
        while index >= 0 and counts[index].now_ns > time_ns:
            index -= 1
        return counts[index] if index >= 0 else None

    def steady_rate_hz(self) -> float | None:
        """Return the rate of received and lost samples by their time stamps.

        None without a steady rate, without two samples, or after a gap of unknown size.
        """
        last = self._counts[-1]
        if not self._steady_hz or not self._timed or last.now_ns - self._steady_ns < RATE_WINDOW_NS:
            return None
        first = self._count_before(last.now_ns - RATE_WINDOW_NS)
        if first is None or first.now_ns < self._steady_ns:
            return None
        span_ns = last.newest_ns - first.newest_ns
        if not first.newest_ns or span_ns <= 0:
            return None
        return (last.samples - first.samples + sum(last.lost) - sum(first.lost)) * NS_PER_S / span_ns
