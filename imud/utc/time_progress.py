"""Comparison of the times in sentences with the progress of CLOCK_MONOTONIC.

UTC minus CLOCK_MONOTONIC of a correct receiver is constant, apart from the delays of its sentences and the drift of the
host's oscillator. A time that leaps is wrong: a hostile or faulty server, or a receiver that changes its time. If imud
knows UTC from another source, other checks follow. Without another source, this check is the only one.

A new time becomes the accepted time after 10 s without a contradiction: the receiver has got its leap seconds, another
receiver has taken over, or the host was suspended (CLOCK_MONOTONIC then does not advance).
"""

from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S

# Maximum difference of two sentences, ns. It is longer than the changes of a receiver's delay, and shorter than the
# smallest leap, one second.
LEAP_NS: Final = 500 * NS_PER_MS
# Maximum rate at which the accepted offset follows the sentences. Oscillators are within 100 ppm. A server that
# shifts its time by LEAP_NS with each sentence therefore has no effect.
DRIFT: Final = 200e-6
CONFIRM_NS: Final = 10 * NS_PER_S  # time without a contradiction after which a new time is accepted, ns


class TimeProgress:
    """Check of the times of one source. Synchronization: the event loop's thread only."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None  # accepted UTC minus CLOCK_MONOTONIC
        self._accepted_ns = 0  # CLOCK_MONOTONIC of the last accepted sentence
        self._new_offset_ns: int | None = None  # offset of the sentences that contradict the accepted offset
        self._new_start_ns = 0  # CLOCK_MONOTONIC of the first of these sentences

    def is_steady(self, offset_ns: int, t_rx_ns: int) -> bool:
        """Return whether the time of a sentence is accepted. `offset_ns` is this time minus `t_rx_ns`, CLOCK_MONOTONIC
        at the arrival of the sentence."""
        if self._offset_ns is None:
            self.accept(offset_ns, t_rx_ns)
            return True
        leap_ns = offset_ns - self._offset_ns
        if abs(leap_ns) < LEAP_NS:
            drift_ns = round(DRIFT * max(0, t_rx_ns - self._accepted_ns))
            self.accept(self._offset_ns + max(-drift_ns, min(drift_ns, leap_ns)), t_rx_ns)
            return True
        if self._new_offset_ns is None or abs(offset_ns - self._new_offset_ns) >= LEAP_NS:
            self._new_offset_ns = offset_ns
            self._new_start_ns = t_rx_ns
        elif t_rx_ns - self._new_start_ns >= CONFIRM_NS:
            self.accept(offset_ns, t_rx_ns)
            return True
        return False

    def accept(self, offset_ns: int, t_rx_ns: int) -> None:
        """Accept the time of a sentence. Other evidence than the previous sentences has confirmed it."""
        self._offset_ns = offset_ns
        self._accepted_ns = t_rx_ns
        self._new_offset_ns = None
