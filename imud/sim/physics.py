"""Ground truth: position, attitude and ideal measurements of a simulated sensor, as a pure function of time.

The attitude is in Euler angles with the order of HiPNUC manual chapter 9.1 (312: yaw about Z, then pitch about X, then
roll about Y, navigation frame ENU). Each angle is a sum of sines, so that the angular rate is the exact derivative. The
position is a sum of sines, too. The specific force is its exact second derivative minus gravity, rotated into the
sensor frame. All frames are right-handed. `at(t_s)` is the only source of values: two calls with the same time return
the same truth.

    R(body → ENU) = Rz(yaw) · Rx(pitch) · Ry(roll)
    rate in body  = roll' · y + Ry(roll)ᵀ · (pitch' · x + Rx(pitch)ᵀ · yaw' · z)
    force in body = R ᵀ · (acceleration in ENU + gravity · up)
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, hypot, pi, sin
from random import Random
from statistics import NormalDist
from typing import Final, NamedTuple, Protocol

from imud.attitude.rotation import Matrix3, euler312_from_quat, quat_from_euler312, quat_from_matrix, quat_product
from imud.model.sample import Quaternion, Vector3

GRAVITY_M_S2: Final = 9.8  # 1 G of HiPNUC, m/s². A device at rest then reads |accel| = 1.
# Earth's magnetic field, east, north, up, T: about 45 µT, to the north and down as in the northern subtropics.
FIELD_ENU_T: Final[Vector3] = (-3.0e-6, 36.0e-6, -27.0e-6)
SEA_LEVEL_PA: Final = 101_325.0
PA_PER_M: Final = -12.0  # change of air pressure with height near sea level, Pa/m
TEMPERATURE_C: Final = 35.0
WARMING_C: Final = 1.5
WARMING_PERIOD_S: Final = 600.0


class Truth(NamedTuple):
    """Measurement of an ideal sensor at one instant. Vectors are in the right-handed sensor frame."""

    accel_m_s2: Vector3  # specific force, m/s²: +g on the axis that points up at rest
    gyro_rad_s: Vector3  # angular rate, rad/s
    mag_t: Vector3  # magnetic flux density, T
    euler_rad: Vector3  # roll (about Y), pitch (about X), yaw (about Z, counter-clockwise), order 312
    quat_wxyz: Quaternion  # rotation from body to ENU
    temperature_c: float  # temperature of the sensor, °C
    pressure_pa: float  # air pressure, Pa
    position_enu_m: Vector3 = (0.0, 0.0, 0.0)  # position from the start of the motion, east, north, up, m
    velocity_enu_m_s: Vector3 = (0.0, 0.0, 0.0)  # velocity, east, north, up, m/s


class Motion(Protocol):
    """A known motion."""

    def at(self, t_s: float) -> Truth:
        """Return the truth at `t_s` seconds after the zero of the motion."""
        ...


@dataclass(frozen=True, slots=True)
class Sine:
    """A term of a motion: amplitude · sin(2π · frequency · t + phase)."""

    amplitude: float  # in rad for an angle, in m for a coordinate
    frequency_hz: float  # frequency, Hz
    phase_rad: float = 0.0  # phase at the zero of the motion, rad


Sines = tuple[Sine, ...]
_Terms = tuple[tuple[float, float, float], ...]
_Turn = tuple[float, float, float, float, float, float]  # sine and cosine of roll, pitch and yaw


class Swing:
    """Smooth known motion. Each angle and each coordinate is a sum of sines."""

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
        """Angles in rad, position in m. Raises ValueError if the pitch can reach ±90°: order 312 is ambiguous there."""
        if sum(abs(term.amplitude) for term in pitch) >= pi / 2:
            raise ValueError("expected a pitch below 90°, because roll and yaw are undefined at 90°")
        self._roll, self._pitch, self._yaw = _terms(roll), _terms(pitch), _terms(yaw)
        self._east, self._north, self._up = (_terms(axis) for axis in position_enu)
        self.gravity_m_s2: float = gravity_m_s2  # local gravity, m/s²
        self.field_enu_t: Vector3 = field_enu_t  # magnetic field of the place, east, north, up, T

    def at(self, t_s: float) -> Truth:
        """Return the truth at `t_s` seconds after the zero of the motion."""
        roll, roll_rate = _value_and_rate(self._roll, t_s)
        pitch, pitch_rate = _value_and_rate(self._pitch, t_s)
        yaw, yaw_rate = _value_and_rate(self._yaw, t_s)
        turn = sin_r, cos_r, sin_p, cos_p, _, _ = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
        axes = [_value_and_derivatives(axis, t_s) for axis in (self._east, self._north, self._up)]
        place, velocity, (east_m_s2, north_m_s2, up_m_s2) = zip(*axes, strict=True)
        force = (east_m_s2, north_m_s2, up_m_s2 + self.gravity_m_s2)
        yaw_y, yaw_z = yaw_rate * sin_p, yaw_rate * cos_p  # yaw rate after the rotation about X
        return Truth(
            _into_body(force, turn),
            (cos_r * pitch_rate - sin_r * yaw_z, roll_rate + yaw_y, sin_r * pitch_rate + cos_r * yaw_z),
            _into_body(self.field_enu_t, turn),
            (roll, pitch, yaw),
            quat_from_euler312((roll, pitch, yaw)),
            TEMPERATURE_C + WARMING_C * sin(2 * pi / WARMING_PERIOD_S * t_s),
            SEA_LEVEL_PA + PA_PER_M * place[2],
            place,
            velocity,
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


def _value_and_derivatives(terms: _Terms, t_s: float) -> Vector3:
    value = rate = acceleration = 0.0
    for amplitude, omega, phase in terms:
        angle = omega * t_s + phase
        term = amplitude * sin(angle)
        value += term
        rate += amplitude * omega * cos(angle)
        acceleration -= term * omega * omega
    return value, rate, acceleration


def _into_body(v: Vector3, turn: _Turn) -> Vector3:
    """Return Ry(roll)ᵀ · Rx(pitch)ᵀ · Rz(yaw)ᵀ · v."""
    sin_r, cos_r, sin_p, cos_p, sin_y, cos_y = turn
    east, north, up = v
    x, y = cos_y * east + sin_y * north, cos_y * north - sin_y * east
    y, z = cos_p * y + sin_p * up, cos_p * up - sin_p * y
    return cos_r * x - sin_r * z, y, cos_r * z + sin_r * x


def swing(gravity_m_s2: float = GRAVITY_M_S2) -> Motion:
    """Return the default motion: all axes turn by tens of degrees and shake by some tenths of m/s²."""
    return Swing(
        roll=(Sine(0.44, 0.23), Sine(0.07, 1.3, 0.4)),
        pitch=(Sine(0.35, 0.31, 1.0), Sine(0.09, 0.97)),
        yaw=(Sine(1.05, 0.1), Sine(0.17, 0.53, 2.0)),
        position_enu=((Sine(0.05, 0.7),), (Sine(0.04, 0.61, 0.7),), (Sine(0.03, 0.83, 1.9),)),
        gravity_m_s2=gravity_m_s2,
    )


def tumble(gravity_m_s2: float = GRAVITY_M_S2) -> Motion:
    """Return a slow rotation for a magnetometer calibration: more than 360° about each axis within a minute."""
    return Swing(
        roll=(Sine(3.1, 0.043),), pitch=(Sine(1.4, 0.071),), yaw=(Sine(3.1, 0.037),), gravity_m_s2=gravity_m_s2
    )


class Still:
    """A sensor at rest in a fixed attitude. Only its temperature changes."""

    def __init__(
        self,
        roll_rad: float = 0.0003,
        pitch_rad: float = 0.0026,
        yaw_rad: float = 0.0201,
        gravity_m_s2: float = GRAVITY_M_S2,
        field_enu_t: Vector3 = FIELD_ENU_T,
    ) -> None:
        roll, pitch, yaw = ((Sine(angle, 0.0, pi / 2),) for angle in (roll_rad, pitch_rad, yaw_rad))  # constant angles
        swing = Swing(roll=roll, pitch=pitch, yaw=yaw, gravity_m_s2=gravity_m_s2, field_enu_t=field_enu_t)
        self._truth = swing.at(0.0)

    def at(self, t_s: float) -> Truth:
        """Return the truth at `t_s` seconds after the zero of the motion."""
        warming_c = WARMING_C * sin(2 * pi / WARMING_PERIOD_S * t_s)
        return self._truth._replace(temperature_c=TEMPERATURE_C + warming_c)


# Motions by name. The argument is the local gravity, m/s².
MOTIONS: Final[dict[str, Callable[[float], Motion]]] = {
    "swing": swing,
    "tumble": tumble,
    "still": lambda gravity_m_s2: Still(gravity_m_s2=gravity_m_s2),
}

UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)


class MountingRotation:
    """Active rotations of the mounting. Without a rotation, `active` is False and `turned` returns its argument."""

    def __init__(
        self,
        frame: Quaternion = UPRIGHT,
        level: Quaternion = UPRIGHT,
        level_accel: bool = False,
        yaw_rad: float = 0.0,
    ) -> None:
        self.active = yaw_rad != 0.0 or frame != UPRIGHT or level != UPRIGHT
        self._frame = frame
        self._accel = quat_product(frame, level) if level_accel else frame
        self._body = quat_product(frame, level)
        self._heading = (cos(yaw_rad / 2), 0.0, 0.0, sin(yaw_rad / 2))

    def turned(self, truth: Truth) -> Truth:
        """Rotate a truth from the frame of the chip to the frame of the mounted device."""
        if not self.active:
            return truth
        quat_wxyz = quat_product(quat_product(self._heading, truth.quat_wxyz), self._body)
        return truth._replace(
            accel_m_s2=turned_back(self._accel, truth.accel_m_s2),
            gyro_rad_s=turned_back(self._frame, truth.gyro_rad_s),
            mag_t=turned_back(self._frame, truth.mag_t),
            euler_rad=euler312_from_quat(quat_wxyz),
            quat_wxyz=quat_wxyz,
        )


def frame_of(matrix: Matrix3) -> Quaternion:
    """Return the rotation nearest to a nearly orthonormal right-handed matrix. The direction of the first row stays."""
    x = _unit(matrix[0])
    z = _unit(_cross(x, matrix[1]))
    return quat_from_matrix((x, _cross(z, x), z))


def level_of(quat_wxyz: Quaternion, upside_down: bool = False) -> Quaternion:
    """Return the rotation about the body after which roll and pitch are 0° (or 180° and 0°) and yaw is unchanged."""
    yaw = euler312_from_quat(quat_wxyz)[2]
    w, x, y, z = quat_wxyz
    return quat_product((w, -x, -y, -z), quat_from_euler312((pi if upside_down else 0.0, 0.0, yaw)))


def turned_back(quat_wxyz: Quaternion, vector: Vector3) -> Vector3:
    """Return Cᵀ · v, where C is the matrix of the unit quaternion."""
    w, x, y, z = quat_wxyz
    _, vx, vy, vz = quat_product(quat_product((w, -x, -y, -z), (0.0, *vector)), quat_wxyz)
    return vx, vy, vz


def _unit(v: Vector3) -> Vector3:
    norm = hypot(*v)
    return v[0] / norm, v[1] / norm, v[2] / norm


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


NORMAL_BITS: Final = 12
NORMAL_MASK: Final = (1 << NORMAL_BITS) - 1
# Equally likely values of the normal distribution. The choice of one value takes a fifth of the time of `random.gauss`.
NORMAL: Final = tuple(NormalDist().inv_cdf((i + 0.5) / (1 << NORMAL_BITS)) for i in range(1 << NORMAL_BITS))


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """White noise per sample and axis, one sigma, and the maximum bias.

    The white noise is the noise of a HiPNUC device at rest at 100 Hz during one second: 0.0006 G, 0.036 °/s, 0.2 µT,
    0.2 Pa. The biases are assumptions.
    """

    accel_m_s2: float = 0.006  # noise of the specific force, m/s²
    gyro_rad_s: float = 0.0006  # noise of the angular rate, rad/s
    mag_t: float = 0.2e-6  # noise of the magnetic flux density, T
    accel_bias_m_s2: float = 0.02  # maximum bias of the specific force, m/s²
    gyro_bias_rad_s: float = 0.0005  # maximum bias of the angular rate, rad/s
    mag_bias_t: float = 0.3e-6  # maximum bias of the magnetic flux density, T
    pressure_pa: float = 0.2  # noise of the air pressure, Pa
    # Period of the bias of the first axis, s. The periods of the other axes are slightly longer.
    bias_period_s: float = 300.0


class Noise:
    """Adds noise to a truth, except to its attitude. The same seed and the same calls give the same noise."""

    def __init__(self, seed: int, levels: NoiseLevels | None = None) -> None:
        self._levels = levels = levels or NoiseLevels()
        self._random = random = Random(seed)
        self._waves = [
            (2 * pi / (levels.bias_period_s * (1 + axis / 7)), random.uniform(0, 2 * pi)) for axis in range(9)
        ]

    def bias(self, t_s: float) -> tuple[Vector3, Vector3, Vector3]:
        """Return the bias of accelerometer (m/s²), gyroscope (rad/s) and magnetometer (T) at a time."""
        a, b, c, d, e, f, g, h, i = (sin(omega * t_s + phase) for omega, phase in self._waves)
        levels = self._levels
        accel, gyro, mag = levels.accel_bias_m_s2, levels.gyro_bias_rad_s, levels.mag_bias_t
        return (accel * a, accel * b, accel * c), (gyro * d, gyro * e, gyro * f), (mag * g, mag * h, mag * i)

    def add(self, truth: Truth, t_s: float) -> Truth:
        """Return the truth at `t_s` seconds after the zero of the motion with noise and bias."""
        levels = self._levels
        accel_bias, gyro_bias, mag_bias = self.bias(t_s)
        accel, gyro, mag, euler, quat, temperature_c, pressure_pa, *_ = truth
        return Truth(
            self._blur(accel, accel_bias, levels.accel_m_s2),
            self._blur(gyro, gyro_bias, levels.gyro_rad_s),
            self._blur(mag, mag_bias, levels.mag_t),
            euler,
            quat,
            temperature_c,
            pressure_pa + levels.pressure_pa * NORMAL[self._random.getrandbits(NORMAL_BITS)],
            truth.position_enu_m,
            truth.velocity_enu_m_s,
        )

    def _blur(self, vector: Vector3, bias: Vector3, sigma: float) -> Vector3:
        bits = self._random.getrandbits(3 * NORMAL_BITS)
        x, y, z = vector
        bias_x, bias_y, bias_z = bias
        return (
            x + bias_x + sigma * NORMAL[bits & NORMAL_MASK],
            y + bias_y + sigma * NORMAL[bits >> NORMAL_BITS & NORMAL_MASK],
            z + bias_z + sigma * NORMAL[bits >> 2 * NORMAL_BITS],
        )
