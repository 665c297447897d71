"""State, problem and events of a device. The status shows the state and the problem.

A lasting problem of the link (for example an error-passive CAN bus) stays in the status while samples arrive.
"""

import logging
from collections.abc import Callable, Mapping
from typing import Final

from imud.contracts.codec import BadFrame, wrong_length_words
from imud.contracts.status import DeviceState
from imud.host.log import MESSAGE_CHARACTERS_MAX, printable, same_as
from imud.model.event import LEVELS, Event, EventKind
from imud.model.ledger import Ledger
from imud.model.sample import Sync
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

INTERVAL_NS = NS_PER_S  # minimum interval of loss events and of bad-frame events, ns
RAW_SHOWN_BYTES = 32  # maximum number of bytes of a bad frame in an event


class DeviceEvents:
    """Events of one device: `raise_event` sends an event immediately, `tick` sends the events of counters."""

    def __init__(self, device: str, ledger: Ledger, send: Callable[[Event], None]) -> None:
        self.device = device  # name in the configuration
        self._ledger = ledger
        self._send = send
        self._due_ns = 0
        self._counts: tuple[int, ...] = ()  # counters of the last report
        self._lost = 0
        self._bad = 0
        self._last_bad: BadFrame | None = None
        self._wrong_length: BadFrame | None = None
        self._sync: Sync | None = None

    def raise_event(
        self, now_ns: int, kind: EventKind, message: str, /, **detail: str | int | float | bool | None
    ) -> None:
        """Log and send an event. Replace unprintable characters, because a device can send any text."""
        self.report(LEVELS.get(kind, logging.WARNING), now_ns, kind, message, detail)

    def report(
        self, level: int, now_ns: int, kind: EventKind, message: str,
        detail: Mapping[str, str | int | float | bool | None],
    ) -> None:  # fmt: skip
        """Log and send an event as `raise_event`, at `level`: INFO for a change that a user requested."""
        message = printable(message, MESSAGE_CHARACTERS_MAX)
        texts = {name: printable(one) if isinstance(one, str) else one for name, one in detail.items()}
        alike = same_as(kind if kind is EventKind.BAD_FRAME else message)  # the bytes of each damaged frame differ
        log.log(level, "%s: %s", self.device, message, extra=alike)
        self._send(Event(now_ns, self.device, kind, message, texts))

    def bad_frame(self, frame: BadFrame) -> None:
        """Note a damaged frame. The next event shows the newest frame."""
        self._last_bad = frame
        if frame.can_id is not None:
            self._wrong_length = frame

    def wrong_length_words(self) -> str:
        """Describe the CAN frames of a wrong length; empty without such a frame."""
        return wrong_length_words(self._ledger, self._wrong_length)

    def tick(self, now_ns: int, sync: Sync | None) -> None:
        """Send the events of the counters since the previous interval."""
        if sync is not None and sync is not self._sync:
            self._report_sync(now_ns, sync)
        ledger = self._ledger
        if (counts := ledger.troubles()) == self._counts or now_ns < self._due_ns:
            return
        self._counts = counts
        troubled = ledger.frames_bad() + ledger.frames_not_finite
        lost, bad = ledger.lost() - self._lost, troubled - self._bad
        if lost:
            self.raise_event(now_ns, EventKind.LOSS, _counted(lost, "sample") + " lost", **self._causes())
        if bad and self._last_bad is not None:
            frame = self._last_bad
            shown = frame.raw[:RAW_SHOWN_BYTES].hex(" ")
            of = "" if frame.can_id is None else f" of CAN identifier {frame.can_id:03X}"
            self.raise_event(
                now_ns,
                EventKind.BAD_FRAME,
                f"{_counted(bad, 'bad frame')}, the last by {frame.reason}{of}: {shown}",
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


NO_SAMPLE = "no sample for"
"""Start of the problem of a device that stopped sending."""
SEARCH_BEGUN = "no sample has arrived yet; wait for the search"
"""Problem of a device right after imud has opened its link."""
RUNNING: Final = DeviceState.RUNNING  # a name of its own, because Python 3.11 looks up members of an enum slowly
STREAMING = (DeviceState.RUNNING, DeviceState.SILENT)


class Health:
    """State and problem of one device. All times are CLOCK_MONOTONIC in ns. Synchronization: the loop's thread only."""

    def __init__(self, events: DeviceEvents) -> None:
        self.state = DeviceState.MISSING
        self.problem = ""  # present problem, one sentence; empty if there is none
        self.silent_since_ns = 0  # CLOCK_MONOTONIC of the last change to SILENT, ns
        self.link_problem = ""  # present problem of a link that still works; empty if there is none
        self._events = events

    @property
    def streaming(self) -> bool:
        """Whether imud has found the device and its link is open."""
        return self.state in STREAMING

    def link_opened(self) -> None:
        """Clear the problem after the link was opened."""
        self.problem = self.link_problem = ""

    def searching(self) -> None:
        """Enter SEARCHING. The problem stays in the status until imud finds the device."""
        self.state = DeviceState.SEARCHING
        self.problem = self.problem or SEARCH_BEGUN

    def finished(self, problem: str) -> None:
        """Enter FINISHED after the end of a replay. `problem`: reason for no sample, after a link problem."""
        self.state, self.problem = DeviceState.FINISHED, self.link_problem or problem

    def up(self, now_ns: int, driver: str, where: str, bit_rate: int) -> None:
        """Enter RUNNING: samples of `driver` arrive on the link `where`."""
        self.state, self.problem = DeviceState.RUNNING, self.link_problem
        self._events.raise_event(now_ns, EventKind.UP, f"{driver} on {where}", driver=driver, baud=bit_rate)

    def down(self, now_ns: int, state: DeviceState, problem: str) -> None:
        """Enter a state without samples, because of `problem`."""
        problem = printable(problem, MESSAGE_CHARACTERS_MAX)
        if state is DeviceState.SILENT:
            problem = self.link_problem or problem
            self.silent_since_ns = now_ns
        was_up, changed = self.streaming, state is not self.state or problem != self.problem
        self.state, self.problem = state, problem
        if was_up:
            self._events.raise_event(now_ns, EventKind.DOWN, problem, state=str(state))
        elif changed:
            log.warning("%s: %s", self._events.device, problem, extra=same_as(problem))

    def missing(self, now_ns: int, reason: str) -> None:
        """Enter MISSING if `reason` is not empty. The first problem stays in the status until the link returns."""
        if reason and not (self.state is DeviceState.MISSING and self.problem):
            self.down(now_ns, DeviceState.MISSING, reason)

    def report(self, problem: str) -> None:
        """Set the problem without a change of state. A problem of the link has priority."""
        problem = self.link_problem or printable(problem, MESSAGE_CHARACTERS_MAX)
        if problem != self.problem:
            log.warning("%s: %s", self._events.device, problem, extra=same_as(problem))
        self.problem = problem

    def clear_link_problem(self, problem: str) -> None:
        """Show a problem of `on_link_news` no longer, unless another problem has replaced it."""
        if self.link_problem == problem:
            self.link_problem = ""
        if self.problem == problem:
            self.problem = ""

    def on_link_news(self, now_ns: int, news: str, problem: str) -> None:
        """Raise an event about a change of the link. `problem` is the problem after the change."""
        self.link_problem = self.problem = printable(problem, MESSAGE_CHARACTERS_MAX)
        self._events.raise_event(now_ns, EventKind.LINK, news, problem=problem)
