"""Line protocol of InfluxDB: samples, events and counters as lines of text.

    imud_sample,device=bow,gateway=gw-17 seq=7i,sync="edge",accel_m_s2_x=0.375 1790000000007000000
    measurement,tags                     fields                                UTC, ns

Source: InfluxDB 1.x documentation, "Line protocol reference". A database identifies a row by measurement, tags and
time: the same line written twice is one row. Line protocol has no NaN and no infinity, so these values are absent.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

import msgspec

from imud.model.event import Event
from imud.model.ledger import LEDGER_FIELDS
from imud.model.sample import Sample, values_of

Tags = Mapping[str, str]  # a tag with an empty value is absent: line protocol cannot represent it
Value = float | int | bool | str | None

# Components of the vectors of a sample, as the end of the field name
COMPONENTS: Final = {
    "accel_m_s2": "xyz", "gyro_rad_s": "xyz", "mag_t": "xyz", "quat_wxyz": "wxyz",
    "euler_rad": ("roll", "pitch", "yaw"), "incli_rad": "xy", "velocity_enu_m_s": ("east", "north", "up"),
}  # fmt: skip
_VECTORS: Final = tuple((name, tuple(f"{name}_{part}" for part in parts)) for name, parts in COMPONENTS.items())
_FLOATS: Final = ("temperature_c", "pressure_pa", "heave_m")
_NUMBERS: Final = ("t_dev_ns", "status", "pps_age_ms", "edge_seq", "gnss_utc_ns")
_POSITION: Final = ("latitude_rad", "longitude_rad", "height_m", "position_quality", "satellites")
INTEGER_MOST: Final = (1 << 63) - 1  # integers of line protocol have 64 bits with a sign
_SPECIAL: Final = str.maketrans({",": r"\,", "=": r"\=", " ": r"\ ", "\n": r"\ ", "\r": r"\ ", "\\": "/"})
_QUOTED: Final = str.maketrans({'"': r"\"", "\\": r"\\", "\n": " ", "\r": " "})


def name_text(name: str) -> str:
    r"""Return a measurement, a tag or a field name with escapes. A name has no newline and no backslash: line protocol
    cannot represent a backslash before a comma. imud writes a space and `/` instead."""
    return name if name.isidentifier() else name.translate(_SPECIAL)


def field_text(value: Value) -> str | None:
    """Return the text of a field; None for NaN, infinity and integers above 64 bits. A string is one line: a space
    replaces a newline, because some receivers divide their input at each newline."""
    if isinstance(value, str):
        return f'"{value.translate(_QUOTED)}"'
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value}i" if abs(value) <= INTEGER_MOST else None
    return repr(value) if value is not None and math.isfinite(value) else None


def head(measurement: str, tags: Tags) -> str:
    """Return the series of lines: measurement and tags, sorted by name as InfluxDB recommends."""
    pairs = sorted((name_text(name), name_text(value)) for name, value in tags.items() if value)
    return ",".join((name_text(measurement), *(f"{name}={value}" for name, value in pairs)))


def line(series: str, fields: Iterable[tuple[str, Value]], utc_ns: int) -> str:
    """Return a line with its newline; empty without a field that line protocol can represent. `series` is a `head`,
    `utc_ns` the time since 1970, ns."""
    found = [f"{name_text(name)}={text}" for name, value in fields if (text := field_text(value)) is not None]
    return f"{series} {','.join(found)} {utc_ns}\n" if found else ""


def sample_fields(sample: Sample) -> Iterator[tuple[str, Value]]:
    """Yield the fields of a sample, except `device` and `utc_ns`, which are a tag and the time."""
    yield "seq", sample.seq
    yield "t_ns", sample.t_ns
    yield "t_err_ns", sample.t_err_ns
    yield "sync", sample.sync.value
    yield "t_rx_ns", sample.t_rx_ns
    for name, parts in _VECTORS:
        vector = getattr(sample, name)
        if vector is not None:
            yield from zip(parts, map(float, vector), strict=True)
    for name in _FLOATS:
        value = getattr(sample, name)
        if value is not None:
            yield name, float(value)
    for name in _NUMBERS:
        yield name, getattr(sample, name)
    if sample.position is not None:
        yield from zip(_POSITION, values_of(sample.position), strict=True)


def event_fields(event: Event) -> Iterator[tuple[str, Value]]:
    """Yield the fields of an event. `detail` is JSON, because its values change their type from kind to kind."""
    yield "message", event.message
    yield "detail", msgspec.json.encode(event.detail).decode() if event.detail else None
    yield "t_ns", event.t_ns


def ledger_line(series: str, counts: Iterable[int], utc_ns: int) -> str:
    """Return the line of the counters of a device, in the order of LEDGER_FIELDS."""
    return line(series, zip(LEDGER_FIELDS, counts, strict=True), utc_ns)


def measure_fields(name: str, measure: str, values: Iterable[float]) -> Iterator[tuple[str, Value]]:
    """Yield the fields of one statistic (`mean`, `min`, `max`, `rms`) of a quantity, for example
    `accel_m_s2_x_mean`."""
    parts = [f"_{part}" for part in COMPONENTS.get(name, ())] or [""]
    for part, value in zip(parts, values, strict=False):
        yield f"{name}{part}_{measure}", float(value)


class DistinctTimes:
    """Times of lines in one series: an event at the time of the previous event gets the next ns. Otherwise the database
    would replace the previous event."""

    def __init__(self) -> None:
        self._newest: dict[str, tuple[int, int]] = {}  # newest time and the number of its repetitions

    def at(self, series: str, utc_ns: int) -> int:
        """Return the time for a line. A step of the wall clock to an earlier time is kept."""
        before_ns, count = self._newest.get(series, (0, 0))
        count = count + 1 if utc_ns == before_ns else 0
        self._newest[series] = utc_ns, count
        return utc_ns + count


def cut(lines: bytes, bytes_max: int) -> Iterator[bytes]:
    """Yield pieces of at most `bytes_max` bytes with complete lines. A longer line is a piece of its own."""
    piece: list[bytes] = []
    size = 0
    for one in lines.splitlines(keepends=True):
        if piece and size + len(one) > bytes_max:
            yield b"".join(piece)
            piece, size = [], 0
        piece.append(one)
        size += len(one)
    if piece:
        yield b"".join(piece)
