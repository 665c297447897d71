"""Errors of `attitude: host`: simulated motion, and the own attitude of a device. Run `python -m tests.bench.attitude`.

The simulated sensor rests for 20 s and then rotates for 10 s at 200 °/s. The manual of the IMU61x states no noise. The
assumed figures: gyro 0.005 (°/s)/√Hz with a bias of 0.2 °/s, accelerometer 100 µg/√Hz. The errors depend on no clock;
the time per sample does. If imufusion is installed, the command measures it too.
"""

import argparse
import csv
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from math import acos, atan2, cos, degrees, pi, radians, sin, sqrt
from pathlib import Path
from random import Random
from time import process_time
from typing import Final, NamedTuple

from imud.attitude.conventions import FLU_LEVEL, RFU_ENU
from imud.attitude.rotation import matrix_from_quat, matrix_times, quat_from_euler_zyx, quat_product, transposed
from imud.model.sample import Quaternion, Sample, Sync, Vector3
from imud.model.units import NS_PER_S, STANDARD_GRAVITY_M_S2
from imud.sampling.attitude import HostAttitude
from tests.support.results import ProgramRun, Row, Table, add_json, printed

REST_S: Final = 20
TURN_S: Final = 10
SPEED_RAD_S: Final = radians(200)
GYRO_BIAS_RAD_S: Final[Vector3] = (radians(0.2), radians(-0.15), radians(0.1))
GYRO_NOISE: Final = radians(0.005)  # (rad/s)/√Hz
ACCEL_NOISE: Final = 100e-6 * STANDARD_GRAVITY_M_S2  # (m/s²)/√Hz
# axis of the rotation in the sensor, and roll and pitch at rest
MOTIONS: Final[Mapping[str, tuple[Vector3, float, float]]] = {
    "level, about the vertical": ((0, 0, 1), 0, 0),
    "tilted, about z": ((0, 0, 1), 30, -17),
    "tilted, about all axes": ((0.267, 0.535, 0.802), 17, 11),
}
# a recording of the vendor with the attitude of a HI91 device; the repository does not contain it
VENDOR_FILE: Final = Path(
    os.environ.get("IMUD_VENDOR_RECORDING", Path(__file__).parents[3] / "shared/data/hi91-static-100hz.csv")
)

COLUMNS: Final = (
    "at rest: roll and pitch, °", "yaw in 10 s at rest, °", "after the rotation: roll and pitch, °",
    "yaw after the rotation, °",
)  # fmt: skip

Motion = list[tuple[Sample, Quaternion]]  # samples and their true attitude
Filter = Callable[[Sequence[Sample]], list[Quaternion]]


class Figures(NamedTuple):
    """Errors in degrees. The error of the yaw counts from the last sample at rest."""

    rest_tilt_deg: float  # root mean square of roll and pitch in the last 5 s at rest
    rest_yaw_deg: float  # change of the yaw in the last 10 s at rest
    turn_tilt_deg: float  # roll and pitch after the rotation
    turn_yaw_deg: float  # yaw after the rotation

    @classmethod
    def worst(cls, figures: Iterable["Figures"]) -> "Figures":
        return cls(*(max(map(abs, column)) for column in zip(*figures, strict=True)))


class Compared(NamedTuple):
    """Difference of roll and pitch to the device, degrees."""

    rest_tilt_deg: float  # maximum in the first second, at rest
    motion_tilt_deg: float  # root mean square during the motion
    end_tilt_deg: float  # in the newest sample


def motion_of(name: str, rate_hz: int) -> Motion:
    """Return the samples of one motion with noise."""
    (ax, ay, az), roll_deg, pitch_deg = MOTIONS[name]
    random, step_ns = Random(f"{name} {rate_hz}"), NS_PER_S // rate_hz
    truth, half = quat_from_euler_zyx((radians(roll_deg), radians(pitch_deg), 0)), SPEED_RAD_S / rate_hz / 2
    turn = (cos(half), sin(half) * ax, sin(half) * ay, sin(half) * az)
    made: Motion = []
    for number in range((REST_S + TURN_S) * rate_hz):
        moves = number >= REST_S * rate_hz
        truth = quat_product(truth, turn) if moves else truth
        rate, force = (ax, ay, az), matrix_times(transposed(matrix_from_quat(truth)), (0, 0, STANDARD_GRAVITY_M_S2))
        spread = sqrt(rate_hz / 2)
        gyro = [
            SPEED_RAD_S * one * moves + bias + random.gauss(0, GYRO_NOISE * spread)
            for one, bias in zip(rate, GYRO_BIAS_RAD_S, strict=True)
        ]
        accel = [one + random.gauss(0, ACCEL_NOISE * spread) for one in force]
        made.append((raw(number * step_ns, (gyro[0], gyro[1], gyro[2]), (accel[0], accel[1], accel[2])), truth))
    return made


def raw(t_ns: int, gyro: Vector3, accel: Vector3) -> Sample:
    return Sample("a", 1, t_ns + 1, 1, Sync.ARRIVAL, t_ns, t_ns, gyro_rad_s=gyro, accel_m_s2=accel)


def of_imud(samples: Sequence[Sample]) -> list[Quaternion]:
    return [one.quat_wxyz or (1, 0, 0, 0) for one in HostAttitude(FLU_LEVEL).samples(samples)]


def of_imufusion(samples: Sequence[Sample]) -> list[Quaternion]:
    """Return the attitudes of imufusion with the settings of its documentation and its estimate of the bias."""
    import imufusion
    import numpy

    rate_hz = NS_PER_S / (samples[1].t_ns - samples[0].t_ns)
    ahrs, bias = imufusion.Ahrs(), imufusion.Bias()
    ahrs.set_settings(
        imufusion.AhrsSettings(
            sample_rate=rate_hz, convention=imufusion.CONVENTION_NWU, gain=0.5, gyroscope_range=2000,
            acceleration_rejection=10, magnetic_rejection=10, rejection_timeout=5,
        )
    )  # fmt: skip
    settings = imufusion.BiasSettings()
    settings.sample_rate = rate_hz
    bias.set_settings(settings)
    made: list[Quaternion] = []
    for one in samples:
        gyro = bias.update(numpy.array(one.gyro_rad_s) * 180 / pi)
        ahrs.update_no_magnetometer(gyro, numpy.array(one.accel_m_s2) / STANDARD_GRAVITY_M_S2)
        w, x, y, z = ahrs.get_quaternion().tolist()
        made.append((w, x, y, z))
    return made


def simulated(rate_hz: int, of: Filter = of_imud) -> Iterator[Figures]:
    """Yield the errors of each motion."""
    for name in MOTIONS:
        motion = motion_of(name, rate_hz)
        found = of([one for one, _ in motion])
        yaw = [_yaw_deg(one, truth) for one, (_, truth) in zip(found, motion, strict=True)]
        tilt = [_tilt_deg(one, truth) for one, (_, truth) in zip(found, motion, strict=True)]
        last = REST_S * rate_hz - 1
        rest = tilt[last - 5 * rate_hz : last]
        yield Figures(
            sqrt(sum(one * one for one in rest) / len(rest)),
            _wrapped(yaw[last] - yaw[last - 10 * rate_hz]),
            tilt[-1],
            _wrapped(yaw[-1] - yaw[last]),
        )


def against_device(rows: Sequence[Mapping[str, str]]) -> Compared:
    """Compare the attitude of imud with the attitude of a device in a file of the vendor: °/s, g and °."""
    samples, own = [], []
    for row in rows:
        gyro = [radians(float(row[f"gyr_{axis}"])) for axis in "xyz"]
        accel = [float(row[f"acc_{axis}"]) * STANDARD_GRAVITY_M_S2 for axis in "xyz"]
        t_ns = int(row["sys_time"]) * 1_000_000
        samples.append(raw(t_ns, (gyro[0], gyro[1], gyro[2]), (accel[0], accel[1], accel[2])))
        w, x, y, z = (float(row[f"quat_{name}"]) for name in "wxyz")
        own.append((w, x, y, z))
    made = [one.quat_wxyz or (1, 0, 0, 0) for one in HostAttitude(RFU_ENU).samples(samples)]
    tilt = [_tilt_deg(one, device) for one, device in zip(made, own, strict=True)]
    moving = [
        one for one, row in zip(tilt, rows, strict=True) if float(row["gyr_norm"]) > 5
    ]  # the device rotates by hand
    return Compared(max(tilt[:100]), sqrt(sum(one * one for one in moving) / len(moving)), tilt[-1])


def _tilt_deg(one: Quaternion, other: Quaternion) -> float:
    """Return the angle between the verticals of two attitudes."""
    up, down = matrix_from_quat(one)[2], matrix_from_quat(other)[2]
    return degrees(acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(up, down, strict=True))))))


def _yaw_deg(one: Quaternion, truth: Quaternion) -> float:
    """Return the angle of the difference about the vertical."""
    w, x, y, z = truth
    turn = quat_product(one, (w, -x, -y, -z))
    return degrees(2 * atan2(turn[3], turn[0]))


def _wrapped(angle_deg: float) -> float:
    return (angle_deg + 180) % 360 - 180


def table() -> Iterator[Row]:
    filters: dict[str, Filter] = {"vqf": of_imud, "imufusion": of_imufusion}
    for name, of in filters.items():
        for rate_hz in (100, 200, 1000):
            try:
                worst = Figures.worst(simulated(rate_hz, of))
            except ImportError as error:
                print(f"{name}: {error}")
                break
            samples = [one for one, _ in motion_of("tilted, about z", rate_hz)]
            begun_s = process_time()
            of(samples)
            us = (process_time() - begun_s) / len(samples) * 1e6
            filter_name = f"{name} {version(name)}"
            yield {
                "filter": filter_name,
                "rate, Hz": rate_hz,
                **dict(zip(COLUMNS, worst, strict=True)),
                "CPU time, µs": us,
            }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.attitude")
    add_json(parser)
    args, program_run, rows = parser.parse_args(), ProgramRun(), list[Row]()
    for row in table():
        rows.append(row)
        print(printed(row), flush=True)
    tables = [Table("Errors in simulated motion", rows)]
    if not VENDOR_FILE.is_file():
        print(f"no comparison with a device: expected {VENDOR_FILE}, or its path in IMUD_VENDOR_RECORDING")
    else:
        with VENDOR_FILE.open() as file:
            found = against_device(list(csv.DictReader(file)))
        row = dict(zip(("at rest, °", "in motion (rms), °", "2 s after the motion, °"), found, strict=True))
        tables.append(Table("Difference of roll and pitch to the own attitude of a HI91 device, moved by hand", [row]))
        print(printed(row))
    program_run.save(args.json, tables)


if __name__ == "__main__":
    main()
