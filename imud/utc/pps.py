"""UTC from a pulse per second and from RMC sentences, which contain the second of a pulse.

A pulse is the start of a second of UTC. The kernel time-stamps it with CLOCK_MONOTONIC. A line is fitted to UTC minus
CLOCK_MONOTONIC at the last 16 pulses. Its slope is the median of the slopes between all pairs (Theil-Sen), so that a
quarter of the time stamps can be outliers. Its height is the upper quartile, because time stamps are late and never
early. imud rejects these pulses:

- A pulse is accepted if it follows the previous accepted pulse by 1 to 10 whole seconds, within 0.5 ms per second.
- Three rejected pulses with whole seconds between them restart the fit: another receiver, or a suspend of the host.
- The second of a pulse is known after two consecutive sentences with the same second. It is corrected in the same way.
"""

from collections import deque
from itertools import combinations, pairwise
from math import hypot
from statistics import median, quantiles
from typing import Final

from imud.contracts.lines import UtcReference
from imud.formats.nmea0183 import Rmc, parse
from imud.model.units import NS_PER_S, NS_PER_US

# maximum error of a second between pulses, ns: 100 ppm of the oscillators, and some hundred µs of interrupt delay
STEP_TOLERANCE_NS: Final = 500 * NS_PER_US
GAP_S_MAX: Final = 10
PULSES_NEEDED: Final = 3
PULSES_KEPT: Final = 16
HOLD_NS: Final = 600 * NS_PER_S  # time after the last pulse until UTC is unknown, ns
# One-sigma error of the constant delay of time stamps, ns. The entry of an interrupt needs some µs.
STAMP_NS: Final = 5 * NS_PER_US
WANDER: Final = 1e-6  # change of the oscillator's rate without pulses: 1 µs per second
MAD_TO_SIGMA: Final = 1.4826  # ratio of sigma to the median absolute deviation of a normal distribution


class PpsReference:
    """Estimator of UTC from pulses and sentences. Synchronization: one thread."""

    def __init__(self) -> None:
        self.pulses = 0  # number of accepted pulses
        self.pulses_ignored = 0
        self.sentences_ignored = 0  # number of sentences that were damaged, invalid, or matched no pulse
        self._stamps: deque[int] = deque(maxlen=PULSES_KEPT)
        self._seconds: deque[int] = deque(maxlen=PULSES_KEPT)  # seconds of the time stamps, from an arbitrary start
        self._candidates: list[int] = []
        self._base_s: int | None = None  # unix second of `_seconds` 0
        self._claim_s: int | None = None  # `_base_s` according to the last sentence
        self._fit: tuple[float, float, float] | None = None

    def on_pulse(self, t_ns: int) -> bool:
        """Add a rising edge of PPS at CLOCK_MONOTONIC `t_ns`. Return whether the pulse is accepted."""
        seconds = self._seconds_since(self._stamps[-1], t_ns) if self._stamps else 0
        if not seconds:
            return self._add_candidate(t_ns)
        self.pulses_ignored += len(self._candidates)
        self._candidates.clear()
        self._stamps.append(t_ns)
        self._seconds.append(self._seconds[-1] + seconds)
        self._fit = None
        self.pulses += 1
        return True

    @property
    def second_s(self) -> int | None:
        """Unix second that the newest accepted pulse starts; None if it is unknown."""
        return None if self._base_s is None else self._base_s + self._seconds[-1]

    def on_sentence(self, sentence: bytes, t_rx_ns: int) -> None:
        """Add an RMC sentence of the receiver of the pulses. `t_rx_ns` is CLOCK_MONOTONIC at its arrival."""
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
        """Return the estimate at `now_ns`; None before enough pulses and sentences, or HOLD_NS after the last pulse."""
        if self._base_s is None or len(self._stamps) < PULSES_NEEDED or now_ns - self._stamps[-1] > HOLD_NS:
            return None
        if self._fit is None:
            self._fit = self._fit_line()
        height_ns, slope, sigma_ns = self._fit
        last_ns = self._stamps[-1]
        age_ns = max(now_ns - last_ns, 0)
        offset_ns = (self._base_s + self._seconds[-1]) * NS_PER_S - last_ns + round(height_ns + slope * age_ns)
        span_ns = last_ns - self._stamps[0]
        error_ns = hypot(STAMP_NS, sigma_ns, sigma_ns / span_ns * age_ns, WANDER * age_ns)
        return UtcReference(offset_ns, round(error_ns))

    def _fit_line(self) -> tuple[float, float, float]:
        """Return (height of the line above the offset of the last pulse, ns; slope; one-sigma spread, ns)."""
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
        return height_ns, slope, hypot(sigma_ns, height_ns - middle_ns)  # the remaining delay is about as large

    def _add_candidate(self, t_ns: int) -> bool:
        """Add a rejected pulse. Return whether the rejected pulses replace the accepted pulses."""
        candidates = self._candidates
        if candidates and not self._seconds_since(candidates[-1], t_ns):
            self.pulses_ignored += len(candidates)
            candidates.clear()
        candidates.append(t_ns)
        if len(candidates) < PULSES_NEEDED:
            return False
        self._base_s = self._claim_s = self._fit = None
        self._stamps = deque(candidates, PULSES_KEPT)
        self._seconds = deque([0], PULSES_KEPT)
        for before_ns, after_ns in pairwise(candidates):
            self._seconds.append(self._seconds[-1] + self._seconds_since(before_ns, after_ns))
        self.pulses += len(candidates)
        candidates.clear()
        return True

    @staticmethod
    def _seconds_since(before_ns: int, t_ns: int) -> int:
        """Return the whole seconds between two pulses; 0 if the time is not a whole number of seconds."""
        seconds = round((t_ns - before_ns) / NS_PER_S)
        off_ns = abs(t_ns - before_ns - seconds * NS_PER_S)
        return seconds if 1 <= seconds <= GAP_S_MAX and off_ns <= seconds * STEP_TOLERANCE_NS else 0
