"""Sentences of NMEA 0183 (version 4.11, IEC 61162-1) with attitude, heading and rate of turn.

    $HCHDG,98.3,,,12.6,W*57<CR><LF>
     | |                 |
     | formatter         XOR of all bytes between $ and *
     talker: two letters for the kind of instrument

Angles have the convention of ships, `ned-frd`: heading clockwise from north, roll positive to starboard (right side
down), pitch positive with the bow up, rate of turn positive to starboard. An unknown value is an empty field. PASHR has
the form of inertial systems (Applanix, OxTS, Trimble); the standard does not define PASHR.
"""

import math
import re
from calendar import timegm
from collections.abc import Iterable, Sequence
from enum import StrEnum
from time import gmtime
from typing import Final, NamedTuple

from imud.model.units import NS_PER_MS, NS_PER_S

# Maximum length of a sentence with `$` and line end, bytes (version 4.11, section 5.3.1)
SENTENCE_BYTES_MAX: Final = 82
_S_PER_MIN: Final = 60.0


class Transducer(NamedTuple):
    """One value of an XDR sentence."""

    kind: str  # A: angular displacement, C: temperature, P: pressure
    value: float
    unit: str  # D: degrees, C: degrees Celsius, B: bars
    name: str
    decimals: int = 2


def checksum(body: bytes) -> int:
    """Return the XOR of all bytes of `body`, the part between `$` and `*`."""
    result = 0
    for byte in body:
        result ^= byte
    return result


def sentence(body: str) -> bytes:
    """Return a sentence with checksum and line end for `body`. Raises ValueError if it is too long."""
    data = body.encode("ascii")
    made = b"$%b*%02X\r\n" % (data, checksum(data))
    if len(made) > SENTENCE_BYTES_MAX:
        raise ValueError(f"expected a sentence of at most {SENTENCE_BYTES_MAX} bytes, got {len(made)}: {body}")
    return made


def hdt(talker: str, heading_rad: float) -> bytes:
    """Return a sentence with the heading from true north."""
    return sentence(f"{talker}HDT,{_bearing(heading_rad)},T")


def hdm(talker: str, heading_rad: float) -> bytes:
    """Return a sentence with the heading from magnetic north. HDG replaces it; some plotters read only HDM."""
    return sentence(f"{talker}HDM,{_bearing(heading_rad)},M")


def hdg(talker: str, heading_rad: float, variation_rad: float | None) -> bytes:
    """Return a sentence with the heading from magnetic north and the known variation (east positive)."""
    variation = "," if variation_rad is None else f"{abs(math.degrees(variation_rad)):.1f},{'EW'[variation_rad < 0]}"
    return sentence(f"{talker}HDG,{_bearing(heading_rad)},,,{variation}")


def rot(talker: str, rate_rad_s: float) -> bytes:
    """Return a sentence with the rate of turn, degrees per minute, positive to starboard."""
    return sentence(f"{talker}ROT,{_fixed(math.degrees(rate_rad_s) * _S_PER_MIN, 1)},A")


def xdr(talker: str, transducers: Iterable[Transducer]) -> bytes:
    """Return a sentence of named values. Raises ValueError if they do not fit into one sentence."""
    fields = [f"{one.kind},{_fixed(one.value, one.decimals)},{one.unit},{one.name}" for one in transducers]
    return sentence(f"{talker}XDR,{','.join(fields)}")


def pashr(utc_ns: int, heading_rad: float | None, roll_rad: float, pitch_rad: float) -> bytes:
    """Return a sentence of attitude and time. An unknown heading, heave and the accuracies are empty. Both flags are 0:
    no position, and an inertial sensor without satellites."""
    seconds, rest_ns = divmod(utc_ns, NS_PER_S)
    at = gmtime(seconds)
    time = f"{at.tm_hour:02}{at.tm_min:02}{at.tm_sec:02}.{rest_ns // NS_PER_MS:03}"
    heading = "" if heading_rad is None else _bearing(heading_rad, 2)
    roll, pitch = (f"{_rounded(math.degrees(angle), 2):+.2f}" for angle in (roll_rad, pitch_rad))
    return sentence(f"PASHR,{time},{heading},T,{roll},{pitch},,,,,0,0")


def _bearing(angle_rad: float, decimals: int = 1) -> str:
    """Return an angle of any turn in degrees, from 0 to less than 360 also after rounding."""
    degrees = round(math.degrees(angle_rad) % 360.0, decimals)
    return f"{0.0 if degrees >= 360.0 else degrees:.{decimals}f}"


def _fixed(value: float, decimals: int) -> str:
    return f"{_rounded(value, decimals):.{decimals}f}"


def _rounded(value: float, decimals: int) -> float:
    # + 0.0 removes a negative zero
    return round(value, decimals) + 0.0


# Maximum length of an RMC sentence, bytes. The standard permits 82; receivers with millimetres send about 100.
RMC_BYTES_MAX: Final = 120
FIRST_YEAR: Final = 1980
HUNDREDTH_NS: Final = 10 * NS_PER_MS

_SENTENCE: Final = re.compile(rb"\$([A-Z]{2})RMC,([\x20-\x29\x2b-\x7e]*)\*([0-9A-Fa-f]{2})(?:\r?\n)?")
_TIME: Final = re.compile(rb"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9]|60)(?:\.([0-9]{0,9}))?")
_DATE: Final = re.compile(rb"([0-3][0-9])([01][0-9])([0-9]{2})")
_STATUS, _DAY, _MODE = 1, 8, 11  # indices of the fields; field 0 is the time


class RmcFault(StrEnum):
    """Reasons to reject an RMC sentence."""

    LENGTH = "length"  # the sentence is longer than RMC_BYTES_MAX
    FORM = "form"  # not an RMC sentence: another sentence, an incomplete sentence, or noise
    CHECKSUM = "checksum"  # the checksum does not match
    CONTENT = "content"  # Time or date is missing or impossible. Receivers without a fix may send empty fields.


class Rmc(NamedTuple):
    """Date and time of an RMC sentence."""

    unix_s: int  # seconds since 1970-01-01
    fraction_ns: int  # fraction of the second, 0 … 999 999 999
    valid: bool  # whether the receiver reports a fix: status A, and mode not N
    leap: bool = False  # whether the second is a leap second (60). `unix_s` is then the following second.

    @property
    def utc_ns(self) -> int:
        """Instant of the sentence, ns since 1970-01-01."""
        return self.unix_s * NS_PER_S + self.fraction_ns


def parse(sentence: bytes) -> Rmc | RmcFault:
    """Return the decoded sentence, with or without line end, or the fault of other bytes. Never raises an exception."""
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
    """Return a `$GPRMC` sentence for an instant (ns since 1970-01-01, from 1980 to 2079), truncated to 10 ms. The
    sentence is for time only: the position is 0° N 0° E. Raises ValueError for other years."""
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
    """Return an RMC sentence of any talker as `$GPRMC` with line end. Raises ValueError for other sentences."""
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
    """Return the start of a day in Unix seconds; None if the day does not exist."""
    year = FIRST_YEAR - FIRST_YEAR % 100 + year_of_century
    year += 100 * (year < FIRST_YEAR)
    try:
        seconds = timegm((year, month, day, 0, 0, 0))
    except ValueError:
        return None
    # timegm accepts impossible days, for example February 30
    return seconds if gmtime(seconds)[:3] == (year, month, day) else None
