"""NMEA 0183 sentences, written by hand and read by pynmea2."""

import math
from datetime import UTC, datetime
from math import radians
from random import Random

import pynmea2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import nmea0183
from imud.formats.nmea0183 import Rmc, RmcFault, Transducer, as_gprmc, build, checksum, parse
from imud.model.units import NS_PER_S

ANGLES = st.floats(-4 * math.pi, 4 * math.pi)


def fields(sentence: bytes) -> list[str]:
    """Return the fields that pynmea2 reads between formatter and checksum. pynmea2 checks the checksum."""
    text = sentence.decode()
    assert text.endswith("\r\n")
    assert len(sentence) <= 82
    found: list[str] = pynmea2.parse(text, check=True).data
    return found


def test_headings_and_rates_of_turn() -> None:
    # from a Vector heading sensor, in the examples of gpsd
    assert nmea0183.hdg("HC", radians(101.1), radians(-7.1)) == b"$HCHDG,101.1,,,7.1,W*3C\r\n"
    assert fields(nmea0183.hdt("HE", radians(98.3))) == ["98.3", "T"]
    assert fields(nmea0183.hdm("HC", radians(-1.5))) == ["358.5", "M"]
    assert fields(nmea0183.hdg("HC", radians(7), None)) == ["7.0", "", "", "", ""]
    assert fields(nmea0183.hdg("HC", radians(7), radians(12.6))) == ["7.0", "", "", "12.6", "E"]
    assert fields(nmea0183.rot("TI", radians(2.5))) == ["150.0", "A"]
    assert fields(nmea0183.rot("TI", radians(-0.0004))) == ["0.0", "A"]
    assert float(pynmea2.parse(nmea0183.rot("TI", radians(-1)).decode()).rate_of_turn) == -60.0
    for degrees, shown in ((359.96, "0.0"), (-0.04, "0.0"), (359.94, "359.9"), (720, "0.0")):
        assert fields(nmea0183.hdt("HE", radians(degrees)))[0] == shown, "below 360 after rounding"


@given(ANGLES)
def test_any_heading_reads_back(angle_rad: float) -> None:
    message = pynmea2.parse(nmea0183.hdt("HE", angle_rad).decode(), check=True)
    heading_deg = float(message.heading)
    assert 0 <= heading_deg < 360
    off_deg = (heading_deg - math.degrees(angle_rad) + 180) % 360 - 180
    assert abs(off_deg) <= 0.0501


def test_transducers() -> None:
    made = nmea0183.xdr("YX", [Transducer("A", -3.256, "D", "PTCH"), Transducer("P", 1.01325, "B", "BARO", 5)])
    assert fields(made) == ["A", "-3.26", "D", "PTCH", "P", "1.01325", "B", "BARO"]
    angles = [Transducer("A", -179.99, "D", "PTCH"), Transducer("A", -179.99, "D", "ROLL")]
    rest = [Transducer("C", -40.5, "C", "TEMP", 1), Transducer("P", 1.01325, "B", "BARO", 5)]
    assert (len(fields(nmea0183.xdr("YX", angles + rest))), len(nmea0183.sentence("x" * 76))) == (16, 82)
    with pytest.raises(ValueError, match="at most 82 bytes"):
        nmea0183.xdr("YX", angles + rest + rest)


def test_attitude_with_time() -> None:
    # 2026-11-23 08:35:59.25 UTC
    made = nmea0183.pashr(1_795_422_959 * NS_PER_S + 250_000_000, radians(311.32), radians(1.5), radians(-0.004))
    assert made.startswith(b"$PASHR,083559.250,311.32,T,+1.50,+0.00,,,,,0,0*")
    assert nmea0183.checksum(made[1 : made.index(b"*")]) == int(made[-4:-2], 16)
    assert b",083559.250,,T," in nmea0183.pashr(1_795_422_959 * NS_PER_S + 250_000_000, None, 0, 0)
    assert nmea0183.checksum(b"") == 0
    assert nmea0183.checksum(b"AB") == 0x41 ^ 0x42


def unix_s(*when: int) -> int:
    return int(datetime(*when, tzinfo=UTC).timestamp())  # type: ignore[arg-type,misc]  # six numbers are a date


def sentence(body: str) -> bytes:
    return f"${body}*{checksum(body.encode()):02X}\r\n".encode()


UBLOX = b"$GPRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A*57\r\n"
CLASSIC = b"$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A"


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (UBLOX, Rmc(unix_s(2002, 12, 9, 8, 35, 59), 0, True)),
        (CLASSIC, Rmc(unix_s(1994, 3, 23, 12, 35, 19), 0, True)),
        (sentence("GNRMC,235959.1,A,,,,,,,311279,,,A"), Rmc(unix_s(2079, 12, 31, 23, 59, 59), 100_000_000, True)),
        (sentence("GNRMC,000000.123456789,A,,,,,,,060180,,,A,V"), Rmc(unix_s(1980, 1, 6, 0, 0, 0), 123_456_789, True)),
        (sentence("GPRMC,120000,V,,,,,,,010125,,"), Rmc(unix_s(2025, 1, 1, 12, 0, 0), 0, False)),
        (sentence("GPRMC,120000,A,,,,,,,010125,,,N"), Rmc(unix_s(2025, 1, 1, 12, 0, 0), 0, False)),
        (sentence("GPRMC,235960.50,A,,,,,,,311216,,,A"), Rmc(unix_s(2017, 1, 1, 0, 0, 0), 500_000_000, True, True)),
        (sentence("GPRMC,000000.,A,,,,,,,290224,,,A"), Rmc(unix_s(2024, 2, 29, 0, 0, 0), 0, True)),
    ],
)
def test_examples(data: bytes, expected: Rmc) -> None:
    assert parse(data) == expected


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (UBLOX.replace(b"083559", b"083558"), RmcFault.CHECKSUM), (UBLOX.replace(b"*57", b"*58"), RmcFault.CHECKSUM),
        (b"", RmcFault.FORM), (b"$GPRMC", RmcFault.FORM), (b"$GPGGA,083559.00,A,,,,,,,091202,,,A*00", RmcFault.FORM),
        (b"\x00" + UBLOX, RmcFault.FORM), (UBLOX + b"\r\n", RmcFault.FORM), (UBLOX[:-2] + b"\n\r", RmcFault.FORM),
        (b"$GPRMC" + b"," * 111 + b"*00", RmcFault.CHECKSUM), (b"$GPRMC" + b"," * 112 + b"*00", RmcFault.LENGTH),
        (sentence("GPRMC,120000,A,,,,,,010125"), RmcFault.FORM), (sentence("GPRMC,,V,,,,,,,,,,N"), RmcFault.CONTENT),
        (sentence("GPRMC,120000,V,,,,,,,,,,N"), RmcFault.CONTENT),
        (sentence("GPRMC,240000,A,,,,,,,010125,,,A"), RmcFault.CONTENT),
        (sentence("GPRMC,126000,A,,,,,,,010125,,,A"), RmcFault.CONTENT),
        (sentence("GPRMC,120061,A,,,,,,,010125,,,A"), RmcFault.CONTENT),
        (sentence("GPRMC,120000,A,,,,,,,290225,,,A"), RmcFault.CONTENT),
        (sentence("GPRMC,120000,A,,,,,,,000125,,,A"), RmcFault.CONTENT),
        (sentence("GPRMC,120000,A,,,,,,,011325,,,A"), RmcFault.CONTENT),
        (sentence("GPRMC,120000,A,,,,,,,010025,,,A"), RmcFault.CONTENT),
    ],
)  # fmt: skip
def test_faults_are_named(data: bytes, fault: RmcFault) -> None:
    assert parse(data) == fault


@given(st.integers(unix_s(1980, 1, 1, 0, 0, 0) * NS_PER_S, unix_s(2080, 1, 1, 0, 0, 0) * NS_PER_S - 1), st.booleans())
def test_built_sentences_contain_the_instant(utc_ns: int, valid: bool) -> None:
    data = build(utc_ns) if valid else build(utc_ns, valid=False)
    rmc = parse(data)
    assert isinstance(rmc, Rmc)
    assert (rmc.utc_ns, rmc.valid, rmc.leap) == (utc_ns // 10_000_000 * 10_000_000, valid, False)
    assert len(data) <= 82  # NMEA 0183
    when = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC)
    assert data.startswith(b"$GPRMC," + when.strftime("%H%M%S").encode())
    assert when.strftime(",%d%m%y,").encode() in data


def test_another_talker_becomes_gp_and_other_years_are_refused() -> None:
    other = sentence("GNRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A,V")
    changed = as_gprmc(other.rstrip())
    assert changed.startswith(b"$GPRMC,083559.00,A,4717.11437,N")
    assert parse(changed) == parse(other)
    assert as_gprmc(UBLOX) == UBLOX
    for data in (b"", CLASSIC[:-1], UBLOX.replace(b"*57", b"*58")):
        with pytest.raises(ValueError, match="expected an RMC sentence"):
            as_gprmc(data)
    for year in (1979, 2080):
        with pytest.raises(ValueError, match="expected a time from 1980 to 2079"):
            build(unix_s(year, 6, 1, 0, 0, 0) * NS_PER_S)


@given(st.binary(max_size=150))
def test_no_bytes_raise(data: bytes) -> None:
    for line in (data, b"$GPRMC," + data + b"*00"):
        assert isinstance(parse(line), Rmc | RmcFault)


def test_every_damaged_byte_is_detected() -> None:
    random, good = Random(3), parse(UBLOX)
    for at in range(1, len(UBLOX) - 2):
        other = random.choice([byte for byte in range(256) if byte != UBLOX[at]])
        damaged = UBLOX[:at] + bytes([other]) + UBLOX[at + 1 :]
        assert isinstance(parse(damaged), RmcFault) or parse(damaged) == good  # lower case is valid
    for at in range(len(UBLOX)):
        assert at >= len(UBLOX) - 2 or isinstance(parse(UBLOX[:at] + UBLOX[at + 1 :]), RmcFault)
