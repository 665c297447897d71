"""The schema of a sample describes every member in its order."""

import struct

import pytest

from imud.attitude.conventions import UNSETTLED_BIT
from imud.lines.sync import ALARM_STATUS
from imud.model import units
from imud.model.event import EventKind, kind_of
from imud.model.sample import SAMPLE_FIELDS, SAMPLE_SCHEMA, T_ERR_MOST, Sample

BY_NAME = {field.name: field for field in SAMPLE_SCHEMA}


def test_units_by_their_definitions_and_kinds_of_events_by_name() -> None:
    assert pytest.approx(57.295779513, rel=1e-9) == 1 / units.RAD_PER_DEG
    assert (units.STANDARD_GRAVITY_M_S2, units.T_PER_UT, units.PPM_PER_ONE) == (9.80665, 1e-6, 1e6)
    assert (units.NS_PER_S, units.NS_PER_MS, units.NS_PER_US) == (1e9, 1e6, 1e3)
    assert [units.uart_byte_ns(baud) for baud in (0, 9600, 1_000_000)] == [0, 1_041_666, 10_000], "10 bits per byte"
    # a newer daemon can send an unknown kind of event
    assert [kind_of(kind.value) for kind in EventKind] == list(EventKind)
    assert type(kind_of("mark")) is EventKind
    assert kind_of("eclipse") == "eclipse"


def test_every_member_has_its_row_in_its_place_with_its_meaning() -> None:
    assert tuple(BY_NAME) == SAMPLE_FIELDS
    optional = SAMPLE_FIELDS[-len(Sample.__struct_defaults__) :]
    assert [name for name, field in BY_NAME.items() if not field.always] == list(optional)
    assert ALARM_STATUS == 1 << 31
    assert all(f"bit {number}" in BY_NAME["status"].meaning for number in (31, UNSETTLED_BIT))
    meaning = BY_NAME["edge_seq"].meaning
    assert "rising edge on SOUT" in meaning
    assert "trigger on SIN" in meaning
    assert "PPS" not in meaning
    assert (BY_NAME["pps_age_ms"].unit, BY_NAME["pps_age_ms"].frame) == ("ms", "device clock")
    assert struct.pack("<I", T_ERR_MOST) == b"\xff" * 4
    with pytest.raises(struct.error):
        struct.pack("<I", T_ERR_MOST + 1)
