"""What becomes of a correction: it is spread over time, so that a reader's time step never jumps."""

from typing import Final

from imud.units import NS_PER_S

SLEW: Final = 500e-6
"""Share of the elapsed time that a settled clock is corrected by: half a millisecond per second."""
SLEW_SETTLING: Final = 0.2
"""The same while the fit is young."""
SETTLED_AFTER_NS: Final = 10 * NS_PER_S


class Slew:
    """The distance between what is told and what is believed, brought to zero at a bounded rate."""

    __slots__ = ("left_ns",)

    def __init__(self) -> None:
        self.left_ns = 0.0
        """Told time minus believed time."""

    def over(self, elapsed_ns: int, age_ns: int) -> float:
        """The distance after `elapsed_ns` more, with a fit of `age_ns`."""
        left = self.left_ns
        if left:
            most = elapsed_ns * (SLEW if age_ns > SETTLED_AFTER_NS else SLEW_SETTLING)
            if left > most:
                left -= most
            elif left < -most:
                left += most
            else:
                left = 0.0
            self.left_ns = left
        return left
