"""Samples, events and losses as rows of CSV (RFC 4180): a head with units in the names, then a row each.

A row of samples is what was chosen of a sample, in that order; vectors take a column per axis. An empty
cell is a value that the sample does not have, `nan` one that is not a number. Numbers have all their digits: reading
them gives the same value, bit by bit.
"""

from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from imud.bridges.channel import LossCounts, StampedEvent
from imud.sample import Sample

AXES: Final = {
    "accel_m_s2": ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2"),
    "gyro_rad_s": ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"),
    "mag_t": ("mag_x_t", "mag_y_t", "mag_z_t"),
    "quat_wxyz": ("quat_w", "quat_x", "quat_y", "quat_z"),
    "euler_rad": ("roll_rad", "pitch_rad", "yaw_rad"),
    "incli_rad": ("incli_x_rad", "incli_y_rad"),
}
"""Columns of the fields that have more than one."""
TIMES: Final = frozenset({"t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns"})
"""Fields that a file without times does not have."""
REALS: Final = frozenset({"temperature_c", "pressure_pa"})
"""Fields of one number that is none of those that count; a device may send whole degrees all the same."""
EVENT_COLUMNS: Final = ("utc_ns", "t_ns", "device", "kind", "message", "detail")
LOSS_COLUMNS: Final = ("utc_ns", "t_ns", "device", *LossCounts._fields[3:])

Cell = str | int | float | None
Row = Sequence[Cell]


def sample_columns(fields: Sequence[str]) -> list[str]:
    """Return the columns of these fields, in their order."""
    return [column for name in fields for column in AXES.get(name, (name,))]


def sample_row(fields: Sequence[str], without_times: bool = False) -> Callable[[Sample], Row]:
    """Return what makes the row of a sample, its cells as in `sample_columns`; `without_times` leaves TIMES empty."""
    plan = [(name, len(AXES.get(name, ())), without_times and name in TIMES) for name in fields]

    def row(sample: Sample) -> Row:
        cells: list[Cell] = []
        for name, width, is_unknown in plan:
            value = None if is_unknown else getattr(sample, name)
            if not width:
                cells.append(float(value) if value is not None and name in REALS else value)
            elif value is None:
                cells += width * (None,)
            else:
                cells += value
        return cells

    return row


def event_row(stamped: StampedEvent) -> Row:
    """Return the row of an event; its details are JSON."""
    event = stamped.event
    detail = msgspec.json.encode(event.detail).decode() if event.detail else None
    return stamped.utc_ns, event.t_ns, event.device, str(event.kind), event.message, detail


def loss_row(losses: LossCounts) -> Row:
    """Return the row of losses: what was lost since the daemon's start."""
    return losses.utc_ns, losses.t_ns, losses.device, *losses[3:]
