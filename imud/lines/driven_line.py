"""Output line that imud keeps open for an output. It opens the line again after a failure."""

from contextlib import suppress

from imud.contracts.lines import DriveLine, DrivenOutput, LineFactory, OutputLine, OutputOptions
from imud.host.clock import HostClock
from imud.lines.watched_line import RETRY_NS
from imud.model.errors import LinkError


class DrivenLine:
    """Output line that imud keeps open. Synchronization: the event loop's thread only."""

    def __init__(self, line: OutputLine, host: HostClock) -> None:
        self.problem = "not open yet"
        self._line, self._host = line, host
        self._is_open = self._active = False
        self._due_ns = 0

    def tick(self, now_ns: int) -> None:
        """Open the line if an attempt is due, and set its level."""
        if self._is_open or now_ns < self._due_ns:
            return
        try:
            self._line.open()
        except LinkError as error:
            self._fail(error)
            return
        self._is_open, self.problem = True, ""
        if self._active:
            self.set(True)

    def set(self, active: bool) -> None:
        """Set the level, now or after the line is open."""
        self._active = active
        if self._is_open:
            try:
                self._line.set(active)
            except LinkError as error:
                self._fail(error)

    def close(self) -> None:
        """Make the line inactive and release it. A second call does nothing."""
        self._is_open = self._active = False
        self._line.close()

    def _fail(self, error: LinkError) -> None:
        self._is_open, self.problem = False, str(error)
        self._due_ns = self._host.now_ns() + RETRY_NS
        with suppress(LinkError):
            self._line.close()


def driving(lines: LineFactory, host: HostClock) -> DriveLine:
    """Return a function that keeps output lines open that belong to no device."""

    def drive(settings: OutputOptions, purpose: str) -> DrivenOutput:
        return DrivenLine(lines.make_output(settings, purpose), host)

    return drive
