"""JSON and CSV of chosen fields: names with units, absent values, RFC 4180."""

import csv
import io
import json
import math

import msgspec

from imud.cli.watch import OUTPUTS
from imud.model.sample import SAMPLE_FIELDS, Sample, Sync

ONE = Sample("bow", 7, 12_345_678_900, 250_000, Sync.EDGE, 12_350_000_000, 0)
WHOLE = msgspec.structs.replace(ONE, accel_m_s2=(0.5, -1.25, 9.8), quat_wxyz=(1.0, 0.0, 0.0, 0.0), status=8)


def as_json(sample: Sample, fields: tuple[str, ...] | None = None) -> str:
    return OUTPUTS["json"](fields).text(sample)


def as_csv(sample: Sample, fields: tuple[str, ...]) -> str:
    return OUTPUTS["csv"](fields).text(sample)


def csv_head(fields: tuple[str, ...]) -> str:
    return OUTPUTS["csv"](fields).begin(())


def test_json_and_csv() -> None:
    assert json.loads(as_json(ONE)) == {
        "device": "bow", "seq": 7, "t_ns": 12_345_678_900, "t_err_ns": 250_000, "sync": "edge",
        "t_rx_ns": 12_350_000_000, "utc_ns": 0,
    }  # fmt: skip
    assert as_json(WHOLE, ("t_ns", "gyro_rad_s", "accel_m_s2")) == '{"t_ns":12345678900,"accel_m_s2":[0.5,-1.25,9.8]}\n'
    assert csv_head(("device", "accel_m_s2", "euler_rad", "quat_wxyz")) == (
        "device,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2,roll_rad,pitch_rad,yaw_rad,quat_w,quat_x,quat_y,quat_z\r\n"
    )
    head, *rows = csv.reader(io.StringIO(csv_head(SAMPLE_FIELDS) + as_csv(ONE, SAMPLE_FIELDS)), strict=True)
    assert len(head) == len(set(head)) == len(rows[0])
    fields = ("seq", "sync", "accel_m_s2", "gyro_rad_s", "status", "temperature_c")
    assert as_csv(WHOLE, fields) == "7,edge,0.5,-1.25,9.8,,,,8,\r\n"
    strange = msgspec.structs.replace(WHOLE, temperature_c=math.nan)
    assert as_csv(strange, ("temperature_c", "seq")) == "nan,7\r\n"
    odd = msgspec.structs.replace(ONE, device='a "b", c')
    text = as_csv(odd, ("device", "seq"))
    assert text == '"a ""b"", c",7\r\n'
    assert list(csv.reader([text], strict=True)) == [['a "b", c', "7"]]
