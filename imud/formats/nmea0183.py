"""Sentences of NMEA 0183 (version 4.11, IEC 61162-1) that carry attitude, heading and rate of turn.

    $HCHDG,98.3,,,12.6,W*57<CR><LF>
     | |                 |
     | formatter         XOR of all between $ and *
     talker: two letters that name the kind of instrument

Angles are those of ships: heading clockwise from north, roll positive to starboard (right side down), pitch positive
with the bow up, rate of turn positive to starboard. That is the convention `ned-frd`. A value that is not known is an
empty field. The form of PASHR is that of inertial systems (Applanix, OxTS, Trimble); the standard has none.
"""

import math
from collections.abc import Iterable
from time import gmtime
from typing import Final, NamedTuple

from imud.units import NS_PER_MS, NS_PER_S

SENTENCE_BYTES_MAX: Final = 82
"""Of a sentence, with `$` and the line end (version 4.11, section 5.3.1)."""
_S_PER_MIN: Final = 60.0


class Transducer(NamedTuple):
    """One measurement of an XDR sentence."""

    kind: str
    """A: angular displacement, C: temperature, P: pressure."""
    value: float
    unit: str
    """D: degrees, C: degrees Celsius, B: bars."""
    name: str
    decimals: int = 2


def checksum(body: bytes) -> int:
    """XOR of all bytes; `body` stands between `$` and `*`."""
    result = 0
    for byte in body:
        result ^= byte
    return result


def sentence(body: str) -> bytes:
    """A sentence of what stands between `$` and `*`, with checksum and line end.

    Raises ValueError for what is longer than a sentence may be.
    """
    data = body.encode("ascii")
    made = b"$%b*%02X\r\n" % (data, checksum(data))
    if len(made) > SENTENCE_BYTES_MAX:
        raise ValueError(f"expected a sentence of at most {SENTENCE_BYTES_MAX} bytes, got {len(made)}: {body}")
    return made


def hdt(talker: str, heading_rad: float) -> bytes:
    """Heading from true north."""
    return sentence(f"{talker}HDT,{_bearing(heading_rad)},T")


def hdm(talker: str, heading_rad: float) -> bytes:
    """Heading from magnetic north; superseded by HDG, and still what some plotters read."""
    return sentence(f"{talker}HDM,{_bearing(heading_rad)},M")


def hdg(talker: str, heading_rad: float, variation_rad: float | None) -> bytes:
    """Heading from magnetic north, with the variation (east positive) where it is known; deviation is none."""
    variation = "," if variation_rad is None else f"{abs(math.degrees(variation_rad)):.1f},{'EW'[variation_rad < 0]}"
    return sentence(f"{talker}HDG,{_bearing(heading_rad)},,,{variation}")


def rot(talker: str, rate_rad_s: float) -> bytes:
    """Rate of turn, degrees per minute, positive to starboard."""
    return sentence(f"{talker}ROT,{_fixed(math.degrees(rate_rad_s) * _S_PER_MIN, 1)},A")


def xdr(talker: str, transducers: Iterable[Transducer]) -> bytes:
    """Measurements by name. Raises ValueError for more than fit into a sentence."""
    fields = [f"{one.kind},{_fixed(one.value, one.decimals)},{one.unit},{one.name}" for one in transducers]
    return sentence(f"{talker}XDR,{','.join(fields)}")


def pashr(utc_ns: int, heading_rad: float | None, roll_rad: float, pitch_rad: float) -> bytes:
    """Attitude with time: heading from true north, empty where it is not known; heave and accuracies are empty.

    Both flags are 0: no position, and an inertial sensor without satellites.
    """
    seconds, rest_ns = divmod(utc_ns, NS_PER_S)
    at = gmtime(seconds)
    time = f"{at.tm_hour:02}{at.tm_min:02}{at.tm_sec:02}.{rest_ns // NS_PER_MS:03}"
    heading = "" if heading_rad is None else _bearing(heading_rad, 2)
    roll, pitch = (f"{_rounded(math.degrees(angle), 2):+.2f}" for angle in (roll_rad, pitch_rad))
    return sentence(f"PASHR,{time},{heading},T,{roll},{pitch},,,,,0,0")


def _bearing(angle_rad: float, decimals: int = 1) -> str:
    """An angle of any turn as degrees from 0 to less than 360, also after rounding."""
    degrees = round(math.degrees(angle_rad) % 360.0, decimals)
    return f"{0.0 if degrees >= 360.0 else degrees:.{decimals}f}"


def _fixed(value: float, decimals: int) -> str:
    return f"{_rounded(value, decimals):.{decimals}f}"


def _rounded(value: float, decimals: int) -> float:
    """Rounded, and never a negative zero."""
    return round(value, decimals) + 0.0
