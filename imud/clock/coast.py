"""Time over a jump of the device's counter that is understood: it goes on from what was told, by the same crystal."""

from typing import Final

from imud.units import NS_PER_MS

CRYSTAL: Final = 20e-6
"""How well the slope is known at worst, of a fit that counts."""


class Coast:
    """A line from where the old fit ended, for as long as the new one does not count. Errors grow with time."""

    __slots__ = ("_error_ns", "_slope", "_t_ns", "_x")

    def __init__(self, x: int, t_ns: int, slope: float, error_ns: float) -> None:
        self._x = x
        self._t_ns = t_ns
        self._slope = slope
        self._error_ns = error_ns + NS_PER_MS / 4  # where in its tick the counter jumped is not known

    def at(self, x: int) -> int:
        """Host time at device time `x`."""
        return self._t_ns + int(self._slope * (x - self._x))

    def error_ns(self, x: int) -> float:
        """One-sigma error of that."""
        return self._error_ns + CRYSTAL * (x - self._x)

    @property
    def slope(self) -> float:
        """Host ns per device ns."""
        return self._slope
