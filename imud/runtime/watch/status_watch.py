"""Watch over the status bits of one device's samples: a bit that means trouble is an event when it is set, and cleared.

The path gathers the bits of all samples, so that one that is set in a single sample is not missed. Events are bounded:
one in INTERVAL_NS, with all changes since the last one; a bit counts as cleared when no sample had it for CLEAR_NS.
"""

from collections.abc import Mapping
from typing import Final

from imud.contracts.driver import Driver, StatusBit
from imud.event import EventKind
from imud.runtime.notices import Notices
from imud.runtime.path import SamplePath
from imud.units import NS_PER_S

CLEAR_NS: Final = NS_PER_S
INTERVAL_NS: Final = NS_PER_S


class StatusWatch:
    """State of the notable status bits of one device. Synchronization: the loop's thread only."""

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._path: SamplePath | None = None
        self._bits: Mapping[int, StatusBit] = {}
        self._set = 0
        """Bits that are reported as set."""
        self._seen_ns: dict[int, int] = {}
        """CLOCK_MONOTONIC of the newest sample with a bit."""
        self._due_ns = 0

    def tick(self, now_ns: int, driver: Driver | None, path: SamplePath | None) -> None:
        """Look at the samples since the last call, and raise an event for what changed. Call it at 10 Hz."""
        if driver is None or path is None:
            return
        if path is not self._path:
            self._begin(driver, path)
        if not self._bits:
            return
        seen = path.take_status()
        for number in self._bits:
            if seen >> number & 1:
                self._seen_ns[number] = now_ns
        if now_ns >= self._due_ns:
            self._report(now_ns, is_silent=now_ns - path.last_sample_ns > CLEAR_NS)

    def _begin(self, driver: Driver, path: SamplePath) -> None:
        """Watch another path: that of another driver."""
        self._path = path
        self._bits = {number: bit for number, bit in driver.status_bits.items() if bit.notable}
        path.watch_status(sum(1 << number for number in self._bits))
        self._set = 0
        self._seen_ns.clear()

    def _report(self, now_ns: int, *, is_silent: bool) -> None:
        """Raise one event for all bits that changed; while no samples come, nothing changes."""
        risen = [n for n in self._bits if not self._set >> n & 1 and n in self._seen_ns]
        fallen = [n for n in self._bits if self._set >> n & 1 and now_ns - self._seen_ns[n] > CLEAR_NS]
        if is_silent or not (risen or fallen):
            return
        for number in fallen:
            del self._seen_ns[number]
        self._set ^= sum(1 << number for number in (*risen, *fallen))
        self._due_ns = now_ns + INTERVAL_NS
        words = [self._bits[n].name for n in risen] + [f"cleared: {self._bits[n].name}" for n in fallen]
        detail = {self._bits[n].name: n in risen for n in (*risen, *fallen)}
        self._notices.raise_event(now_ns, EventKind.ALARM, f"status: {', '.join(words)}", **detail)
