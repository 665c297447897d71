"""Rows of CSV: columns with units in their names, empty cells for what is missing, all digits."""

from imud.bridges import table
from imud.bridges.channel import LossCounts, StampedEvent
from imud.sample import SAMPLE_FIELDS, SAMPLE_SCHEMA
from tests.bridges.samples import BARE, EVENT, FULL, UTC_NS


def test_columns_of_all_fields() -> None:
    assert table.sample_columns(SAMPLE_FIELDS) == [
        "device", "seq", "t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns", "t_dev_ns",
        "accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2", "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s",
        "mag_x_t", "mag_y_t", "mag_z_t", "quat_w", "quat_x", "quat_y", "quat_z", "roll_rad", "pitch_rad", "yaw_rad",
        "temperature_c", "pressure_pa", "incli_x_rad", "incli_y_rad", "status", "pps_age_ms", "edge_seq",
    ]  # fmt: skip


def test_a_row_has_a_cell_for_each_column() -> None:
    names = SAMPLE_FIELDS
    row = table.sample_row(names)
    by_column = dict(zip(table.sample_columns(names), row(FULL), strict=True))
    assert by_column["accel_z_m_s2"] == 9.75
    assert by_column["quat_y"] == -0.5
    assert by_column["edge_seq"] == 9
    bare = dict(zip(table.sample_columns(names), row(BARE), strict=True))
    assert [name for name, cell in bare.items() if cell is not None] == [
        "device", "seq", "t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns", "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"
    ]  # fmt: skip


def test_chosen_fields_are_in_the_order_that_was_asked_for() -> None:
    names = ("gyro_rad_s", "t_ns")
    assert table.sample_columns(names) == ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s", "t_ns"]
    assert table.sample_row(names)(FULL) == [0.25, 0.5, -0.75, FULL.t_ns]


def test_without_times_their_cells_are_empty() -> None:
    names = ("seq", "t_ns", "utc_ns", "t_err_ns", "sync", "t_rx_ns", "t_dev_ns")
    assert table.sample_row(names, without_times=True)(FULL) == [7, None, None, None, None, None, 5_000_000]


def test_events_and_losses() -> None:
    event = dict(zip(table.EVENT_COLUMNS, table.event_row(StampedEvent(EVENT, UTC_NS)), strict=True))
    assert (event["utc_ns"], event["device"], event["kind"]) == (UTC_NS, "bow", "loss")
    assert event["detail"] == '{"count":3,"cause":"crc"}'
    losses = LossCounts(1, UTC_NS, "bow", 100, 1, 2, 3, 4, 5)
    row = dict(zip(table.LOSS_COLUMNS, table.loss_row(losses), strict=True))
    assert (row["samples"], row["lost_crc"], row["lost_unknown"]) == (100, 2, 5)


def test_every_array_has_a_column_for_each_of_its_numbers() -> None:
    lengths = {field.name: int(field.type[7:-1]) for field in SAMPLE_SCHEMA if field.type.startswith("number[")}
    assert {name: len(columns) for name, columns in table.AXES.items()} == lengths
