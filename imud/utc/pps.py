"""UTC out of a pulse per second and the sentences that say which second it was.

The kernel stamps each pulse with CLOCK_MONOTONIC; a pulse is a full second of UTC. What is kept is `UTC - MONOTONIC`
at the last 16 pulses, and a line through them: the median of all slopes between two of them (Theil-Sen), so that a
quarter of the stamps may be far off, at the height of the upper quartile, because stamps are late and never early.
Nothing of a doubtful pulse gets in:

- a pulse counts when it is a whole number of seconds after the last that did, 10 at most, each within 0.5 ms;
- three others in step with each other, but not with those, begin anew: the receiver was exchanged, or the host slept;
- the second is known when two sentences in a row give the same pulse the same second, and corrected the same way.
"""

from collections import deque
from collections.abc import Callable
from itertools import combinations, pairwise
from math import hypot
from statistics import median, quantiles
from typing import Final

from imud.contracts.timing import UtcReference
from imud.formats.rmc import Rmc, parse
from imud.units import NS_PER_S, NS_PER_US

STEP_TOLERANCE_NS: Final = 500 * NS_PER_US
"""An oscillator is within 100 ppm, an interrupt late by some hundred µs at worst."""
GAP_S_MAX: Final = 10
PULSES_NEEDED: Final = 3
PULSES_KEPT: Final = 16
SENTENCES_NEEDED: Final = 2
HOLD_NS: Final = 600 * NS_PER_S
"""After so long without a pulse UTC is not known any more."""
STAMP_NS: Final = 5 * NS_PER_US
"""One-sigma doubt about a stamp's constant delay: interrupt entry on a gateway takes some µs."""
WANDER: Final = 1e-6
"""How far the oscillator's rate may wander while no pulse comes: 1 µs each second."""
MAD_TO_SIGMA: Final = 1.4826
"""Sigma of a normal distribution over its median absolute deviation."""


class PpsReference:
    """Pulses and sentences in, UTC out. Pure. Synchronization: one thread."""

    def __init__(self, on_second: Callable[[int, int], None] | None = None) -> None:
        """`on_second(t_ns, unix_s)` is called with each pulse whose second is known, as chrony wants it."""
        self.pulses = 0
        """Pulses that counted."""
        self.pulses_ignored = 0
        self.sentences_ignored = 0
        """Sentences that were damaged, not valid, or named no pulse."""
        self._on_second = on_second
        self._stamps: deque[int] = deque(maxlen=PULSES_KEPT)
        self._seconds: deque[int] = deque(maxlen=PULSES_KEPT)
        """Seconds of the stamps, counted from any of them."""
        self._rivals: list[int] = []
        self._base_s: int | None = None
        """Unix second at which `_seconds` is 0."""
        self._claim_s: int | None = None
        """What the last sentence says `_base_s` is."""
        self._line: tuple[float, float, float] | None = None

    def pulse(self, t_ns: int) -> bool:
        """A rising edge of the pulse line at CLOCK_MONOTONIC `t_ns`; says whether it counts."""
        seconds = self._seconds_since(self._stamps[-1], t_ns) if self._stamps else 0
        if not seconds:
            return self._rival(t_ns)
        self.pulses_ignored += len(self._rivals)
        self._rivals.clear()
        self._stamps.append(t_ns)
        self._seconds.append(self._seconds[-1] + seconds)
        self._line = None
        self.pulses += 1
        if self._base_s is not None and self._on_second is not None:
            self._on_second(t_ns, self._base_s + self._seconds[-1])
        return True

    def sentence(self, sentence: bytes, t_rx_ns: int) -> None:
        """An RMC sentence that came at CLOCK_MONOTONIC `t_rx_ns`, from the receiver that makes the pulses."""
        rmc = parse(sentence)
        if not isinstance(rmc, Rmc) or not rmc.valid or not self._stamps:
            self.sentences_ignored += 1
            return
        age_ns = t_rx_ns - self._stamps[-1]
        if not rmc.fraction_ns <= age_ns < NS_PER_S:
            self.sentences_ignored += 1
            return
        base_s = rmc.unix_s - self._seconds[-1]
        if base_s == self._claim_s:
            self._base_s = base_s
        self._claim_s = base_s

    def reference(self, now_ns: int) -> UtcReference | None:
        """What is known of UTC now; None before enough pulses and sentences came, and long after the last pulse."""
        if self._base_s is None or len(self._stamps) < PULSES_NEEDED or now_ns - self._stamps[-1] > HOLD_NS:
            return None
        if self._line is None:
            self._line = self._fit()
        height_ns, slope, sigma_ns = self._line
        last_ns = self._stamps[-1]
        age_ns = max(now_ns - last_ns, 0)
        offset_ns = (self._base_s + self._seconds[-1]) * NS_PER_S - last_ns + round(height_ns + slope * age_ns)
        span_ns = last_ns - self._stamps[0]
        error_ns = hypot(STAMP_NS, sigma_ns, sigma_ns / span_ns * age_ns, WANDER * age_ns)
        return UtcReference(offset_ns, round(error_ns))

    def _fit(self) -> tuple[float, float, float]:
        """Height of the line over the last pulse's own offset (ns), slope, one-sigma spread (ns)."""
        last_ns, last_s = self._stamps[-1], self._seconds[-1]
        points = [
            (t_ns - last_ns, (second - last_s) * NS_PER_S - (t_ns - last_ns))
            for t_ns, second in zip(self._stamps, self._seconds, strict=True)
        ]
        slope = median((y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in combinations(points, 2))
        heights = [y - slope * x for x, y in points]
        middle_ns = median(heights)
        sigma_ns = MAD_TO_SIGMA * median(abs(height - middle_ns) for height in heights)
        height_ns = quantiles(heights, n=4, method="inclusive")[2]
        return height_ns, slope, hypot(sigma_ns, height_ns - middle_ns)  # what remains of the lateness is like that

    def _rival(self, t_ns: int) -> bool:
        """A pulse that is in step with none that counted; says whether enough of its like have come."""
        rivals = self._rivals
        if rivals and not self._seconds_since(rivals[-1], t_ns):
            self.pulses_ignored += len(rivals)
            rivals.clear()
        rivals.append(t_ns)
        if len(rivals) < PULSES_NEEDED:
            return False
        self._base_s = self._claim_s = self._line = None
        self._stamps = deque(rivals, PULSES_KEPT)
        self._seconds = deque([0], PULSES_KEPT)
        for before_ns, after_ns in pairwise(rivals):
            self._seconds.append(self._seconds[-1] + self._seconds_since(before_ns, after_ns))
        self.pulses += len(rivals)
        rivals.clear()
        return True

    @staticmethod
    def _seconds_since(before_ns: int, t_ns: int) -> int:
        """Whole seconds between two pulses, 0 if they are not in step."""
        seconds = round((t_ns - before_ns) / NS_PER_S)
        off_ns = abs(t_ns - before_ns - seconds * NS_PER_S)
        return seconds if 1 <= seconds <= GAP_S_MAX and off_ns <= seconds * STEP_TOLERANCE_NS else 0
