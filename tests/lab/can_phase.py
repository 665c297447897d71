"""The motions that the modules on a bus are played with: the same one, each at another time of it, over and over."""

from typing import Final

from imud.sim.physics import GRAVITY_M_S2, MOTIONS, Truth

LOOP_S: Final = 4.0
"""Played again and again; making it takes the guest longer than playing it."""
PHASE_S: Final = 7.3
"""Between the motions of one module and the next: the same frame of two modules is never alike."""


class Phased:
    def __init__(self, number: int, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        self._motion = MOTIONS["swing"](gravity_m_s2)
        self._phase_s = PHASE_S * number

    def at(self, t_s: float) -> Truth:
        """The truth `t_s` seconds after the module's own zero."""
        return self._motion.at(t_s + self._phase_s)
