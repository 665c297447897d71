"""RMC sentences, compared with printed examples and a second implementation, and invalid bytes."""

from datetime import UTC, datetime
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats.nmea0183 import RMC_BYTES_MAX, Rmc, RmcFault, as_gprmc, build, checksum, parse
from imud.model.units import NS_PER_S


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
        (b"$GPRMC," + b"," * RMC_BYTES_MAX + b"*00", RmcFault.LENGTH),
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
    data = build(utc_ns, valid=valid)
    rmc = parse(data)
    assert isinstance(rmc, Rmc)
    assert (rmc.utc_ns, rmc.valid, rmc.leap) == (utc_ns // 10_000_000 * 10_000_000, valid, False)
    assert len(data) <= 82  # NMEA 0183
    when = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC)
    assert data.startswith(b"$GPRMC," + when.strftime("%H%M%S").encode())
    assert when.strftime(",%d%m%y,").encode() in data


@pytest.mark.parametrize("year", [1979, 2080])
def test_years_that_two_digits_cannot_say_are_refused(year: int) -> None:
    with pytest.raises(ValueError, match="expected a time from 1980 to 2079"):
        build(unix_s(year, 6, 1, 0, 0, 0) * NS_PER_S)


def test_another_talker_becomes_gp_with_the_same_values() -> None:
    other = sentence("GNRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A,V")
    changed = as_gprmc(other.rstrip())
    assert changed.startswith(b"$GPRMC,083559.00,A,4717.11437,N")
    assert parse(changed) == parse(other)
    assert as_gprmc(UBLOX) == UBLOX
    for data in (b"", CLASSIC[:-1], UBLOX.replace(b"*57", b"*58")):
        with pytest.raises(ValueError, match="expected an RMC sentence"):
            as_gprmc(data)


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
