"""Samples, events and losses as rows of CSV (RFC 4180): a head with units in the names, then a row each.

A row of samples is what was chosen of a sample, in that order; vectors take a column per axis. An empty
cell is a value that the sample does not have, `nan` one that is not a number. Numbers have all their digits: reading
them gives the same value, bit by bit.

`SampleText` makes the text of many rows at once. Python's own `repr` takes 0.4 µs for a number, and a row has twenty;
msgspec takes a tenth of that. Its JSON has the same digits, and a few forms of exponents that are exchanged.
"""

import csv
import re
from collections.abc import Callable, Iterable, Sequence
from io import StringIO
from operator import attrgetter
from typing import Any, Final

import msgspec

from imud.bridges.channel import LossCounts, StampedEvent
from imud.model.sample import Sample

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

_encode: Final = msgspec.json.Encoder().encode_lines
_DEVICE: Final = "@"
"""Stands for the device in encoded rows, where nothing else has this character."""
_NOTHING: Final = b"null"
_FORMS: Final = (
    (b"0.0000", re.compile(rb"0\.0000(?<!\d0\.0000)([1-9])(\d+)"), rb"\1.\2e-05"),
    (b"0.0000", re.compile(rb"0\.0000(?<!\d0\.0000)([1-9])"), rb"\1e-05"),
    (b"e-", re.compile(rb"e-(\d)(?!\d)"), rb"e-0\1"),
    (b"e", re.compile(rb"e(?<=\de)(?=\d)"), b"e+"),
)
"""Numbers as msgspec writes them, and as Python does: 0.000025 and 2.5e-05, 3e-7 and 3e-07, 1e16 and 1e+16. A pattern
begins with its literal, which comes first and quickly finds the places; most texts do not have it at all."""


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


def csv_text(rows: Iterable[Row]) -> bytes:
    """Return rows as CSV: CRLF, quotes only where they are needed, UTF-8."""
    text = StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue().encode(errors="backslashreplace")


class SampleText:
    """Maker of the rows of samples as CSV, the same as `csv_text` of `sample_row`, byte by byte. Immutable."""

    def __init__(self, fields: Sequence[str], without_times: bool = False) -> None:
        """As of `sample_row`."""
        self._row = sample_row(fields, without_times)
        self._columns = [_column(name, without_times and name in TIMES) for name in fields]
        self._is_single = len(sample_columns(fields)) == 1
        """An empty cell that is alone in its row has quotes, or the row would be an empty line."""

    def of(self, samples: Sequence[Sample]) -> bytes:
        """Return the rows of samples of one device, at least one."""
        columns, missing = [], 0
        for column in self._columns:
            cells, empty = column(samples)
            columns.append(cells)
            missing += empty
        text = _encode(list(zip(*columns, strict=True)))
        if self._is_single or text.count(_NOTHING) != missing:  # JSON has null for what is not finite, too
            return csv_text(map(self._row, samples))
        text = text.translate(None, b'[]"').replace(_NOTHING, b"").replace(b"\n", b"\r\n")
        for literal, pattern, form in _FORMS:
            if literal in text:
                text = pattern.sub(form, text)
        name = csv_text([(samples[0].device, None)]).removesuffix(b",\r\n")
        return text.replace(_DEVICE.encode(), name)


Column = Callable[[Sequence[Sample]], tuple[Sequence[Any], int]]


def _column(name: str, is_unknown: bool) -> Column:
    """Return what makes the cells of a field for all samples, and says how many are empty; axes are in one cell."""
    width, get = len(AXES.get(name, ())), attrgetter(name)
    nothing = width * (None,) if width else None

    def column(samples: Sequence[Sample]) -> tuple[Sequence[Any], int]:
        cells = list(map(get, samples))
        missing = cells.count(None)
        if name in REALS:
            cells = [None if cell is None else float(cell) for cell in cells]
        elif missing and width:
            cells = [nothing if cell is None else cell for cell in cells]
        return cells, missing * (width or 1)

    if is_unknown:
        return lambda samples: (len(samples) * [nothing], len(samples) * (width or 1))
    if name == "device":
        return lambda samples: (len(samples) * [_DEVICE], 0)
    return column
