"""State and present problem of a device: shown in its status, logged, raised as events UP and DOWN.

Trouble of a link that goes on (a CAN bus that is error-passive) stays shown while samples flow, and explains why none
come.
"""

import logging

from imud.contracts.status import DeviceState
from imud.event import EventKind
from imud.log import MESSAGE_CHARACTERS_MAX, printable, same_as
from imud.runtime.notices import Notices

log = logging.getLogger(__name__)

SEARCH_BEGUN = "no sample has come yet: wait until the search has listened for a while"
"""The problem of a device whose link was opened just now."""
STREAMING = (DeviceState.RUNNING, DeviceState.SILENT)


class Health:
    """State and problem of one device; all times are CLOCK_MONOTONIC in ns. Synchronization: the loop's thread only."""

    def __init__(self, notices: Notices) -> None:
        self.state = DeviceState.MISSING
        self.problem = ""
        """Present fault, one sentence; empty for none."""
        self.silent_since_ns = 0
        """CLOCK_MONOTONIC when the state became SILENT."""
        self.link_problem = ""
        """Present fault of a link that still works; empty for none."""
        self._notices = notices

    @property
    def streaming(self) -> bool:
        """Whether the device was found and its link is there."""
        return self.state in STREAMING

    def link_opened(self) -> None:
        """Clear the problem: the link is open."""
        self.problem = self.link_problem = ""

    def searching(self) -> None:
        """Enter SEARCHING; the problem stays shown until a device is found."""
        self.state = DeviceState.SEARCHING
        self.problem = self.problem or SEARCH_BEGUN

    def finished(self) -> None:
        """Enter FINISHED: a replay came to its end."""
        self.state, self.problem = DeviceState.FINISHED, ""

    def up(self, now_ns: int, driver: str, where: str, bit_rate: int) -> None:
        """Enter RUNNING: samples of `driver` come on the link `where`."""
        self.state, self.problem = DeviceState.RUNNING, self.link_problem
        self._notices.raise_event(now_ns, EventKind.UP, f"{driver} on {where}", driver=driver, baud=bit_rate)

    def down(self, now_ns: int, state: DeviceState, problem: str) -> None:
        """Enter a state in which no samples come, for the reason `problem`."""
        problem = printable(problem, MESSAGE_CHARACTERS_MAX)
        if state is DeviceState.SILENT:
            problem = self.link_problem or problem
            self.silent_since_ns = now_ns
        was_up, changed = self.streaming, state is not self.state or problem != self.problem
        self.state, self.problem = state, problem
        if was_up:
            self._notices.raise_event(now_ns, EventKind.DOWN, problem, state=str(state))
        elif changed:
            log.warning("%s: %s", self._notices.device, problem, extra=same_as(problem))

    def missing(self, now_ns: int, reason: str) -> None:
        """Enter MISSING for `reason`, empty for a link that is there; how a link went stays shown until it is back."""
        if reason and not (self.state is DeviceState.MISSING and self.problem):
            self.down(now_ns, DeviceState.MISSING, reason)

    def report(self, problem: str) -> None:
        """Show what is wrong while the state stays; trouble of the link takes precedence."""
        problem = self.link_problem or printable(problem, MESSAGE_CHARACTERS_MAX)
        if problem != self.problem:
            log.warning("%s: %s", self._notices.device, problem, extra=same_as(problem))
        self.problem = problem

    def on_link_news(self, now_ns: int, news: str, problem: str) -> None:
        """Raise an event: the state of the link changed, and `problem` is what is wrong with it from now on."""
        self.link_problem = self.problem = printable(problem, MESSAGE_CHARACTERS_MAX)
        self._notices.raise_event(now_ns, EventKind.LINK, news, problem=problem)
