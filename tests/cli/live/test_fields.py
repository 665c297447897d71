"""Samples as JSON and as CSV of chosen fields: names with units, absent values, and what RFC 4180 wants."""

import csv
import io
import json
import math

import msgspec
import pytest

from imud.cli.live.fields import PARTS, as_csv, as_json, chosen_fields, csv_head
from imud.errors import BadArgument
from imud.sample import SAMPLE_FIELDS, SAMPLE_SCHEMA, Sample, Sync

ONE = Sample("bow", 7, 12_345_678_900, 250_000, Sync.EDGE, 12_350_000_000, 0)
WHOLE = msgspec.structs.replace(ONE, accel_m_s2=(0.5, -1.25, 9.8), quat_wxyz=(1.0, 0.0, 0.0, 0.0), status=8)


def test_fields_come_in_the_order_in_which_they_are_named() -> None:
    assert chosen_fields("t_ns, accel_m_s2,device") == ("t_ns", "accel_m_s2", "device")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_ns,accel", ['got "accel"; did you mean accel_m_s2? known: accel_m_s2, device, ']),
        ("", ['got ""', "known: accel_m_s2"]),
        ("t_ns,,seq", ['got ""']),
        ("seq,t_ns,seq", ["expected each field once, got seq twice"]),
    ],
)
def test_wrong_names_are_an_error_that_lists_the_known_ones(text: str, words: list[str]) -> None:
    with pytest.raises(BadArgument) as caught:
        chosen_fields(text)
    assert all(word in str(caught.value) for word in ["--fields: ", *words])


def test_json_leaves_absent_fields_out() -> None:
    assert json.loads(as_json(ONE)) == {
        "device": "bow", "seq": 7, "t_ns": 12_345_678_900, "t_err_ns": 250_000, "sync": "edge",
        "t_rx_ns": 12_350_000_000, "utc_ns": 0,
    }  # fmt: skip
    assert as_json(WHOLE, ("t_ns", "gyro_rad_s", "accel_m_s2")) == ('{"t_ns":12345678900,"accel_m_s2":[0.5,-1.25,9.8]}')


def test_every_array_has_a_column_for_each_of_its_numbers() -> None:
    lengths = {field.name: int(field.type[7:-1]) for field in SAMPLE_SCHEMA if field.type.startswith("number[")}
    assert {name: len(columns) for name, columns in PARTS.items()} == lengths


def test_the_header_has_units_and_the_lines_have_as_many_cells() -> None:
    assert csv_head(("device", "accel_m_s2", "euler_rad", "quat_wxyz")) == (
        "device,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2,roll_rad,pitch_rad,yaw_rad,quat_w,quat_x,quat_y,quat_z\r\n"
    )
    head, *rows = csv.reader(io.StringIO(csv_head(SAMPLE_FIELDS) + as_csv(ONE, SAMPLE_FIELDS)), strict=True)
    assert len(head) == len(set(head)) == len(rows[0])


def test_absent_values_are_empty_and_nan_is_not() -> None:
    fields = ("seq", "sync", "accel_m_s2", "gyro_rad_s", "status", "temperature_c")
    assert as_csv(WHOLE, fields) == "7,edge,0.5,-1.25,9.8,,,,8,\r\n"
    strange = msgspec.structs.replace(WHOLE, temperature_c=math.nan)
    assert as_csv(strange, ("temperature_c", "seq")) == "nan,7\r\n"


def test_names_that_need_it_are_quoted() -> None:
    odd = msgspec.structs.replace(ONE, device='a "b", c')
    text = as_csv(odd, ("device", "seq"))
    assert text == '"a ""b"", c",7\r\n'
    assert list(csv.reader([text], strict=True)) == [['a "b", c', "7"]]
