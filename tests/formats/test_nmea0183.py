"""NMEA 0183 sentences, written by hand and read by pynmea2."""

import math
from math import radians

import pynmea2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import nmea0183
from imud.formats.nmea0183 import SENTENCE_BYTES_MAX, Transducer
from imud.model.units import NS_PER_S

ANGLES = st.floats(-4 * math.pi, 4 * math.pi)


def fields(sentence: bytes) -> list[str]:
    """Return the fields that pynmea2 reads between formatter and checksum. pynmea2 checks the checksum."""
    text = sentence.decode()
    assert text.endswith("\r\n")
    assert len(sentence) <= SENTENCE_BYTES_MAX
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


@pytest.mark.parametrize(("degrees", "shown"), [(359.96, "0.0"), (-0.04, "0.0"), (359.94, "359.9"), (720, "0.0")])
def test_a_heading_is_below_360_after_rounding(degrees: float, shown: str) -> None:
    assert fields(nmea0183.hdt("HE", radians(degrees)))[0] == shown


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
    assert len(fields(nmea0183.xdr("YX", angles + rest))) == 16
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
