"""Ground truth: position, attitude and ideal measurements of a simulated sensor, as a pure function of time.

Attitude is given as Euler angles in the order of HiPNUC manual chapter 9.1 (312: yaw about Z, then pitch about X, then
roll about Y, navigation frame ENU), each a sum of sines, so that the angular rate is their exact derivative and not a
difference. Position is a sum of sines as well; specific force is its exact second derivative less gravity, turned into
the sensor frame. All frames are right-handed. Everything follows from `at(t_s)` alone: two calls with the same time
give the same truth.

    R(body → ENU) = Rz(yaw) · Rx(pitch) · Ry(roll)
    rate in body  = roll' · y + Ry(roll)ᵀ · (pitch' · x + Rx(pitch)ᵀ · yaw' · z)
    force in body = R ᵀ · (acceleration in ENU + gravity · up)
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, pi, sin
from typing import Final, NamedTuple, Protocol

from imud.attitude import quat_from_euler312
from imud.sample import Quaternion, Vector3

GRAVITY_M_S2: Final = 9.8
"""HiPNUC's 1 G: a module at rest then reads |accel| = 1."""
FIELD_ENU_T: Final[Vector3] = (-3.0e-6, 36.0e-6, -27.0e-6)
"""Earth's magnetic field, east, north, up: about 45 µT, pointing north and down as in the northern subtropics."""
SEA_LEVEL_PA: Final = 101_325.0
PA_PER_M: Final = -12.0
"""Change of air pressure with height near sea level."""
TEMPERATURE_C: Final = 35.0
WARMING_C: Final = 1.5
WARMING_PERIOD_S: Final = 600.0


class Truth(NamedTuple):
    """Measurement of an ideal sensor at one instant; vectors in the right-handed sensor frame."""

    accel_m_s2: Vector3
    """Specific force: +g on the axis that points up when at rest."""
    gyro_rad_s: Vector3
    mag_t: Vector3
    euler_rad: Vector3
    """Roll (about Y), pitch (about X), yaw (about Z, counter-clockwise), order 312."""
    quat_wxyz: Quaternion
    """Body to ENU."""
    temperature_c: float
    pressure_pa: float


class Motion(Protocol):
    """A known motion."""

    def at(self, t_s: float) -> Truth:
        """The truth at `t_s` seconds after the motion's own zero."""
        ...


@dataclass(frozen=True, slots=True)
class Sine:
    """A term of a motion: amplitude · sin(2π · frequency · t + phase)."""

    amplitude: float
    frequency_hz: float
    phase_rad: float = 0.0


Sines = tuple[Sine, ...]
_Terms = tuple[tuple[float, float, float], ...]
_Turn = tuple[float, float, float, float, float, float]
"""Sine and cosine of roll, pitch and yaw."""


class Swing:
    """Smooth known motion: each angle and each coordinate is its own sum of sines."""

    def __init__(
        self,
        *,
        roll: Sines = (),
        pitch: Sines = (),
        yaw: Sines = (),
        position_enu: tuple[Sines, Sines, Sines] = ((), (), ()),
        gravity_m_s2: float = GRAVITY_M_S2,
        field_enu_t: Vector3 = FIELD_ENU_T,
    ) -> None:
        """Angles in rad, position in m. Pitch must stay within ±90°, where order 312 is unique."""
        if sum(abs(term.amplitude) for term in pitch) >= pi / 2:
            raise ValueError("pitch would reach 90°, where roll and yaw are no longer defined")
        self._roll, self._pitch, self._yaw = _terms(roll), _terms(pitch), _terms(yaw)
        self._east, self._north, self._up = (_terms(axis) for axis in position_enu)
        self.gravity_m_s2 = gravity_m_s2
        self.field_enu_t = field_enu_t

    def at(self, t_s: float) -> Truth:
        """The truth at `t_s` seconds after the motion's own zero."""
        roll, roll_rate = _value_and_rate(self._roll, t_s)
        pitch, pitch_rate = _value_and_rate(self._pitch, t_s)
        yaw, yaw_rate = _value_and_rate(self._yaw, t_s)
        turn = sin_r, cos_r, sin_p, cos_p, _, _ = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
        up_m, up_m_s2 = _value_and_acceleration(self._up, t_s)
        force = (
            _value_and_acceleration(self._east, t_s)[1],
            _value_and_acceleration(self._north, t_s)[1],
            up_m_s2 + self.gravity_m_s2,
        )
        yaw_y, yaw_z = yaw_rate * sin_p, yaw_rate * cos_p  # yaw rate seen after the turn about X
        return Truth(
            _into_body(force, turn),
            (cos_r * pitch_rate - sin_r * yaw_z, roll_rate + yaw_y, sin_r * pitch_rate + cos_r * yaw_z),
            _into_body(self.field_enu_t, turn),
            (roll, pitch, yaw),
            quat_from_euler312((roll, pitch, yaw)),
            TEMPERATURE_C + WARMING_C * sin(2 * pi / WARMING_PERIOD_S * t_s),
            SEA_LEVEL_PA + PA_PER_M * up_m,
        )


def _terms(sines: Sines) -> _Terms:
    return tuple((term.amplitude, 2 * pi * term.frequency_hz, term.phase_rad) for term in sines)


def _value_and_rate(terms: _Terms, t_s: float) -> tuple[float, float]:
    value = rate = 0.0
    for amplitude, omega, phase in terms:
        angle = omega * t_s + phase
        value += amplitude * sin(angle)
        rate += amplitude * omega * cos(angle)
    return value, rate


def _value_and_acceleration(terms: _Terms, t_s: float) -> tuple[float, float]:
    value = acceleration = 0.0
    for amplitude, omega, phase in terms:
        term = amplitude * sin(omega * t_s + phase)
        value += term
        acceleration -= term * omega * omega
    return value, acceleration


def _into_body(v: Vector3, turn: _Turn) -> Vector3:
    """Ry(roll)ᵀ · Rx(pitch)ᵀ · Rz(yaw)ᵀ · v."""
    sin_r, cos_r, sin_p, cos_p, sin_y, cos_y = turn
    east, north, up = v
    x, y = cos_y * east + sin_y * north, cos_y * north - sin_y * east
    y, z = cos_p * y + sin_p * up, cos_p * up - sin_p * y
    return cos_r * x - sin_r * z, y, cos_r * z + sin_r * x


def swing(gravity_m_s2: float = GRAVITY_M_S2) -> Motion:
    """The default motion: all axes turn by tens of degrees and shake by a few tenths of m/s²; it never repeats soon."""
    return Swing(
        roll=(Sine(0.44, 0.23), Sine(0.07, 1.3, 0.4)),
        pitch=(Sine(0.35, 0.31, 1.0), Sine(0.09, 0.97)),
        yaw=(Sine(1.05, 0.1), Sine(0.17, 0.53, 2.0)),
        position_enu=((Sine(0.05, 0.7),), (Sine(0.04, 0.61, 0.7),), (Sine(0.03, 0.83, 1.9),)),
        gravity_m_s2=gravity_m_s2,
    )


def tumble(gravity_m_s2: float = GRAVITY_M_S2) -> Motion:
    """A slow turning by hand into all directions, as for the calibration of a magnetometer: within a minute about each
    axis through more than 360°."""
    return Swing(
        roll=(Sine(3.1, 0.043),), pitch=(Sine(1.4, 0.071),), yaw=(Sine(3.1, 0.037),), gravity_m_s2=gravity_m_s2
    )


class Still:
    """A sensor at rest in a fixed attitude; only its temperature moves."""

    def __init__(
        self,
        roll_rad: float = 0.0003,
        pitch_rad: float = 0.0026,
        yaw_rad: float = 0.0201,
        gravity_m_s2: float = GRAVITY_M_S2,
        field_enu_t: Vector3 = FIELD_ENU_T,
    ) -> None:
        roll, pitch, yaw = ((Sine(angle, 0.0, pi / 2),) for angle in (roll_rad, pitch_rad, yaw_rad))  # constants
        swing = Swing(roll=roll, pitch=pitch, yaw=yaw, gravity_m_s2=gravity_m_s2, field_enu_t=field_enu_t)
        self._truth = swing.at(0.0)

    def at(self, t_s: float) -> Truth:
        """The truth at `t_s` seconds after the motion's own zero."""
        warming_c = WARMING_C * sin(2 * pi / WARMING_PERIOD_S * t_s)
        return self._truth._replace(temperature_c=TEMPERATURE_C + warming_c)


MOTIONS: Final[dict[str, Callable[[float], Motion]]] = {
    "swing": swing,
    "tumble": tumble,
    "still": lambda gravity_m_s2: Still(gravity_m_s2=gravity_m_s2),
}
"""Motions by name; each is made with the local gravity in m/s²."""
