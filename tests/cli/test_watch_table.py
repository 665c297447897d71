"""Table of samples: columns, units, 80 columns, repeated header. JSON and CSV of chosen fields (RFC 4180)."""

import csv
import io
import json
import math
import os
import sys
from unittest.mock import Mock

import msgspec
import pytest

from imud.cli.watch import FIELDS, OUTPUTS, SampleTable, lines_of, usual_fields
from imud.model.sample import SAMPLE_FIELDS, Position, Sample, Sync
from tests.cli.conftest import Terminal

UTC_NS = 1_790_000_000_123_999_999  # 2026-09-21 14:13:20 UTC
ONE = Sample("bow", 7, 12_345_678_900, 250_000, Sync.EDGE, 12_350_000_000, UTC_NS)
WHOLE = msgspec.structs.replace(
    ONE, euler_rad=(0.1, -0.2, 3.0), gyro_rad_s=(1.0, 0.0, -1.0), accel_m_s2=(0.0, 0.5, 9.8), temperature_c=31.5
)
LARGEST = Sample(
    "n" * 31 + "m", 10**9 - 1, 9_999_999_000_000_000, 4_294_967_295, Sync.REGRESSION, 0, UTC_NS,
    t_dev_ns=9_999_999_000_000_000, accel_m_s2=(-156.9,) * 3, gyro_rad_s=(-40.0,) * 3, mag_t=(-0.0025,) * 3,
    quat_wxyz=(-0.5,) * 4, euler_rad=(-3.14,) * 3, temperature_c=-40.25, pressure_pa=101_325.5,
    incli_rad=(-1.5, -1.5), status=0xFFFF_FFFF, pps_age_ms=8191, edge_seq=10**9 - 1,
    velocity_enu_m_s=(-300.25,) * 3, position=Position(-1.5, -3.14, -12345.67, 254, 254), heave_m=-12.5,
    gnss_utc_ns=UTC_NS,
)  # fmt: skip


pytestmark = pytest.mark.usefixtures("in_kolkata")


def terminal(monkeypatch: pytest.MonkeyPatch, columns: int, rows: int) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("LINES", str(rows))
    monkeypatch.setattr(sys, "stdout", Terminal())


def test_lines_have_80_columns_and_values_stay_in_their_columns() -> None:
    lines = SampleTable().text(WHOLE).splitlines()
    assert lines == [
        "                  -----ACCEL m/s²----- ------GYRO °/s------ -----ATTITUDE °-----",
        "TIME +05:30   ±ms      X      Y      Z      X      Y      Z   ROLL  PITCH    YAW",
        "19:43:20.123 0.25   0.00   0.50   9.80   57.3    0.0  -57.3    5.7  -11.5  171.9",
    ]
    assert max(map(len, lines)) == 80
    table = SampleTable()
    table.add_devices(["bow", "stern"])
    assert table.text(WHOLE).splitlines() == [
        "                        ----ACCEL m/s²--- -----GYRO °/s---- -----ATTITUDE °-----",
        "DEVICE     TIME +05:30      X     Y     Z     X     Y     Z   ROLL  PITCH    YAW",
        "bow        19:43:20.123  0.00  0.50  9.80  57.3   0.0 -57.3    5.7  -11.5  171.9",
    ]
    one, several = SampleTable(), SampleTable()
    several.add_devices(["a", "b"])
    assert one.text(LARGEST).splitlines()[-1] == (
        "19:43:20.123 4295 -156.9 -156.9 -156.9  -2292  -2292  -2292 -179.9 -179.9 -179.9"
    )
    assert several.text(LARGEST).splitlines()[-1] == (
        "nnnnn…nnnm 19:43:20.123  -157  -157  -157 -2292 -2292 -2292 -179.9 -179.9 -179.9"
    )
    assert SampleTable().text(ONE).splitlines()[-1].split() == ["19:43:20.123", "0.25", *["-"] * 9]
    assert FIELDS.keys() == set(SAMPLE_FIELDS)
    assert SampleTable(SAMPLE_FIELDS).text(LARGEST).splitlines()[-6:] == [
        "nnnnn…nnnm 999999999 9999999.000000 4295 regression       0.000000 19:43:20.123",
        "    9999999.000000 -156.9 -156.9 -156.9  -2292  -2292  -2292",
        "     -2500  -2500  -2500 -0.5000 -0.5000 -0.5000 -0.5000 -179.9 -179.9 -179.9",
        "    -40.2 101326  -85.94  -85.94 0xffffffff   8191 999999999",
        "    -300.25 -300.25 -300.25  -85.9436693 -179.9087477 -12345.67 254 254 -12.500",
        "    1790000000.124",
    ]
    narrow = msgspec.structs.replace(
        WHOLE, mag_t=(2e-5, 0.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0), incli_rad=(0.1, 0.0)
    )
    assert (
        SampleTable(("mag_t", "quat_wxyz", "incli_rad", "gyro_rad_s"))
        .text(narrow)
        .endswith("\n 20.0   0.0   0.0 1.0000 0.0000 0.0000 0.0000   5.73   0.00  57.3   0.0 -57.3\n")
    )
    assert SampleTable(("temperature_c", "device", "status")).text(msgspec.structs.replace(WHOLE, status=8)) == (
        "   °C DEVICE     STATUS\n 31.5 bow        0x00000008\n"
    )
    assert "\x1b" not in SampleTable(("device",)).text(msgspec.structs.replace(ONE, device="\x1b[2J"))


def test_a_wider_terminal_shows_more_and_a_narrow_one_every_column() -> None:
    for width, several, more in [
        (80, False, ["t_err_ns"]), (80, True, ["device"]), (86, True, ["device"]),
        (107, False, ["t_err_ns", "temperature_c", "mag_t"]),
        (200, True, ["device", "t_err_ns", "sync", "mag_t", "temperature_c", "pressure_pa"]),
    ]:  # fmt: skip
        usual = {"utc_ns", "accel_m_s2", "gyro_rad_s", "euler_rad"}
        names = usual_fields(width, several=several)
        assert set(names) == usual | set(more)
        (line,) = lines_of(names, width)
        assert len(line.row(LARGEST)) <= width
    lines = lines_of(usual_fields(20, several=False), 20)
    assert [field.name for line in lines for field in line.fields] == list(usual_fields(20, several=False))
    assert len(lines) == 4


def test_headers(monkeypatch: pytest.MonkeyPatch) -> None:
    def headed(count: int) -> list[int]:
        table = SampleTable()
        return [number for number in range(count) if "TIME" in table.text(WHOLE)]

    assert headed(100) == [0]
    monkeypatch.setattr(os, "get_terminal_size", Mock(side_effect=OSError))  # the size is unknown
    for rows, expected in ((23, [0, 20, 40]), (5, [0, 10]), (0, [0, 21])):
        terminal(monkeypatch, 80, rows)
        assert headed(expected[-1] + 1) == expected
    terminal(monkeypatch, 80, 23)
    table = SampleTable()
    before = [table.text(WHOLE) for _ in range(20)]
    os.environ["COLUMNS"] = "86"
    assert "°C" not in "".join(before)
    assert table.text(WHOLE).splitlines()[-1].endswith(" 31.5")


def test_a_second_device_makes_a_new_header_and_json_and_csv() -> None:
    table = SampleTable()
    table.add_devices(["bow"])
    assert (table.text(WHOLE).count("\n"), table.text(WHOLE).count("\n")) == (3, 1)
    other = table.text(msgspec.structs.replace(WHOLE, device="stern"))
    assert other.splitlines()[1].startswith("DEVICE")
    assert other.splitlines()[2].startswith("stern ")
    assert table.text(WHOLE).startswith("bow ")
    one = msgspec.structs.replace(ONE, utc_ns=0)
    whole = msgspec.structs.replace(one, accel_m_s2=(0.5, -1.25, 9.8), quat_wxyz=(1.0, 0.0, 0.0, 0.0), status=8)

    def as_csv(sample: Sample, fields: tuple[str, ...]) -> str:
        return OUTPUTS["csv"](fields).text(sample)

    assert json.loads(OUTPUTS["json"](None).text(one)) == {
        "device": "bow", "seq": 7, "t_ns": 12_345_678_900, "t_err_ns": 250_000, "sync": "edge",
        "t_rx_ns": 12_350_000_000, "utc_ns": 0,
    }  # fmt: skip
    line = OUTPUTS["json"](("t_ns", "gyro_rad_s", "accel_m_s2")).text(whole)
    assert line == '{"t_ns":12345678900,"accel_m_s2":[0.5,-1.25,9.8]}\n'
    assert OUTPUTS["csv"](("device", "accel_m_s2", "euler_rad", "quat_wxyz")).begin(()) == (
        "device,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2,roll_rad,pitch_rad,yaw_rad,quat_w,quat_x,quat_y,quat_z\r\n"
    )
    text = OUTPUTS["csv"](SAMPLE_FIELDS).begin(()) + as_csv(one, SAMPLE_FIELDS)
    head, *rows = csv.reader(io.StringIO(text), strict=True)
    assert len(head) == len(set(head)) == len(rows[0])
    fields = ("seq", "sync", "accel_m_s2", "gyro_rad_s", "status", "temperature_c")
    assert as_csv(whole, fields) == "7,edge,0.5,-1.25,9.8,,,,8,\r\n"
    strange = msgspec.structs.replace(whole, temperature_c=math.nan)
    assert as_csv(strange, ("temperature_c", "seq")) == "nan,7\r\n"
    text = as_csv(msgspec.structs.replace(one, device='a "b", c'), ("device", "seq"))
    assert (text, list(csv.reader([text], strict=True))) == ('"a ""b"", c",7\r\n', [['a "b", c', "7"]])
