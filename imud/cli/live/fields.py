"""Members of a sample by name: which are wanted, as JSON, and as columns of CSV with one column per axis.

    accel_m_s2 ──▶ accel_x_m_s2, accel_y_m_s2, accel_z_m_s2        euler_rad ──▶ roll_rad, pitch_rad, yaw_rad

CSV is that of RFC 4180: a header, lines that end in CR LF, quotes where a value needs them. An absent value is an empty
field; NaN, which a device may send, is `nan`, and in JSON null.
"""

import csv
import io
from collections.abc import Sequence
from typing import Any, Final

import msgspec

from imud.contracts.settings import unknown_name
from imud.errors import BadArgument
from imud.sample import SAMPLE_FIELDS, Sample

PARTS: Final = {
    "accel_m_s2": ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2"),
    "gyro_rad_s": ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"),
    "mag_t": ("mag_x_t", "mag_y_t", "mag_z_t"),
    "quat_wxyz": ("quat_w", "quat_x", "quat_y", "quat_z"),
    "euler_rad": ("roll_rad", "pitch_rad", "yaw_rad"),
    "incli_rad": ("incli_x_rad", "incli_y_rad"),
}
"""Columns of the members that are arrays; the others are a column each."""


def chosen_fields(text: str) -> tuple[str, ...]:
    """Return the names in a list separated by commas, in its order. Raises BadArgument for one that is not known."""
    names = tuple(name.strip() for name in text.split(","))
    for number, name in enumerate(names):
        if name not in SAMPLE_FIELDS:
            raise BadArgument(f"--fields: {unknown_name('a field', name, SAMPLE_FIELDS)} (`imud schema` explains them)")
        if name in names[:number]:
            raise BadArgument(f"--fields: expected each field once, got {name} twice")
    return names


def as_json(sample: Sample, fields: Sequence[str] | None = None) -> str:
    """Format a sample as one JSON object, all members or these; absent ones are left out."""
    if fields is None:
        return msgspec.json.encode(sample).decode()
    found = {name: value for name in fields if (value := getattr(sample, name)) is not None}
    return msgspec.json.encode(found).decode()


def csv_head(fields: Sequence[str]) -> str:
    """Format the header of these members, with its line end."""
    return _csv_line([column for name in fields for column in PARTS.get(name, (name,))])


def as_csv(sample: Sample, fields: Sequence[str]) -> str:
    """Format a sample as a line of these members, with its line end."""
    cells: list[Any] = []
    for name in fields:
        value = getattr(sample, name)
        if name not in PARTS:
            cells.append(value)
        else:
            cells += [None] * len(PARTS[name]) if value is None else value
    return _csv_line(cells)


def _csv_line(cells: Sequence[object]) -> str:
    line = io.StringIO()
    csv.writer(line).writerow(cells)
    return line.getvalue()
