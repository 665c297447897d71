"""Line protocol: golden lines, escapes, and every value with an independent parser."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats.influx import (
    DistinctTimes,
    Value,
    cut,
    event_fields,
    head,
    ledger_line,
    line,
    measure_fields,
    sample_fields,
)
from imud.model.event import Event, EventKind
from imud.model.ledger import LEDGER_FIELDS
from imud.model.sample import SAMPLE_FIELDS, Position, Sample, Sync
from tests.support.line_protocol import parse_line

UTC_NS = 1_790_000_000_000_000_000
FULL = Sample(
    "bow", 7, 1, 2, Sync.EDGE, 3, UTC_NS, 4, (1.0, -0.0, 9.75), (1e-05, 0.5, math.nan), (1e-6, 0.0, 2e-06),
    (1.0, 0.0, 0.0, 0.0), (0.25, 0.5, -3.0), 21.5, 101325.0, (0.125, math.inf), 5, 6, 8, (1.5, 2.5, 3.5),
    Position(0.5, -0.25, 12.5, 4, 17), 0.75, UTC_NS + 1,
)  # fmt: skip


def test_golden_lines() -> None:
    sample = Sample("bow", 7, 1, 2, Sync.EDGE, 3, UTC_NS, accel_m_s2=(0.375, 0.0, 9.75), temperature_c=21, status=0)
    series = head("imud_sample", {"gateway": "gw-17", "site": "", "device": "bow"})
    assert line(series, sample_fields(sample), UTC_NS) == (
        'imud_sample,device=bow,gateway=gw-17 seq=7i,t_ns=1i,t_err_ns=2i,sync="edge",t_rx_ns=3i,accel_m_s2_x=0.375,'
        "accel_m_s2_y=0.0,accel_m_s2_z=9.75,temperature_c=21.0,status=0i 1790000000000000000\n"
    )
    assert line("imud_sample", sample_fields(FULL), -1) == (
        'imud_sample seq=7i,t_ns=1i,t_err_ns=2i,sync="edge",t_rx_ns=3i,accel_m_s2_x=1.0,accel_m_s2_y=-0.0,'
        "accel_m_s2_z=9.75,gyro_rad_s_x=1e-05,gyro_rad_s_y=0.5,mag_t_x=1e-06,mag_t_y=0.0,mag_t_z=2e-06,quat_wxyz_w=1.0,"
        "quat_wxyz_x=0.0,quat_wxyz_y=0.0,quat_wxyz_z=0.0,euler_rad_roll=0.25,euler_rad_pitch=0.5,euler_rad_yaw=-3.0,"
        "incli_rad_x=0.125,velocity_enu_m_s_east=1.5,velocity_enu_m_s_north=2.5,velocity_enu_m_s_up=3.5,"
        "temperature_c=21.5,pressure_pa=101325.0,heave_m=0.75,t_dev_ns=4i,status=5i,pps_age_ms=6i,edge_seq=8i,"
        "gnss_utc_ns=1790000000000000001i,latitude_rad=0.5,longitude_rad=-0.25,height_m=12.5,position_quality=4i,"
        "satellites=17i -1\n"
    )
    event = Event(1, "bow", EventKind.UP, 'a "b" \\ c\nd', {"x": 'y"'})
    assert line("e", event_fields(event), 5) == (
        r'e message="a \"b\" \\ c d",detail="{\"x\":\"y\\\"\"}",t_ns=1i 5' + "\n"
    )
    assert ledger_line("l", range(len(LEDGER_FIELDS)), 5).startswith("l bytes_in=0i,bytes_in_good_frames=1i,")
    assert list(measure_fields("accel_m_s2", "min", (1, 2, 3)))[1:] == [
        ("accel_m_s2_y_min", 2.0), ("accel_m_s2_z_min", 3.0),
    ]  # fmt: skip
    assert list(measure_fields("heave_m", "rms", (1.5,))) == [("heave_m_rms", 1.5)]


def test_no_field_of_a_sample_is_forgotten() -> None:
    names = {name for name, value in sample_fields(FULL) if value is not None}
    position = {"latitude_rad", "longitude_rad", "height_m", "position_quality", "satellites"}
    for field in set(SAMPLE_FIELDS) - {"device", "utc_ns", "position"}:
        assert any(name == field or name.startswith(f"{field}_") for name in names), field
    assert position <= names


@pytest.mark.parametrize(
    ("measurement", "tags", "fields", "expected"),
    [
        ("a b,c=d", {"x=y z": "1, 2"}, {"f g": 1}, r"a\ b\,c\=d,x\=y\ z=1\,\ 2 f\ g=1i 5"),
        ("m", {"t": "end\\", "u": "new\nline"}, {"f": True}, r"m,t=end/,u=new\ line f=true 5"),
        ("m", {}, {"f": math.nan, "g": math.inf, "h": 1 << 63, "i": None, "j": -5}, "m j=-5i 5"),
        ("m", {}, {"f": math.nan}, ""),
    ],
)  # fmt: skip
def test_escapes_and_values_that_line_protocol_cannot_represent(
    measurement: str, tags: dict[str, str], fields: dict[str, Value], expected: str
) -> None:
    assert line(head(measurement, tags), fields.items(), 5) == (f"{expected}\n" if expected else "")


NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\n\r\\"), min_size=1)
VALUES = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False), st.booleans(), st.integers(-(1 << 62), 1 << 62),
    st.text(st.characters(codec="utf-8", exclude_characters="\n\r")),
)  # fmt: skip


@given(
    NAMES, st.dictionaries(NAMES, NAMES), st.dictionaries(NAMES, VALUES, min_size=1), st.integers(-(1 << 62), 1 << 62)
)
def test_an_independent_parser_reads_the_same_values(
    measurement: str, tags: dict[str, str], fields: dict[str, Value], utc_ns: int
) -> None:
    assert parse_line(line(head(measurement, tags), fields.items(), utc_ns)) == (measurement, tags, fields, utc_ns)


@given(st.lists(st.integers(1, 9)), st.integers(1, 20))
def test_a_piece_has_complete_lines(lengths: list[int], bytes_max: int) -> None:
    lines = [b"x" * (length - 1) + b"\n" for length in lengths]
    pieces = list(cut(b"".join(lines), bytes_max))
    assert b"".join(pieces) == b"".join(lines)
    assert all(one.endswith(b"\n") and (len(one) <= bytes_max or one.count(b"\n") == 1) for one in pieces)
    assert all(len(one) + len(two.splitlines(keepends=True)[0]) > bytes_max for one, two in pairwise(pieces))


def test_events_of_one_series_have_distinct_times() -> None:
    times = DistinctTimes()
    assert [times.at(name, ns) for name, ns in (("a", 5), ("a", 5), ("b", 5), ("a", 5), ("a", 4))] == [5, 6, 5, 7, 4]
