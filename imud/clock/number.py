"""A device's counter that numbers its samples: it says how many are missing, and nothing of time."""

from typing import Final

from imud.units import NS_PER_S

STEPS_ALWAYS: Final = 4
"""So many steps are believed of any arrivals: messages that waited come together."""
STEPS_FACTOR: Final = 1.5
"""What arrivals can be off from the rate over a longer gap; a larger jump is a counter that began anew."""
LATE_NS: Final = NS_PER_S // 2
"""How long messages may wait and then come together; no device starts anew within that time."""
STEPS_UNKNOWN: Final = 1000
"""So many steps are believed while the rate is not known."""


class SampleNumber:
    """The wrapping number of the newest sample.

    A gap in which it turns round once or more (11 minutes at 100 Hz and 16 bits) is counted short by whole turns.
    """

    __slots__ = ("_modulus", "_number", "_y", "begun")

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._number = 0
        self._y = 0
        self.begun = False
        """Whether there is a sample before."""

    def steps(self, number: int, y: int, period_ns: float) -> int:
        """Samples from the newest one to this, arrived at `y`; 0 for the first one and for one that began anew."""
        if not self.begun:
            return 0
        steps = (number - self._number) % self._modulus
        if steps <= STEPS_ALWAYS:
            return steps
        most = STEPS_FACTOR * (y - self._y + LATE_NS) / period_ns if period_ns else STEPS_UNKNOWN
        return steps if steps <= most else 0

    def take(self, number: int, y: int) -> None:
        """This is the newest sample now."""
        self._number, self._y, self.begun = number, y, True
