"""Request and reply over a line that also carries samples, without I/O: text in, outcomes out, time as an argument.

A dialogue of several requests is a generator (`Conversation`): it yields a `Request` and is sent the `Outcome`. The
same generator is driven by the daemon's event loop, by a blocking probe, and by a test.
"""

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from imud.errors import CommandError
from imud.ledger import Ledger
from imud.units import NS_PER_S

T = TypeVar("T")

REPLY_LINES_MAX = 256
"""No reply of either manual has more than some dozens of lines; more means that its end was lost."""
LATE_WINDOW_NS = 5 * NS_PER_S
"""Text up to this long after a time-out is taken for the late reply to the request that timed out."""


@dataclass(frozen=True, slots=True)
class Request:
    """One command, ready to send, with what its reply looks like."""

    payload: bytes
    """Bytes for the wire."""
    name: str
    """The command as people write it, for messages."""
    is_end: Callable[[str], bool]
    """Whether this line ends the reply well."""
    is_rejection: Callable[[str], bool]
    """Whether this line ends the reply badly."""
    is_part: Callable[[str], bool]
    """Whether this line can belong to the reply; others are text of some other origin."""
    timeout_ns: int = NS_PER_S // 2
    silent: bool = False
    """The device never answers this one (it reboots, say): it is done once sent."""
    lines_min: int = 1
    """Fewest lines of a good reply, end line included: an end that comes sooner is that of an earlier, late reply."""


@dataclass(frozen=True, slots=True)
class Reply:
    """The device answered: the lines, end line included."""

    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Rejection:
    """The device refused: the lines, the refusing line last."""

    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Silence:
    """No complete reply came before the deadline; `lines` is the part that did."""

    lines: tuple[str, ...]


Outcome = Reply | Rejection | Silence
Conversation = Generator[Request, Outcome, T]


class TextSession:
    """One outstanding request at a time; late replies are told from fresh ones and counted.

    Devices answer in the order they were asked. A line is late when it can belong to the request that timed out and
    not to the outstanding one, or when it ends a reply whose lines were late. Two requests whose replies are the end
    line alone cannot be told apart: there the first end line counts for the outstanding one.

    Synchronization: one thread. The owner sends `start()`'s bytes, passes every text line to `on_line()`, and calls
    `on_time()` at `deadline_ns`.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._request: Request | None = None
        self._lines: deque[str] = deque(maxlen=REPLY_LINES_MAX)
        self._timed_out: Request | None = None
        self._timed_out_ns = 0
        self._late_lines = 0
        """Lines of the late reply that is just arriving."""
        self.deadline_ns: int | None = None
        """When the outstanding request times out (CLOCK_MONOTONIC), or None."""

    @property
    def busy(self) -> bool:
        """Whether a request is outstanding."""
        return self._request is not None

    def start(self, request: Request, now_ns: int) -> bytes:
        """Make `request` the outstanding one and return its bytes. Raises CommandError when one is outstanding."""
        if self._request is not None:
            raise CommandError(f"{request.name}: still waiting for the reply to {self._request.name}")
        self._lines.clear()
        if not request.silent:
            self._request = request
            self.deadline_ns = now_ns + request.timeout_ns
        return request.payload

    def on_line(self, text: str, now_ns: int) -> Outcome | None:
        """Take one line; return the outcome when it ends the outstanding request."""
        request = self._request
        if request is None or not self._belongs(request, text) or self._ends_late(request, text, now_ns):
            self._count_stray(text, now_ns)
            return None
        self._late_lines = 0
        self._lines.append(text)
        if request.is_rejection(text):
            return self._finish(Rejection)
        if request.is_end(text):
            return self._finish(Reply)
        return None

    def on_time(self, now_ns: int) -> Silence | None:
        """Return `Silence` when the deadline has passed."""
        if self._request is None or self.deadline_ns is None or now_ns < self.deadline_ns:
            return None
        self._timed_out, self._timed_out_ns = self._request, now_ns
        self._late_lines = len(self._lines)
        self._request = self.deadline_ns = None
        return Silence(tuple(self._lines))

    def cancel(self) -> None:
        """Forget the outstanding request: the link is gone."""
        self._request = self.deadline_ns = None
        self._lines.clear()

    def _belongs(self, request: Request, text: str) -> bool:
        return _ends(request, text) or request.is_part(text)

    def _ends_late(self, request: Request, text: str, now_ns: int) -> bool:
        """Whether `text` is an end line, but not that of the outstanding request: its own lines have not come."""
        if not _ends(request, text) or self._lines:
            return False
        late_is_arriving = self._late_lines > 0 and self._expects_late(now_ns)
        return late_is_arriving or (request.is_end(text) and request.lines_min > 1)

    def _expects_late(self, now_ns: int) -> bool:
        return self._timed_out is not None and now_ns - self._timed_out_ns <= LATE_WINDOW_NS

    def _finish(self, outcome: type[Reply] | type[Rejection]) -> Reply | Rejection:
        self._request = self.deadline_ns = None
        return outcome(tuple(self._lines))

    def _count_stray(self, text: str, now_ns: int) -> None:
        late = self._timed_out
        if late is None or not self._expects_late(now_ns) or not self._belongs(late, text):
            self._ledger.replies_unsolicited += 1
            return
        self._late_lines += 1
        if _ends(late, text):
            self._ledger.replies_late += 1
            self._timed_out = None
            self._late_lines = 0


def _ends(request: Request, text: str) -> bool:
    return request.is_end(text) or request.is_rejection(text)
