"""Runs the detection on an open CAN link: hands on frames, keeps its time."""

from collections.abc import Callable, Sequence
from typing import Final

from imud.errors import NothingHeard
from imud.formats.can import CanFilter, CanFrame
from imud.ledger import Ledger
from imud.runtime.detection import CanDevice, CanFound, CanListen, CanSearch, CanStep
from imud.runtime.detection.round import SearchRound

EVERYTHING: Final = (CanFilter(0, 0, False), CanFilter(0, 0, True))
"""Filters that pass every data frame."""


class CanFinder(SearchRound):
    """One round. `on_found` is called inside the callback that completed it. Synchronization: the loop's thread."""

    def __init__(self, search: CanSearch, ledger: Ledger, on_found: Callable[[CanDevice], None]) -> None:
        super().__init__()
        self._search = search
        self._ledger = ledger
        self._on_found = on_found

    def start(self) -> None:
        """Begin; from now on frames go to `take`."""
        self._follow(self._search.start(self._now_ns()))

    def take(self, frames: Sequence[CanFrame]) -> None:
        """Frames from the link, all of the bus; they count as skipped."""
        size = sum(len(frame.data) for frame in frames)
        self._ledger.bytes_in += size
        self._ledger.bytes_skipped += size
        if not self._done.done():
            self._follow(self._search.on_frames(frames))

    def _at_time(self) -> bool:
        step = self._search.on_time(self._now_ns())
        self._follow(step)
        return step is not None

    def _follow(self, step: CanStep | None) -> None:
        if isinstance(step, CanListen):
            self._wait_until(step.until_ns)
        elif isinstance(step, CanFound):
            self._done.set_result(None)
            self._on_found(step.device)
        elif step is not None:
            self._done.set_exception(NothingHeard(step.summary))
