"""CSV rows: columns with units, empty cells for absent values, all digits."""

import struct
from collections.abc import Iterator, Sequence
from math import inf, isfinite, nan
from random import Random

import msgspec
import pytest

from imud.bridges import csv as table
from imud.bridges.channel import LossCounts, StampedEvent
from imud.model.sample import SAMPLE_FIELDS, SAMPLE_SCHEMA, Sample
from tests.bridges.samples import BARE, EVENT, FULL, UTC_NS


def test_columns_and_rows() -> None:
    assert table.sample_columns(SAMPLE_FIELDS) == [
        "device", "seq", "t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns", "t_dev_ns",
        "accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2", "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s",
        "mag_x_t", "mag_y_t", "mag_z_t", "quat_w", "quat_x", "quat_y", "quat_z", "roll_rad", "pitch_rad", "yaw_rad",
        "temperature_c", "pressure_pa", "incli_x_rad", "incli_y_rad", "status", "pps_age_ms", "edge_seq",
        "velocity_east_m_s", "velocity_north_m_s", "velocity_up_m_s", "latitude_rad", "longitude_rad", "height_m",
        "position_quality", "satellites", "heave_m", "gnss_utc_ns",
    ]  # fmt: skip
    names = SAMPLE_FIELDS
    row = table.sample_row(names)
    by_column = dict(zip(table.sample_columns(names), row(FULL), strict=True))
    assert (by_column["accel_z_m_s2"], by_column["quat_y"], by_column["edge_seq"]) == (9.75, -0.5, 9)
    bare = dict(zip(table.sample_columns(names), row(BARE), strict=True))
    assert [name for name, cell in bare.items() if cell is not None] == [
        "device", "seq", "t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns", "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"
    ]  # fmt: skip
    names = ("gyro_rad_s", "t_ns")
    assert table.sample_columns(names) == ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s", "t_ns"]
    assert table.sample_row(names)(FULL) == [0.25, 0.5, -0.75, FULL.t_ns]
    names = ("seq", "t_ns", "utc_ns", "t_err_ns", "sync", "t_rx_ns", "t_dev_ns")
    assert table.sample_row(names, without_times=True)(FULL) == [7, None, None, None, None, None, 5_000_000]
    event = dict(zip(table.EVENT_COLUMNS, table.event_row(StampedEvent(EVENT, UTC_NS)), strict=True))
    assert (event["utc_ns"], event["device"], event["kind"]) == (UTC_NS, "bow", "loss")
    assert event["detail"] == '{"count":3,"cause":"crc"}'
    losses = LossCounts(1, UTC_NS, "bow", 100, 1, 2, 3, 4, 5)
    counts = dict(zip(table.LOSS_COLUMNS, table.loss_row(losses), strict=True))
    assert (counts["samples"], counts["lost_crc"], counts["lost_unknown"]) == (100, 2, 5)
    for message, cell in (("=1+1", "'=1+1"), ("@x", "'@x"), ("a\x1b[2J\n", "a\\x1b[2J\\n"), ("-", "'-"), ("+", "'+")):
        forged = msgspec.structs.replace(EVENT, message=message, kind=message, detail={"\u202e": "x"})
        made = dict(zip(table.EVENT_COLUMNS, table.event_row(StampedEvent(forged, UTC_NS)), strict=True))
        assert (made["message"], made["kind"], made["detail"]) == (cell, cell, '{"\\u202e":"x"}')
    lengths = {field.name: int(field.type[7:-1]) for field in SAMPLE_SCHEMA if field.type.startswith("number[")}
    assert {name: len(columns) for name, columns in table.AXES.items()} == {**lengths, "position": 5}


def by_rows(samples: Sequence[Sample], fields: Sequence[str] = SAMPLE_FIELDS) -> bytes:
    """Return the rows as Python's csv module formats them."""
    return table.csv_text(map(table.sample_row(fields), samples))


def finite(random: Random, count: int) -> Iterator[float]:
    """Yield numbers of all sizes: random bits, round numbers, and numbers near a change of the exponent format."""
    while count:
        (bits,) = struct.unpack("<d", random.randbytes(8))
        scaled = random.uniform(-1, 1) * 10.0 ** random.randint(-9, 20)
        value = random.choice((bits, scaled, random.choice((1, -1, 2.5, -12.5)) * 10.0 ** random.randint(-8, 23)))
        if isfinite(value):
            count -= 1
            yield value


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1e-5, b"1e-05"), (-2.5e-5, b"-2.5e-05"), (0.0001, b"0.0001"), (10.00001, b"10.00001"), (3e-7, b"3e-07"),
        (-1.5e-10, b"-1.5e-10"), (1e15, b"1000000000000000.0"), (1e16, b"1e+16"), (1.5e100, b"1.5e+100"),
        (-0.0, b"-0.0"), (0.1, b"0.1"), (100.00002, b"100.00002"), (5e-324, b"5e-324"), (nan, b"nan"), (-inf, b"-inf"),
    ],
)  # fmt: skip
def test_numbers_are_written_as_python_writes_them(value: float, text: bytes) -> None:
    sample = msgspec.structs.replace(FULL, gyro_rad_s=(value, 0.5, value))
    rows = text + b",0.5," + text + b",7\r\n0.25,0.5,-0.75,7\r\n"
    assert table.SampleText(("gyro_rad_s", "seq")).of([sample, FULL]) == rows


def test_numbers_of_every_size_are_written_as_python_writes_them() -> None:
    numbers = finite(Random(1), 9 * 20 * 100)
    for _ in range(100):
        samples = [
            msgspec.structs.replace(FULL, **{name: (next(numbers), next(numbers), next(numbers)) for name in VECTORS})
            for _ in range(20)
        ]
        assert table.SampleText(SAMPLE_FIELDS).of(samples) == by_rows(samples)
    assert next(numbers, None) is None


VECTORS = ("accel_m_s2", "gyro_rad_s", "mag_t")


def test_different_samples_in_one_text() -> None:
    whole = msgspec.structs.replace(BARE, temperature_c=21)
    samples = [FULL, BARE, msgspec.structs.replace(FULL, mag_t=(nan, 0.0, 0.0)), whole, BARE]
    for chosen in (samples, samples[:2], samples[3:], samples[1:2]):
        assert table.SampleText(SAMPLE_FIELDS).of(chosen) == by_rows(chosen)
    assert table.SampleText(("seq", "temperature_c")).of([whole]) == b"%d,21.0\r\n" % whole.seq
    samples = [msgspec.structs.replace(FULL, pressure_pa=None), msgspec.structs.replace(FULL, pressure_pa=nan)]
    assert table.SampleText(("seq", "pressure_pa")).of(samples) == b"7,\r\n7,nan\r\n"
    names = ("seq", "t_ns", "utc_ns", "t_err_ns", "sync", "t_rx_ns", "t_dev_ns")
    assert table.SampleText(names, without_times=True).of([FULL]) == b"7,,,,,,5000000\r\n"


def test_names_of_devices_and_single_fields() -> None:
    for name in ["bow", 'b,"o"w', "home-5", "0.00001", "1e16", "@", "null", "[a]", "a\r\nb", "é\udc80"]:
        samples = [msgspec.structs.replace(one, device=name) for one in (FULL, BARE)]
        assert table.SampleText(SAMPLE_FIELDS).of(samples) == by_rows(samples)
        assert table.SampleText(("seq", "device")).of(samples) == by_rows(samples, ("seq", "device"))
    for field in ["status", "temperature_c", "device", "sync", "t_dev_ns", "incli_rad"]:
        assert table.SampleText((field,)).of([BARE, FULL]) == by_rows([BARE, FULL], (field,))
