"""Samples, events and losses as CSV (RFC 4180): a header with units in the names, then one row per object.

A row of a sample contains the chosen fields in the chosen order, vectors with one column per axis. An empty cell is a
value that the sample does not contain; `nan` is not a number. Numbers have all digits: a reader gets the same value,
bit by bit.

`SampleText` formats many rows in one step. Python's `repr` takes 0.4 µs per number, and a row has 20 numbers. msgspec
needs a tenth of this time. Its JSON has the same digits, but other forms of exponents, which `SampleText` replaces.
"""

import csv
import re
from collections.abc import Callable, Iterable, Sequence
from io import StringIO
from operator import attrgetter
from typing import Any, Final

import msgspec

from imud.bridges.channel import LossCounts, StampedEvent
from imud.host.log import MESSAGE_CHARACTERS_MAX, printable
from imud.model.sample import Position, Sample, values_of

# Columns of fields with several values
AXES: Final = {
    "accel_m_s2": ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2"),
    "gyro_rad_s": ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"),
    "mag_t": ("mag_x_t", "mag_y_t", "mag_z_t"),
    "quat_wxyz": ("quat_w", "quat_x", "quat_y", "quat_z"),
    "euler_rad": ("roll_rad", "pitch_rad", "yaw_rad"),
    "incli_rad": ("incli_x_rad", "incli_y_rad"),
    "velocity_enu_m_s": ("velocity_east_m_s", "velocity_north_m_s", "velocity_up_m_s"),
    "position": ("latitude_rad", "longitude_rad", "height_m", "position_quality", "satellites"),
}
# Fields that are empty for a file without times
TIMES: Final = frozenset({"t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns"})
# Fields with a real number. A device can send whole degrees as an integer.
REALS: Final = frozenset({"temperature_c", "pressure_pa"})
EVENT_COLUMNS: Final = ("utc_ns", "t_ns", "device", "kind", "message", "detail")
LOSS_COLUMNS: Final = ("utc_ns", "t_ns", "device", *LossCounts._fields[3:])

Cell = str | int | float | None
Row = Sequence[Cell]

_encode: Final = msgspec.json.Encoder().encode_lines
_DEVICE: Final = "@"  # Placeholder of the device name in encoded rows. No other cell contains this character.
_NOTHING: Final = b"null"
# Literal, pattern and replacement for numbers that msgspec and Python format differently: 0.000025 and 2.5e-05, 3e-7
# and 3e-07, 1e16 and 1e+16. A fast search for the literal avoids most pattern searches.
_FORMS: Final = (
    (b"0.0000", re.compile(rb"0\.0000(?<!\d0\.0000)([1-9])(\d+)"), rb"\1.\2e-05"),
    (b"0.0000", re.compile(rb"0\.0000(?<!\d0\.0000)([1-9])"), rb"\1e-05"),
    (b"e-", re.compile(rb"e-(\d)(?!\d)"), rb"e-0\1"),
    (b"e", re.compile(rb"e(?<=\de)(?=\d)"), b"e+"),
)


def sample_columns(fields: Sequence[str]) -> list[str]:
    """Return the columns of these fields, in their order."""
    return [column for name in fields for column in AXES.get(name, (name,))]


def sample_row(fields: Sequence[str], without_times: bool = False) -> Callable[[Sample], Row]:
    """Return a function that makes the row of a sample. `without_times`: leave the cells of TIMES empty."""
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
                cells += values_of(value) if isinstance(value, Position) else value
        return cells

    return row


def event_row(stamped: StampedEvent) -> Row:
    """Return the row of an event. The details are JSON. A recording can contain texts of an unknown program."""
    event = stamped.event
    detail = _text(msgspec.json.encode(event.detail).decode()) if event.detail else None
    return stamped.utc_ns, event.t_ns, event.device, _text(str(event.kind)), _text(event.message), detail


def _text(text: str) -> str:
    """Return a cell of printable characters. A table program would compute a text that starts with one of `=+-@`."""
    cell = printable(text, MESSAGE_CHARACTERS_MAX)
    return f"'{cell}" if cell.startswith(("=", "+", "-", "@")) else cell


def loss_row(losses: LossCounts) -> Row:
    """Return the row of the lost samples since the start of the daemon."""
    return losses.utc_ns, losses.t_ns, losses.device, *losses[3:]


def csv_text(rows: Iterable[Row]) -> bytes:
    """Return rows as CSV in UTF-8 with CRLF, quotes only if they are needed."""
    text = StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue().encode(errors="backslashreplace")


class SampleText:
    """Fast formatter of samples as CSV. The output is equal to `csv_text` of `sample_row`, byte by byte. Immutable."""

    def __init__(self, fields: Sequence[str], without_times: bool = False) -> None:
        self._row = sample_row(fields, without_times)
        self._columns = [_column(name, without_times and name in TIMES) for name in fields]
        # Whether a row has one cell. An empty cell then needs quotes, because the row would be an empty line.
        self._is_single = len(sample_columns(fields)) == 1

    def of(self, samples: Sequence[Sample]) -> bytes:
        """Return the rows of samples of one device, at least one."""
        columns, missing = [], 0
        for column in self._columns:
            cells, empty = column(samples)
            columns.append(cells)
            missing += empty
        text = _encode(list(zip(*columns, strict=True)))
        if self._is_single or text.count(_NOTHING) != missing:  # JSON also writes null for NaN and infinity
            return csv_text(map(self._row, samples))
        # JSON rows become CSV rows
        text = text.translate(None, b'[]"').replace(_NOTHING, b"").replace(b"\n", b"\r\n")
        for literal, pattern, form in _FORMS:
            if literal in text:
                text = pattern.sub(form, text)
        name = csv_text([(samples[0].device, None)]).removesuffix(b",\r\n")
        return text.replace(_DEVICE.encode(), name)


Column = Callable[[Sequence[Sample]], tuple[Sequence[Any], int]]


def _column(name: str, is_unknown: bool) -> Column:
    """Return a function that makes the cells of a field for all samples and counts empty cells.

    All axes of a vector are in one cell.
    """
    width, get = len(AXES.get(name, ())), attrgetter(name)
    nothing = width * (None,) if width else None

    def column(samples: Sequence[Sample]) -> tuple[Sequence[Any], int]:
        cells = list(map(get, samples))
        missing = cells.count(None)
        if name == "position" and missing < len(cells):
            cells = [nothing if cell is None else values_of(cell) for cell in cells]
            return cells, sum(cell.count(None) for cell in cells)
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
