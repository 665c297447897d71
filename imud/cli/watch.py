"""`imud watch`: print samples as a table, as JSON lines, or as CSV."""

import argparse
import csv
import io
import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from time import monotonic
from typing import Any, Final, NamedTuple, Protocol

from imud.attitude.conventions import Convention
from imud.bridges.csv import sample_columns, sample_row
from imud.cli.arguments import CliCommand, add_socket, chosen_fields, finite
from imud.cli.events import LOOK_S, DeviceNotes, keep_connected
from imud.cli.output import COLUMNS, fitted, local_time, raise_if_unread, shortened
from imud.client.connection import Client
from imud.host.log import printable, printable_json
from imud.model.sample import SAMPLE_FIELDS, Position, Sample, values_of
from imud.model.units import NS_PER_MS, NS_PER_S, RAD_PER_DEG, T_PER_UT

NONE: Final = "-"
INDENT: Final = "    "  # indent of the second and later lines of a sample
ROWS: Final = 24  # number of rows of a terminal with unknown size
ROWS_LEAST: Final = 10  # minimum number of samples between two headers

Text = Callable[[Any], str]


class TableColumn(NamedTuple):
    """Column of one number or word."""

    title: str
    wide: int
    narrow: int
    text: Text  # formats a value that is not None
    is_number: bool = True


class FieldColumns(NamedTuple):
    """Columns of one field of a sample."""

    name: str
    label: str  # text above the columns of an array; empty for a single column
    columns: tuple[TableColumn, ...]

    def width(self, *, narrow: bool) -> int:
        """Return the width of all columns with one space between two columns."""
        widths = [column.narrow if narrow else column.wide for column in self.columns]
        return sum(widths) + len(widths) - 1


def _scaled(factor: float, decimals: int) -> Text:
    return lambda value: f"{value / factor:.{decimals}f}"


def _one(name: str, title: str, width: int, text: Text, *, is_number: bool = True) -> FieldColumns:
    return FieldColumns(name, "", (TableColumn(title, width, width, text, is_number),))


def _array(name: str, label: str, titles: Sequence[str], widths: tuple[int, int], text: Text) -> FieldColumns:
    """Return the columns of an array. `widths`: wide and narrow width of a column."""
    return FieldColumns(name, label, tuple(TableColumn(title, *widths, text) for title in titles))


def _clock_time(utc_ns: int) -> str:
    """Format ns since 1970-01-01 UTC as local time of day, truncated to ms."""
    # characters of the time of day, for example 14:05:09.123
    return local_time(utc_ns).isoformat(timespec="milliseconds")[11:23]


_SECONDS: Final = _scaled(NS_PER_S, 6)

_LAYOUT: Final = (
    _one("utc_ns", "TIME", 12, _clock_time, is_number=False),
    _one("device", "DEVICE", 10, lambda name: shortened(printable(name), 10), is_number=False),
    _one("seq", "SEQ", 9, str),
    _one("t_ns", "T s", 14, _SECONDS),
    _one("t_err_ns", "±ms", 4, _scaled(NS_PER_MS, 2)),
    _one("sync", "STAMP", 10, str, is_number=False),
    _one("t_rx_ns", "RECEIVED s", 14, _SECONDS),
    _one("t_dev_ns", "DEVICE s", 14, _SECONDS),
    _array("accel_m_s2", "ACCEL m/s²", "XYZ", (6, 5), _scaled(1, 2)),
    _array("gyro_rad_s", "GYRO °/s", "XYZ", (6, 5), _scaled(RAD_PER_DEG, 1)),
    _array("euler_rad", "ATTITUDE °", ("ROLL", "PITCH", "YAW"), (6, 6), _scaled(RAD_PER_DEG, 1)),
    _array("mag_t", "MAG µT", "XYZ", (6, 5), _scaled(T_PER_UT, 1)),
    _array("quat_wxyz", "QUATERNION", "WXYZ", (7, 6), _scaled(1, 4)),
    _array("incli_rad", "INCLINATION °", "XY", (7, 6), _scaled(RAD_PER_DEG, 2)),
    _one("temperature_c", "°C", 5, _scaled(1, 1)),
    _one("pressure_pa", "Pa", 6, _scaled(1, 0)),
    _one("status", "STATUS", 10, lambda bits: f"0x{bits:08x}", is_number=False),
    _one("pps_age_ms", "PPS ms", 6, str),
    _one("edge_seq", "EDGE", 9, str),
    _array("velocity_enu_m_s", "VELOCITY m/s", "ENU", (7, 6), _scaled(1, 2)),
    FieldColumns(
        "position", "POSITION °, m", (
            TableColumn("LAT", 12, 12, _scaled(RAD_PER_DEG, 7)), TableColumn("LON", 12, 12, _scaled(RAD_PER_DEG, 7)),
            TableColumn("HEIGHT", 9, 8, _scaled(1, 2)), TableColumn("Q", 3, 3, str), TableColumn("SAT", 3, 3, str),
        ),
    ),
    _one("heave_m", "HEAVE m", 7, _scaled(1, 3)),
    _one("gnss_utc_ns", "GNSS UTC s", 14, _scaled(NS_PER_S, 3)),
)  # fmt: skip
FIELDS: Final = {field.name: field for field in _LAYOUT}  # columns of each field of a sample

USUAL: Final = ("utc_ns", "accel_m_s2", "gyro_rad_s", "euler_rad")  # fields of the table without `--fields`
# Fields that imud adds in this order if the terminal is wide enough
MORE: Final = ("t_err_ns", "temperature_c", "mag_t", "sync", "pressure_pa")
USUAL_ORDER: Final = (
    "device", "utc_ns", "t_err_ns", "sync", "accel_m_s2", "gyro_rad_s", "euler_rad", "mag_t", "temperature_c",
    "pressure_pa",
)  # fmt: skip


class TableLine(NamedTuple):
    """Layout of one line of a sample."""

    fields: tuple[FieldColumns, ...]
    narrow: bool
    indent: str

    def head(self, time_title: str) -> list[str]:
        """Format the labels and the titles. `time_title` is the title of the time with its time zone."""
        labels = [field.label.center(self._width(field), "-") if field.label else "" for field in self.fields]
        above = " ".join(label.ljust(self._width(field)) for label, field in zip(labels, self.fields, strict=True))
        titles = self._joined(
            (column, time_title if field is FIELDS["utc_ns"] else column.title)
            for field in self.fields
            for column in field.columns
        )
        return [*([self.indent + above.rstrip()] if above.strip() else []), titles]

    def row(self, sample: Sample) -> str:
        """Format the values of a sample."""
        cells: list[tuple[TableColumn, str]] = []
        for field in self.fields:
            value = getattr(sample, field.name)
            if isinstance(value, Position):
                value = values_of(value)
            values = value if isinstance(value, tuple) else (value,) * len(field.columns)
            cells += [(column, self._cell(column, one)) for column, one in zip(field.columns, values, strict=True)]
        return self._joined(cells)

    def _cell(self, column: TableColumn, value: object) -> str:
        if value is None:
            return NONE
        text = column.text(value)
        width = column.narrow if self.narrow else column.wide
        if len(text) <= width or not column.is_number or "." not in text:
            return text
        # a number that is too wide gets fewer decimals or an exponent
        return fitted(float(text), width, lambda _: text)

    def _width(self, field: FieldColumns) -> int:
        return field.width(narrow=self.narrow)

    def _joined(self, cells: Iterable[tuple[TableColumn, str]]) -> str:
        parts = []
        for column, text in cells:
            width = column.narrow if self.narrow else column.wide
            parts.append(text.rjust(width) if column.is_number else text.ljust(width))
        return (self.indent + " ".join(parts)).rstrip()


def usual_fields(width: int, *, several: bool) -> tuple[str, ...]:
    """Return the fields that fit the width of a terminal. `several`: include the name of the device."""
    chosen = {*USUAL, *(["device"] if several else [])}
    for name in MORE:
        if _width_of(_fields((*chosen, name)), narrow=False) > width:
            break
        chosen.add(name)
    return tuple(name for name in USUAL_ORDER if name in chosen)


def lines_of(names: Sequence[str], width: int) -> list[TableLine]:
    """Arrange fields in lines of at most `width` characters."""
    fields = _fields(names)
    for narrow in (False, True):
        if _width_of(fields, narrow=narrow) <= width:
            return [TableLine(fields, narrow, "")]
    lines: list[TableLine] = []
    rest = list(fields)
    while rest:
        indent = INDENT if lines else ""
        taken = [rest.pop(0)]
        while rest and len(indent) + _width_of([*taken, rest[0]], narrow=False) <= width:
            taken.append(rest.pop(0))
        lines.append(TableLine(tuple(taken), False, indent))
    return lines


def _fields(names: Iterable[str]) -> tuple[FieldColumns, ...]:
    return tuple(FIELDS[name] for name in names)


def _width_of(fields: Sequence[FieldColumns], *, narrow: bool) -> int:
    return sum(field.width(narrow=narrow) for field in fields) + len(fields) - 1


class SampleTable:
    """Text table of samples. On a terminal, the header is repeated on each screen."""

    def __init__(self, fields: Sequence[str] | None = None) -> None:
        """`fields`: None for the fields that fit the terminal."""
        self._chosen = fields
        self._lines: list[TableLine] = []
        self._devices: set[str] = set()
        self._rows_left = 0  # number of samples until the next header; negative if there is no further header

    def add_devices(self, names: Iterable[str]) -> None:
        """Add devices. If the table shows several devices, each row contains the name of the device."""
        before = len(self._devices)
        self._devices.update(names)
        if before <= 1 < len(self._devices):
            self._rows_left = 0  # new column DEVICE: print the header again

    def text(self, sample: Sample) -> str:
        """Format a sample. If a header is due, put it before the sample."""
        if sample.device not in self._devices:
            self.add_devices([sample.device])
        rows = [] if self._rows_left else self._head(sample)
        if self._rows_left > 0:
            self._rows_left -= 1
        return "".join(f"{line}\n" for line in (*rows, *(line.row(sample) for line in self._lines)))

    def _head(self, sample: Sample) -> list[str]:
        """Arrange the columns for the current width of the terminal. Return the header."""
        width, rows = COLUMNS, 0
        is_terminal = sys.stdout.isatty()
        if is_terminal:
            width, rows = shutil.get_terminal_size((COLUMNS, ROWS))
        names = self._chosen or usual_fields(width, several=len(self._devices) > 1)
        self._lines = lines_of(names, width)
        # offset from UTC, for example +01:00
        zone = local_time(sample.utc_ns).isoformat(timespec="seconds")[19:]
        head = [text for line in self._lines for text in line.head(f"TIME {zone}")]
        # -1: no repeated header in files and pipes
        self._rows_left = max((rows - len(head) - 1) // len(self._lines), ROWS_LEAST) if is_terminal else -1
        return head


class SampleOutput(Protocol):
    """Output format of samples."""

    def begin(self, devices: Iterable[str]) -> str:
        """Return the text before the samples of these devices. Called after every connection."""
        ...

    def text(self, sample: Sample) -> str:
        """Format a sample with a line end."""
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
        return printable_json(shown) + "\n"


class _Csv:
    def __init__(self, fields: tuple[str, ...] | None) -> None:
        self._fields = SAMPLE_FIELDS if fields is None else fields
        self._row = sample_row(self._fields)
        self._begun = False

    def begin(self, _devices: Iterable[str]) -> str:
        # only one header, also after a reconnection
        begun, self._begun = self._begun, True
        return "" if begun else _csv_line(sample_columns(self._fields))

    def text(self, sample: Sample) -> str:
        return _csv_line(self._row(sample))


def _csv_line(cells: Sequence[object]) -> str:
    line = io.StringIO()
    csv.writer(line).writerow(cells)
    return line.getvalue()


# Constructor of each format. The argument is the tuple of the fields, or None for all fields.
OUTPUTS: Final[dict[str, Callable[[tuple[str, ...] | None], SampleOutput]]] = {
    "table": _Table,
    "json": _JsonLines,
    "csv": _Csv,
}

TABLE_HZ: Final = 10.0  # maximum rate of the table without `--rate`, Hz


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument("device", nargs="*", metavar="DEVICE", help="devices to print (default: all)")
    parser.add_argument(
        "--rate", type=finite, default=None, metavar="HZ",
        help="maximum samples per second of each device; 0: every sample (default: "
        f"{TABLE_HZ:g} for table, 0 for json and csv)",
    )  # fmt: skip
    parser.add_argument(
        "--fields", type=str, default=None, metavar="NAME,…",
        help="fields to print, in this order; `imud schema` lists all fields",
    )  # fmt: skip
    form = parser.add_mutually_exclusive_group()
    form.add_argument(
        "--format", choices=sorted(OUTPUTS), default="table",
        help="table: local time, degrees, µT; json: one object per line, SI units; csv: RFC 4180, SI units "
        "(default: %(default)s)",
    )  # fmt: skip
    form.add_argument("--json", dest="format", action="store_const", const="json", help="same as --format json")
    parser.add_argument(
        "--convention", choices=[str(one) for one in Convention], default=None,
        help="convention of axes and angles (default: as configured)",
    )  # fmt: skip
    parser.add_argument(
        "--latency", type=finite, default=None, metavar="MS",
        help="accepted latency; a longer latency costs less CPU time (default: one period of --rate, at most 20; "
        "without --rate: 0)",
    )  # fmt: skip
    parser.add_argument("--count", type=int, default=None, metavar="N", help="stop after N samples")
    parser.add_argument("--follow", action="store_true", help="wait for the daemon, and continue after its restarts")


def run(args: argparse.Namespace) -> int:
    """Print samples until Ctrl-C, until `--count` samples, or until the daemon stops. `--follow` survives restarts."""
    fields = None if args.fields is None else chosen_fields(args.fields)
    watching = _Watching(args, OUTPUTS[args.format](fields))
    keep_connected("imud watch", args.socket, watching.work, follow=args.follow)
    return 0


class _Watching:
    """State of the command, across several connections."""

    def __init__(self, args: argparse.Namespace, output: SampleOutput) -> None:
        self._args = args
        self._output = output
        self._left: int | None = args.count
        rate_hz: float | None = args.rate
        self._rate_hz = TABLE_HZ if rate_hz is None and args.format == "table" else rate_hz

    def work(self, client: Client) -> None:
        """Print the samples of one connection."""
        args = self._args
        samples = client.watch(
            args.device or None, rate_hz=self._rate_hz, timeout_s=LOOK_S, convention=args.convention,
            latency_ms=args.latency,
        )  # fmt: skip
        notes = DeviceNotes(client, args.device)
        samples.on_dropped = notes.add_dropped
        self._write(self._output.begin(samples.device_ids))
        while self._left is None or self._left > 0:
            notes.look(monotonic())
            try:
                sample = next(samples)
            except TimeoutError:  # no sample for LOOK_S: the next `look` prints the reason
                raise_if_unread()
                continue
            self._write(self._output.text(sample))
            if self._left is not None:
                self._left -= 1

    @staticmethod
    def _write(text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()


WATCH = CliCommand(add_arguments, run)
