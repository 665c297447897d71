"""Detection of rest, with samples computed by hand."""

from math import pi, radians

import pytest

from imud.device.calibration import RestWindow
from imud.model.sample import Pair, Sample, Sync, Vector3

WINDOW_SAMPLES = 20

UP: Vector3 = (0.0, 0.0, 9.80665)
STILL: Vector3 = (0.0, 0.0, 0.0)


def sample(
    accel: Vector3 | None = UP, gyro: Vector3 | None = STILL, euler: Vector3 | None = None, incli: Pair | None = None
) -> Sample:
    return Sample(
        "bow", 1, 1, 0, Sync.ARRIVAL, 1, 1, accel_m_s2=accel, gyro_rad_s=gyro, euler_rad=euler, incli_rad=incli
    )


def window(*samples: Sample) -> RestWindow:
    made = RestWindow()
    for one in samples:
        made.add(one)
    return made


def test_rest() -> None:
    assert window(*[sample()] * WINDOW_SAMPLES).motion() == ""
    assert window(sample(gyro=(radians(2), 0.0, 0.0))).motion() == ""  # a constant bias is not a motion
    assert window(sample(accel=None, gyro=None)).motion() == ""


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        ([sample(), sample(gyro=(radians(4), 0, 0))], "the angular rate changes by 2 °/s (at most 1 °/s at rest)"),
        ([sample(gyro=(0, radians(6), 0))], "it turns at 6 °/s (at most 5 °/s at rest)"),
        (
            [sample(), sample(accel=(2.0, 0.0, 9.80665))],
            "the acceleration changes by 1 m/s² (at most 0.5 m/s² at rest)",
        ),
        (
            [sample(accel=(0.0, 0.0, 10.80665))],
            "the acceleration differs from gravity by 1 m/s² (at most 0.49 m/s² at rest)",
        ),
    ],
)
def test_motion(samples: list[Sample], words: str) -> None:
    assert window(*samples).motion() == words


def test_the_newest_samples_count_and_have_means() -> None:
    moved = window(sample(gyro=(1.0, 0, 0)), *[sample()] * (WINDOW_SAMPLES - 1))
    assert moved.full
    assert moved.motion()
    moved.add(sample())
    assert moved.motion() == ""
    moved.clear()
    assert not moved.full
    assert moved.means().gyro_rad_s is None
    means = window(
        sample((1.0, 0.0, 9.0), (0.1, 0.0, 0.0), (0.1, 0.0, pi - 0.1), (0.2, pi)),
        sample((3.0, 0.0, 10.0), (0.3, 0.0, 0.0), (0.3, 0.0, -pi + 0.3), (0.4, -pi)),
    ).means()
    assert (means.accel_m_s2, means.gyro_rad_s) == ((2.0, 0.0, 9.5), (0.2, 0.0, 0.0))
    assert means.euler_rad == pytest.approx((0.2, 0.0, -pi + 0.1))  # angles on both sides of ±180°
    assert means.incli_rad is not None
    assert means.incli_rad[0] == pytest.approx(0.3)
    assert abs(means.incli_rad[1]) == pytest.approx(pi)
    assert window(sample(None, None)).means().incli_rad is None
