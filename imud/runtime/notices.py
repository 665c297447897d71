"""Events from counters, at a bounded rate: a line full of noise must not flood the subscribers."""

import logging
from collections.abc import Callable

from imud.contracts.codec import BadFrame
from imud.event import LEVELS, Event, EventKind
from imud.ledger import Ledger
from imud.log import MESSAGE_CHARACTERS_MAX, printable, same_as
from imud.sample import Sync
from imud.units import NS_PER_S

log = logging.getLogger(__name__)

INTERVAL_NS = NS_PER_S
"""At most one loss and one bad-frame event a second and device."""
RAW_SHOWN_BYTES = 32


class Notices:
    """Events of one device: `raise_event` sends one at once, `tick` those of counters."""

    def __init__(self, device: str, ledger: Ledger, send: Callable[[Event], None]) -> None:
        self.device = device
        """Name in the configuration."""
        self._ledger = ledger
        self._send = send
        self._due_ns = 0
        self._lost = 0
        self._bad = 0
        self._last_bad: BadFrame | None = None
        self._sync: Sync | None = None

    def raise_event(
        self, now_ns: int, kind: EventKind, message: str, /, **detail: str | int | float | bool | None
    ) -> None:
        """Send one event, and log it; texts that came from the device may hold anything, and are made printable."""
        message = printable(message, MESSAGE_CHARACTERS_MAX)
        detail = {name: printable(one) if isinstance(one, str) else one for name, one in detail.items()}
        alike = same_as(kind if kind is EventKind.BAD_FRAME else message)  # the bytes of a damaged frame always differ
        log.log(LEVELS.get(kind, logging.WARNING), "%s: %s", self.device, message, extra=alike)
        self._send(Event(now_ns, self.device, kind, message, detail))

    def bad_frame(self, frame: BadFrame) -> None:
        """Note a damaged frame; the newest one is shown in the next event."""
        self._last_bad = frame

    def tick(self, now_ns: int, sync: Sync | None) -> None:
        """Send the events gathered since the last interval."""
        if sync is not None and sync is not self._sync:
            self._report_sync(now_ns, sync)
        if now_ns < self._due_ns:
            return
        ledger = self._ledger
        troubled = ledger.frames_bad() + ledger.frames_not_finite
        lost, bad = ledger.lost() - self._lost, troubled - self._bad
        if lost:
            self.raise_event(now_ns, EventKind.LOSS, _counted(lost, "sample") + " lost", **self._causes())
        if bad and self._last_bad is not None:
            frame = self._last_bad
            shown = frame.raw[:RAW_SHOWN_BYTES].hex(" ")
            self.raise_event(
                now_ns,
                EventKind.BAD_FRAME,
                f"{_counted(bad, 'bad frame')}, the last by {frame.reason}: {shown}",
                count=bad,
            )
        self._lost, self._bad = ledger.lost(), troubled
        if lost or bad:
            self._due_ns = now_ns + INTERVAL_NS

    def _causes(self) -> dict[str, int]:
        ledger = self._ledger
        return {
            "gap_device": ledger.lost_gap_device,
            "crc": ledger.lost_crc,
            "overrun": ledger.lost_overrun,
            "queue": ledger.lost_queue,
        }

    def _report_sync(self, now_ns: int, sync: Sync) -> None:
        before, self._sync = self._sync, sync
        if before is not None:
            self._send(Event(now_ns, self.device, EventKind.SYNC, f"time stamps by {sync}, were by {before}",
                             {"sync": str(sync), "before": str(before)}))  # fmt: skip


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
