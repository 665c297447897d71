"""Sentences with manually computed values, and headings only with a known reference."""

import math
from math import nan, radians

import pytest

from imud.attitude.conventions import Heading
from imud.model.sample import Sample, Sync, Vector3
from imud.publishers.nmea0183 import Formatter, HeadingReference, make, turn_rate_rad_s

MAGNETIC = HeadingReference(Heading.MAGNETIC)
CORRECTED = HeadingReference(Heading.TRUE, 3.0)
TRUE = HeadingReference(Heading.TRUE)


def sample(
    euler_deg: Vector3 | None = (1.0, -2.0, 45.0), gyro_deg_s: Vector3 | None = None,
    temperature_c: float | None = None, pressure_pa: float | None = None,
) -> Sample:  # fmt: skip
    euler = None if euler_deg is None else (radians(euler_deg[0]), radians(euler_deg[1]), radians(euler_deg[2]))
    gyro = None if gyro_deg_s is None else (radians(gyro_deg_s[0]), radians(gyro_deg_s[1]), radians(gyro_deg_s[2]))
    return Sample(
        "bow", 1, 0, 0, Sync.ARRIVAL, 0, 0, euler_rad=euler, gyro_rad_s=gyro, temperature_c=temperature_c,
        pressure_pa=pressure_pa,
    )  # fmt: skip


def body(kind: Formatter, one: Sample, reference: HeadingReference, talker: str = "") -> str | None:
    """Return the text between `$` and `*`."""
    made = make(kind, one, reference, talker)
    return None if made is None else made.decode().removeprefix("$").partition("*")[0]


@pytest.mark.parametrize(
    ("reference", "sentences"),
    [
        (MAGNETIC, (None, "HCHDG,45.0,,,,", "HCHDM,45.0,M")),
        (CORRECTED, ("HCHDT,45.0,T", "HCHDG,42.0,,,3.0,E", "HCHDM,42.0,M")),
        (TRUE, ("HCHDT,45.0,T", None, None)),  # a true heading from the device has no magnetic heading
        (HeadingReference(Heading.RELATIVE), (None, None, None)),  # relative to the direction at power-on
        (HeadingReference(Heading.UNKNOWN), (None, None, None)),
    ],
)
def test_a_heading_is_sent_with_its_reference(reference: HeadingReference, sentences: tuple[str | None, ...]) -> None:
    kinds = (Formatter.HDT, Formatter.HDG, Formatter.HDM)
    assert tuple(body(kind, sample(), reference) for kind in kinds) == sentences
    if sentences == (None, None, None):
        assert body(Formatter.PASHR, sample(), reference) == "PASHR,000000.000,,T,+1.00,-2.00,,,,,0,0"


def test_roll_pitch_temperature_pressure() -> None:
    one = sample(temperature_c=23.44, pressure_pa=101_325.0)
    assert body(Formatter.XDR, one, MAGNETIC) == "YXXDR,A,-2.00,D,PTCH,A,1.00,D,ROLL,C,23.4,C,TEMP,P,1.01325,B,BARO"
    assert body(Formatter.XDR, sample(euler_deg=(nan, 1, 2), temperature_c=nan), MAGNETIC) is None
    assert body(Formatter.XDR, sample(euler_deg=None), MAGNETIC) is None


def test_the_configured_talker_is_used_for_all_sentences() -> None:
    assert body(Formatter.HDT, sample(), TRUE, "II") == "IIHDT,45.0,T"
    assert str(body(Formatter.PASHR, sample(), TRUE, "II")).startswith("PASHR,")


def test_the_rate_of_turn_is_the_rate_of_the_heading() -> None:
    level = sample((0, 0, 0), (5, 5, 2))
    assert turn_rate_rad_s(level) == pytest.approx(radians(2))
    # right side down by 90°: a rotation about y changes the heading
    assert turn_rate_rad_s(sample((90, 0, 0), (0, 3, 0))) == pytest.approx(radians(3))
    # bow up by 60°: the heading turns twice as fast as the body about its z axis
    assert turn_rate_rad_s(sample((0, 60, 0), (0, 0, 1))) == pytest.approx(radians(2))
    assert turn_rate_rad_s(sample(None, (0, 0, 1))) == pytest.approx(radians(1))


def test_there_is_no_rate_of_turn_with_the_bow_straight_up_or_without_rates() -> None:
    assert turn_rate_rad_s(sample((0, 85, 0), (0, 0, 1))) is None
    assert turn_rate_rad_s(sample((0, 0, 0))) is None
    assert turn_rate_rad_s(sample((0, 0, 0), (0, 0, math.inf))) is None
    assert body(Formatter.ROT, sample((0, 0, 0), (0, 0, 1.5)), MAGNETIC) == "TIROT,90.0,A"


@pytest.mark.parametrize("kind", Formatter)
def test_a_sample_without_values_makes_no_sentence(kind: Formatter) -> None:
    assert make(kind, sample(euler_deg=None), CORRECTED) is None
