"""Table of samples: columns, units, 80 columns, repeated header."""

import os
import sys

import msgspec
import pytest

from imud.cli.watch import FIELDS, SampleTable, lines_of, usual_fields
from imud.model.sample import SAMPLE_FIELDS, Sample, Sync

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
)  # fmt: skip


pytestmark = pytest.mark.usefixtures("in_kolkata")


class Terminal:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, columns: int, rows: int) -> None:
        monkeypatch.setenv("COLUMNS", str(columns))
        monkeypatch.setenv("LINES", str(rows))
        monkeypatch.setattr(sys, "stdout", self)

    def isatty(self) -> bool:
        return True


def test_lines_have_80_columns() -> None:
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


def test_values_stay_in_their_columns() -> None:
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
    lines = SampleTable(SAMPLE_FIELDS).text(LARGEST).splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) > 4
    assert [line.split()[-1] for line in lines[-4:]] == ["19:43:20.123", "-2292", "-179.9", "999999999"]
    assert SampleTable(("temperature_c", "device", "status")).text(msgspec.structs.replace(WHOLE, status=8)) == (
        "   °C DEVICE     STATUS\n 31.5 bow        0x00000008\n"
    )
    table = SampleTable(("device",))
    assert "\x1b" not in table.text(msgspec.structs.replace(ONE, device="\x1b[2J"))


def test_a_wider_terminal_shows_more_and_a_narrow_one_every_column() -> None:
    for width, several, more in [
        (80, False, ["t_err_ns"]),
        (80, True, ["device"]),
        (86, True, ["device"]),
        (107, False, ["t_err_ns", "temperature_c", "mag_t"]),
        (200, True, ["device", "t_err_ns", "sync", "mag_t", "temperature_c", "pressure_pa"]),
    ]:
        usual = {"utc_ns", "accel_m_s2", "gyro_rad_s", "euler_rad"}
        names = usual_fields(width, several=several)
        assert set(names) == usual | set(more)
        (line,) = lines_of(names, width)
        assert len(line.row(LARGEST)) <= width
    lines = lines_of(usual_fields(20, several=False), 20)
    assert [field.name for line in lines for field in line.fields] == list(usual_fields(20, several=False))
    assert len(lines) == 4


def test_headers(monkeypatch: pytest.MonkeyPatch) -> None:
    piped = SampleTable()
    heads = [piped.text(WHOLE).count("TIME") for _ in range(100)]
    assert heads == [1, *[0] * 99]
    Terminal(monkeypatch, 80, 23)
    table = SampleTable()
    heads = [table.text(WHOLE).count("TIME") for _ in range(41)]
    assert [n for n, head in enumerate(heads) if head] == [0, 20, 40]
    Terminal(monkeypatch, 80, 5)
    low = SampleTable()
    heads = [low.text(WHOLE).count("TIME") for _ in range(11)]
    assert [n for n, head in enumerate(heads) if head] == [0, 10]
    Terminal(monkeypatch, 80, 23)
    table = SampleTable()
    before = [table.text(WHOLE) for _ in range(20)]
    os.environ["COLUMNS"] = "86"
    assert "°C" not in "".join(before)
    assert table.text(WHOLE).splitlines()[-1].endswith(" 31.5")


def test_a_second_device_makes_a_new_header() -> None:
    table = SampleTable()
    table.add_devices(["bow"])
    assert table.text(WHOLE).count("\n") == 3
    assert table.text(WHOLE).count("\n") == 1
    other = table.text(msgspec.structs.replace(WHOLE, device="stern"))
    assert other.splitlines()[1].startswith("DEVICE")
    assert other.splitlines()[2].startswith("stern ")
    assert table.text(WHOLE).startswith("bow ")
