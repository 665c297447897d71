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
import re
from calendar import timegm
from collections.abc import Iterable, Sequence
from enum import StrEnum
from time import gmtime
from typing import Final, NamedTuple

from imud.model.units import NS_PER_MS, NS_PER_S

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


RMC_BYTES_MAX: Final = 120
"""NMEA 0183 allows 82; receivers that give positions to the millimetre send up to some 100."""
FIRST_YEAR: Final = 1980
HUNDREDTH_NS: Final = 10 * NS_PER_MS

_SENTENCE: Final = re.compile(rb"\$([A-Z]{2})RMC,([\x20-\x29\x2b-\x7e]*)\*([0-9A-Fa-f]{2})(?:\r?\n)?")
_TIME: Final = re.compile(rb"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9]|60)(?:\.([0-9]{0,9}))?")
_DATE: Final = re.compile(rb"([0-3][0-9])([01][0-9])([0-9]{2})")
_STATUS, _DAY, _MODE = 1, 8, 11  # numbers of the fields after the time


class RmcFault(StrEnum):
    """Reasons why bytes are not a usable sentence."""

    LENGTH = "length"
    """Longer than SENTENCE_BYTES_MAX."""
    FORM = "form"
    """Not an RMC sentence: another sentence, an incomplete one, or noise."""
    CHECKSUM = "checksum"
    """The checksum does not match."""
    CONTENT = "content"
    """Time or date is missing or impossible; a receiver without a fix may send them empty."""


class Rmc(NamedTuple):
    """The date and time of a sentence."""

    unix_s: int
    """The second it names, since 1970-01-01."""
    fraction_ns: int
    """Rest of its time, 0 … 999 999 999."""
    valid: bool
    """Whether the receiver reports a fix: status A, and mode not N."""
    leap: bool = False
    """Whether the second is a leap second (60); `unix_s` is then that of the second after."""

    @property
    def utc_ns(self) -> int:
        """The instant, ns since 1970-01-01."""
        return self.unix_s * NS_PER_S + self.fraction_ns


def parse(sentence: bytes) -> Rmc | RmcFault:
    """Decode a sentence, with or without its line end. Returns the fault of any other bytes; never raises."""
    if len(sentence) > RMC_BYTES_MAX:
        return RmcFault.LENGTH
    match = _SENTENCE.fullmatch(sentence)
    if match is None:
        return RmcFault.FORM
    if checksum(sentence[1 : match.end(2)]) != int(match[3], 16):
        return RmcFault.CHECKSUM
    fields = match[2].split(b",")
    return _content(fields) if len(fields) > _DAY else RmcFault.FORM


def build(utc_ns: int, *, valid: bool = True) -> bytes:
    """A `$GPRMC` sentence for an instant (ns since 1970-01-01, from 1980 to 2079), truncated to hundredths of a second.

    For time only: the position is 0° N 0° E. Raises ValueError outside those years.
    """
    unix_s, rest_ns = divmod(utc_ns, NS_PER_S)
    at = gmtime(unix_s)
    if not FIRST_YEAR <= at.tm_year < FIRST_YEAR + 100:
        raise ValueError(f"expected a time from {FIRST_YEAR} to {FIRST_YEAR + 99}, got the year {at.tm_year}")
    time = f"{at.tm_hour:02}{at.tm_min:02}{at.tm_sec:02}.{rest_ns // HUNDREDTH_NS:02}"
    date = f"{at.tm_mday:02}{at.tm_mon:02}{at.tm_year % 100:02}"
    status, mode = ("A", "A") if valid else ("V", "N")
    body = f"GPRMC,{time},{status},0000.0000,N,00000.0000,E,0.0,0.0,{date},,,{mode}".encode("ascii")
    return b"$%b*%02X\r\n" % (body, checksum(body))


def as_gprmc(sentence: bytes) -> bytes:
    """A well-formed RMC sentence of any talker as `$GPRMC` with its line end, for devices that know no other talker.

    Raises ValueError for bytes that `parse` refuses.
    """
    match = _SENTENCE.fullmatch(sentence)
    if match is None or isinstance(parse(sentence), RmcFault):
        raise ValueError(f"expected an RMC sentence, got {sentence[:RMC_BYTES_MAX]!r}")
    body = b"GPRMC," + match[2]
    return b"$%b*%02X\r\n" % (body, checksum(body))


def _content(fields: Sequence[bytes]) -> Rmc | RmcFault:
    time, date = _TIME.fullmatch(fields[0]), _DATE.fullmatch(fields[_DAY])
    midnight_s = date and _midnight_s(int(date[3]), int(date[2]), int(date[1]))
    if time is None or midnight_s is None:
        return RmcFault.CONTENT
    hour, minute, second = int(time[1]), int(time[2]), int(time[3])
    no_fix = len(fields) > _MODE and fields[_MODE] == b"N"
    return Rmc(
        midnight_s + 3600 * hour + 60 * minute + second,
        int((time[4] or b"").ljust(9, b"0")),
        fields[_STATUS] == b"A" and not no_fix,
        second == 60,
    )


def _midnight_s(year_of_century: int, month: int, day: int) -> int | None:
    """Unix seconds of a day's beginning, None if there is no such day."""
    year = FIRST_YEAR - FIRST_YEAR % 100 + year_of_century
    year += 100 * (year < FIRST_YEAR)
    try:
        seconds = timegm((year, month, day, 0, 0, 0))
    except ValueError:
        return None
    return seconds if gmtime(seconds)[:3] == (year, month, day) else None
