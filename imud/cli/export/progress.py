"""The bar of an export on a terminal: how much of the file is read, how many samples came, how long it takes yet."""

import shutil
import sys
from collections.abc import Callable
from time import monotonic
from typing import Final, TextIO

EVERY_S: Final = 0.2
"""Time between two pictures."""
LOOK_SAMPLES: Final = 2000
"""Samples between two looks at the clock, which is 20 ms or so."""
BAR: Final = 24
"""Characters of the bar."""
CLEAR: Final = "\r\x1b[K"


class Progress:
    """The bar. It is nothing where standard error is no terminal."""

    def __init__(self, size_bytes: int, out: TextIO | None = None, now_s: Callable[[], float] = monotonic) -> None:
        """`size_bytes` is that of the whole file."""
        out = sys.stderr if out is None else out
        self._out = out if out.isatty() else None
        self._size = max(size_bytes, 1)
        self._now_s = now_s
        self._begun_s = self._due_s = now_s()
        self._looked = 0
        self.samples = 0
        """Samples so far."""

    @property
    def spent_s(self) -> float:
        """Time since the begin."""
        return self._now_s() - self._begun_s

    def add(self, samples: int, position: Callable[[], int]) -> None:
        """Count samples, and draw if it is time; `position` says how many bytes are read."""
        self.samples += samples
        if self._out is None or self.samples < self._looked + LOOK_SAMPLES:
            return
        self._looked = self.samples
        now_s = self._now_s()
        if now_s >= self._due_s:
            self._due_s = now_s + EVERY_S
            self._draw(position(), now_s - self._begun_s)

    def close(self) -> None:
        """Remove the bar; may be called twice."""
        if self._out is not None:
            self._out.write(CLEAR)
            self._out.flush()
            self._out = None

    def _draw(self, read_bytes: int, spent_s: float) -> None:
        assert self._out is not None
        share = min(read_bytes / self._size, 1.0)
        full = int(share * BAR)
        left = f", {spent_s / share - spent_s:.0f} s left" if share > 0.02 else ""
        text = f"[{'#' * full}{'.' * (BAR - full)}] {100 * share:3.0f} %  {self.samples} samples{left}"
        self._out.write(CLEAR + text[: shutil.get_terminal_size().columns - 1])
        self._out.flush()
