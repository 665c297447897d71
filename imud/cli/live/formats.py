"""Formats of samples by name: a table for people, JSON lines, CSV.

CSV is that of RFC 4180: a header, lines that end in CR LF, quotes where a value needs them. An absent value is an empty
field; NaN, which a device may send, is `nan`, and in JSON null. Columns and their names are those of `imud export`.
"""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from typing import Final, Protocol

import msgspec

from imud.bridges.table import sample_columns, sample_row
from imud.cli.live.table import SampleTable
from imud.sample import SAMPLE_FIELDS, Sample


class SampleOutput(Protocol):
    """A format of samples."""

    def begin(self, devices: Iterable[str]) -> str:
        """Return what precedes the samples of these devices; called with every connection."""
        ...

    def text(self, sample: Sample) -> str:
        """Format a sample, with its line end."""
        ...


class _Table:
    def __init__(self, fields: tuple[str, ...] | None) -> None:
        self._table = SampleTable(fields)

    def begin(self, devices: Iterable[str]) -> str:
        self._table.add_devices(devices)
        return ""

    def text(self, sample: Sample) -> str:
        return self._table.text(sample)


class _JsonLines:
    def __init__(self, fields: tuple[str, ...] | None) -> None:
        self._fields = fields

    def begin(self, _devices: Iterable[str]) -> str:
        return ""

    def text(self, sample: Sample) -> str:
        shown: object = sample
        if self._fields is not None:
            shown = {name: value for name in self._fields if (value := getattr(sample, name)) is not None}
        return msgspec.json.encode(shown).decode() + "\n"


class _Csv:
    def __init__(self, fields: tuple[str, ...] | None) -> None:
        self._fields = SAMPLE_FIELDS if fields is None else fields
        self._row = sample_row(self._fields)
        self._begun = False

    def begin(self, _devices: Iterable[str]) -> str:
        begun, self._begun = self._begun, True
        return "" if begun else _csv_line(sample_columns(self._fields))

    def text(self, sample: Sample) -> str:
        return _csv_line(self._row(sample))


def _csv_line(cells: Sequence[object]) -> str:
    line = io.StringIO()
    csv.writer(line).writerow(cells)
    return line.getvalue()


OUTPUTS: Final[dict[str, Callable[[tuple[str, ...] | None], SampleOutput]]] = {
    "table": _Table,
    "json": _JsonLines,
    "csv": _Csv,
}
"""What makes each format, of these fields or of all."""
