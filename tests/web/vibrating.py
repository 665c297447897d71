"""`python -m tests.web.vibrating`: `python -m imud.sim` with an additional motion for the pictures, `--motion engine`.

A vessel with a running engine: slow roll, pitch and yaw, and vibration at the frequency of the engine and twice of it.
"""

import sys
from math import pi
from typing import Final

from imud.sim.__main__ import main
from imud.sim.physics import MOTIONS, Motion, Sine, Swing

ENGINE_HZ: Final = 31.0
UP_M_S2: Final = 0.6
EAST_M_S2: Final = 0.15


def shaking(amplitude_m_s2: float, frequency_hz: float) -> Sine:
    return Sine(amplitude_m_s2 / (2 * pi * frequency_hz) ** 2, frequency_hz)


def engine(gravity_m_s2: float) -> Motion:
    return Swing(
        roll=(Sine(0.21, 0.13), Sine(0.03, 0.37, 0.4)),
        pitch=(Sine(0.09, 0.17, 1.0), Sine(0.02, 0.41)),
        yaw=(Sine(0.7, 0.021, 0.3), Sine(0.06, 0.11, 2.0)),
        position_enu=((shaking(EAST_M_S2, 2 * ENGINE_HZ),), (), (Sine(0.3, 0.15), shaking(UP_M_S2, ENGINE_HZ))),
        gravity_m_s2=gravity_m_s2,
    )


if __name__ == "__main__":
    MOTIONS["engine"] = engine
    sys.exit(main())
