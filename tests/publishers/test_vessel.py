"""Motion of a vessel from a sample: heading, roll, pitch and rate of turn; the choice of the device is tested with the
outputs (tests/publishers/test_nmea0183.py)."""

from math import inf, nan, radians

import msgspec
import pytest

from imud.attitude.conventions import FLU_LEVEL, UNSETTLED_BIT, Heading
from imud.attitude.published import as_sent
from imud.contracts.publisher import Batch
from imud.model.sample import Sample, Sync, Vector3
from imud.publishers import vessel


def sample(euler_deg: Vector3 | None, gyro_deg_s: Vector3 | None = None) -> Sample:
    euler = None if euler_deg is None else (radians(euler_deg[0]), radians(euler_deg[1]), radians(euler_deg[2]))
    gyro = None if gyro_deg_s is None else (radians(gyro_deg_s[0]), radians(gyro_deg_s[1]), radians(gyro_deg_s[2]))
    return Sample("bow", 1, 0, 0, Sync.ARRIVAL, 0, 0, euler_rad=euler, gyro_rad_s=gyro)


def test_the_rate_of_turn_is_the_rate_of_the_heading() -> None:
    assert vessel.turn_rate_rad_s(sample((0, 0, 0), (5, 5, 2))) == pytest.approx(radians(2))
    # right side down by 90°: a rotation about y changes the heading
    assert vessel.turn_rate_rad_s(sample((90, 0, 0), (0, 3, 0))) == pytest.approx(radians(3))
    # bow up by 60°: the heading turns twice as fast as the body about its z axis
    assert vessel.turn_rate_rad_s(sample((0, 60, 0), (0, 0, 1))) == pytest.approx(radians(2))
    assert vessel.turn_rate_rad_s(sample(None, (0, 0, 1))) == pytest.approx(radians(1))
    assert vessel.turn_rate_rad_s(sample((0, 85, 0), (0, 0, 1))) is None
    assert vessel.turn_rate_rad_s(sample((0, 0, 0))) is None
    assert vessel.turn_rate_rad_s(sample((0, 0, 0), (0, 0, inf))) is None


def test_headings_need_a_reference() -> None:
    one = sample((1, 2, 45))
    for reference, true_deg, magnetic_deg in (
        (vessel.HeadingReference(Heading.TRUE), 45, None),
        (vessel.HeadingReference(Heading.TRUE, 3.0), 45, 42),
        (vessel.HeadingReference(Heading.MAGNETIC), None, 45),
        (vessel.HeadingReference(Heading.RELATIVE), None, None),
    ):
        found = vessel.true_rad(one, reference), vessel.magnetic_rad(one, reference)
        assert found == tuple(None if deg is None else pytest.approx(radians(deg)) for deg in (true_deg, magnetic_deg))
    assert vessel.roll_pitch_rad(one) == pytest.approx((radians(1), radians(2)))
    assert vessel.roll_pitch_rad(sample((1, nan, 45))) is None


def test_an_unsettled_attitude_is_not_sent() -> None:
    """Bit 30 of `status`: the attitude filter of the host has not settled. The rate of turn then expects a level
    body."""
    for status, has_attitude in ((None, True), (1 << 31, True), (1 << UNSETTLED_BIT, False)):
        one = msgspec.structs.replace(sample((10, 5, 45), (0, 0, 1)), status=status)
        found = vessel.turned(Batch("bow", 0, [one], as_sent(FLU_LEVEL)), one)
        assert (vessel.roll_pitch_rad(found) is not None) is has_attitude
        assert (vessel.true_rad(found, vessel.HeadingReference(Heading.TRUE)) is not None) is has_attitude
        assert (vessel.turn_rate_rad_s(found) == pytest.approx(radians(-1))) is not has_attitude
