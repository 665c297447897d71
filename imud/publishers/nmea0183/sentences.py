"""Which sentences can be made of a sample, and their values: headings only with the reference they name.

    sample as ned-frd, reference of its heading ──▶ HDT HDG HDM ROT XDR PASHR, each bytes or None

| heading counts from | HDT, PASHR | HDG, HDM |
|---|---|---|
| true north, by `declination_deg` | the heading | less the declination, which is the variation of HDG |
| true north, by the device itself | the heading | none |
| magnetic north | none; PASHR without heading | the heading |
| the direction at power-on, or it is not known | none; PASHR without heading | none |

A direction at power-on looks like a heading on every display, so it is never sent as one.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from imud.formats import nmea0183
from imud.formats.nmea0183 import Transducer
from imud.frames.conventions import Heading
from imud.sample import Sample, Vector3

PA_PER_BAR: Final = 100_000.0
LEVEL_COS: Final = 0.1
"""Below this cosine of pitch (84°) heading and roll turn about nearly the same axis: there is no rate of turn."""


class Formatter(StrEnum):
    """Sentences by their formatters."""

    HDT = "HDT"
    HDG = "HDG"
    HDM = "HDM"
    ROT = "ROT"
    XDR = "XDR"
    PASHR = "PASHR"


TALKERS: Final[Mapping[Formatter, str]] = {
    Formatter.HDT: "HC",
    Formatter.HDG: "HC",
    Formatter.HDM: "HC",
    Formatter.ROT: "TI",
    Formatter.XDR: "YX",
    Formatter.PASHR: "",
}
"""HC: magnetic compass, also where its heading is corrected to a true one, TI: rate of turn, YX: transducer.

gpsd 3.22 knows HC and II as talkers of a heading, and neither HE nor HN, gyroscopic compasses. PASHR has no talker."""


@dataclass(frozen=True, slots=True)
class HeadingReference:
    """What the yaw of samples counts from."""

    heading: Heading = Heading.UNKNOWN
    declination_deg: float | None = None
    """What was added to a magnetic heading to make it a true one; None for nothing."""


def make(kind: Formatter, sample: Sample, reference: HeadingReference, talker: str = "") -> bytes | None:
    """The sentence of a sample whose axes and angles are those of `ned-frd`; None where the sample has not its values.

    `talker` takes the place of the one in TALKERS; empty keeps that.
    """
    return _MAKERS[kind](talker or TALKERS[kind], sample, reference)


def _hdt(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = _true_rad(sample, reference)
    return None if heading_rad is None else nmea0183.hdt(talker, heading_rad)


def _hdg(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = _magnetic_rad(sample, reference)
    declination_deg = reference.declination_deg
    variation_rad = None if declination_deg is None else math.radians(declination_deg)
    return None if heading_rad is None else nmea0183.hdg(talker, heading_rad, variation_rad)


def _hdm(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = _magnetic_rad(sample, reference)
    return None if heading_rad is None else nmea0183.hdm(talker, heading_rad)


def _rot(talker: str, sample: Sample, _reference: HeadingReference) -> bytes | None:
    rate_rad_s = turn_rate_rad_s(sample)
    return None if rate_rad_s is None else nmea0183.rot(talker, rate_rad_s)


def _xdr(talker: str, sample: Sample, _reference: HeadingReference) -> bytes | None:
    found = []
    roll_pitch = _roll_pitch_rad(sample)
    if roll_pitch is not None:
        roll_rad, pitch_rad = roll_pitch
        found.append(Transducer("A", math.degrees(pitch_rad), "D", "PTCH"))
        found.append(Transducer("A", math.degrees(roll_rad), "D", "ROLL"))
    if sample.temperature_c is not None and math.isfinite(sample.temperature_c):
        found.append(Transducer("C", sample.temperature_c, "C", "TEMP", decimals=1))
    if sample.pressure_pa is not None and math.isfinite(sample.pressure_pa):
        found.append(Transducer("P", sample.pressure_pa / PA_PER_BAR, "B", "BARO", decimals=5))
    return nmea0183.xdr(talker, found) if found else None


def _pashr(_talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    roll_pitch = _roll_pitch_rad(sample)
    if roll_pitch is None:
        return None
    return nmea0183.pashr(sample.utc_ns, _true_rad(sample, reference), *roll_pitch)


_MAKERS: Final[Mapping[Formatter, Callable[[str, Sample, HeadingReference], bytes | None]]] = {
    Formatter.HDT: _hdt,
    Formatter.HDG: _hdg,
    Formatter.HDM: _hdm,
    Formatter.ROT: _rot,
    Formatter.XDR: _xdr,
    Formatter.PASHR: _pashr,
}


def turn_rate_rad_s(sample: Sample) -> float | None:
    """Rate of change of the heading, positive to starboard; None without an angular rate, or with the bow straight up.

    With roll φ and pitch θ it is (q sin φ + r cos φ) / cos θ of the angular rates q about y and r about z, so that
    rolling and pitching do not show in it. Without an attitude the body is taken for level.
    """
    gyro = sample.gyro_rad_s
    if gyro is None or not all(map(math.isfinite, gyro)):
        return None
    roll_rad, pitch_rad = _roll_pitch_rad(sample) or (0.0, 0.0)
    if math.cos(pitch_rad) < LEVEL_COS:
        return None
    return (gyro[1] * math.sin(roll_rad) + gyro[2] * math.cos(roll_rad)) / math.cos(pitch_rad)


def _true_rad(sample: Sample, reference: HeadingReference) -> float | None:
    return _yaw_rad(sample.euler_rad) if reference.heading is Heading.TRUE else None


def _magnetic_rad(sample: Sample, reference: HeadingReference) -> float | None:
    yaw_rad = _yaw_rad(sample.euler_rad)
    if yaw_rad is None or reference.heading is Heading.MAGNETIC:
        return yaw_rad
    if reference.heading is Heading.TRUE and reference.declination_deg is not None:
        return yaw_rad - math.radians(reference.declination_deg)
    return None


def _yaw_rad(euler_rad: Vector3 | None) -> float | None:
    return euler_rad[2] if euler_rad is not None and math.isfinite(euler_rad[2]) else None


def _roll_pitch_rad(sample: Sample) -> tuple[float, float] | None:
    euler_rad = sample.euler_rad
    if euler_rad is None or not (math.isfinite(euler_rad[0]) and math.isfinite(euler_rad[1])):
        return None
    return euler_rad[0], euler_rad[1]
