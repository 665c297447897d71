"""Motions of the devices on a bus. All devices repeat the same motion with different start times."""

from typing import Final

from imud.sim.physics import GRAVITY_M_S2, MOTIONS, Truth

LOOP_S: Final = 4.0
"""Duration of the repeated motion, s. The guest needs longer to compute the motion than to play it."""
PHASE_S: Final = 7.3
"""Time offset between the motions of two devices, s. Frames of two devices are thus never equal."""


class Phased:
    def __init__(self, number: int, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        self._motion = MOTIONS["swing"](gravity_m_s2)
        self._phase_s = PHASE_S * number

    def at(self, t_s: float) -> Truth:
        """Return the true attitude `t_s` seconds after the start of the device's motion."""
        return self._motion.at(t_s + self._phase_s)
