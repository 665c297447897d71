"""Tables and views of the fleet database. Other programs read them: docs/fleet-database.md has the reference.

    imud_samples, imud_intervals, imud_events, imud_dropped     rows with a time, removed by age
    imud_gateways, imud_boots, imud_ledger                      state and ledger, one row per gateway, boot and stream
    imud_rejected                                               messages that the database could not store
    imud_leases                                                 running collectors and their shares
    imud_schema                                                 version of the tables
    imud_streams, imud_gateway_status                           views
    imud_intervals_1h, imud_intervals_1d                        views, or continuous aggregates of TimescaleDB

Each physical value has a column of its own. The name of the column ends in the unit. All columns have a comment.
"""

from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from imud.fleet.statistics import MEASURES, SCALARS, VECTORS

SCHEMA_VERSION: Final = 1  # version of tables and views; a change of names, types, units or meanings increases it


class Column(NamedTuple):
    name: str
    type: str
    comment: str


class Component(NamedTuple):
    """Component of a physical value."""

    field: str  # field of `Sample`
    at: int | None  # index of the component; None for a scalar
    stem: str  # name of the column before the unit, for example `accel_x`
    unit: str  # end of the column name, for example `m_s2`; empty without unit
    comment: str  # meaning and unit

    def column(self, measure: str = "") -> str:
        """Return the name of the column of this value, or of its `mean`, `min`, `max` or `rms` over an interval."""
        return "_".join(part for part in (self.stem, measure, self.unit) if part)


_UNITS: Final = {
    "accel_m_s2": ("accel", "m_s2", "specific force, m/s²"),
    "gyro_rad_s": ("gyro", "rad_s", "angular rate, rad/s"),
    "mag_t": ("mag", "t", "magnetic flux density, T"),
    "quat_wxyz": ("quat", "", "attitude as unit quaternion, body to navigation frame"),
    "euler_rad": ("", "rad", "attitude in the Euler convention of the device, rad"),
    "incli_rad": ("incli", "rad", "inclinometer, rad"),
    "velocity_enu_m_s": ("velocity", "m_s", "velocity, m/s"),
    "temperature_c": ("temperature", "c", "temperature of the sensor, °C"),
    "pressure_pa": ("pressure", "pa", "air pressure, Pa"),
    "heave_m": ("heave", "m", "vertical displacement, positive up, m"),
}
_AXES: Final = {
    "quat_wxyz": ("w", "x", "y", "z"),
    "euler_rad": ("roll", "pitch", "yaw"),
    "incli_rad": ("x", "y"),
    "velocity_enu_m_s": ("east", "north", "up"),
}


def _components() -> Iterator[Component]:
    for field in VECTORS:
        stem, unit, comment = _UNITS[field]
        for at, axis in enumerate(_AXES.get(field, ("x", "y", "z"))):
            yield Component(field, at, "_".join(filter(None, (stem, axis))), unit, f"{comment}; component {axis}")
    for field in SCALARS:
        stem, unit, comment = _UNITS[field]
        yield Component(field, None, stem, unit, comment)


COMPONENTS: Final = tuple(_components())  # of intervals, and of samples together with the position


class FleetTable(NamedTuple):
    """Table with its comment, columns and primary key."""

    name: str
    comment: str
    columns: tuple[Column, ...]
    primary: tuple[str, ...]
    is_by_time: bool = False  # True if the table is divided into partitions by `time`
    options: str = ""  # storage parameters

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(column.name for column in self.columns)

    def statements(self) -> Iterator[str]:
        """Yield the statements that create the table with its comments."""
        columns = ", ".join(f"{one.name} {one.type}" for one in self.columns)
        key = f", PRIMARY KEY ({', '.join(self.primary)})" if self.primary else ""
        yield f"CREATE TABLE {self.name} ({columns}{key}){self.options}"
        yield from comments("TABLE", self.name, self.comment, self.columns)


def comments(kind: str, name: str, comment: str, columns: Iterable[Column]) -> Iterator[str]:
    """Yield the statements that comment a table or a view (`kind`) and its columns."""
    yield f"COMMENT ON {kind} {name} IS {_quoted(comment)}"
    for one in columns:
        yield f"COMMENT ON COLUMN {name}.{one.name} IS {_quoted(one.comment)}"


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


_STREAM_KEY: Final = (
    Column("gateway", "text NOT NULL", "name of the gateway, unique on its broker"),
    Column("boot", "text NOT NULL", "start of the daemon, 16 hexadecimal digits; with -2, -3 … after a reload"),
    Column("device", "text NOT NULL", "name of the device; empty for the gateway itself"),
)  # fmt: skip
_SITE: Final = Column("site", "text NOT NULL", "site of the gateway")


def _timed(meaning: str) -> tuple[Column, ...]:
    return (
        Column("time", "timestamptz NOT NULL", f"UTC time of {meaning}, resolution 1 µs; correct only if utc_set"),
        _SITE,
        *_STREAM_KEY,
        Column("utc_ns", "bigint NOT NULL", "the same time, ns since 1970-01-01 UTC"),
        Column("utc_set", "boolean NOT NULL", "false while the wall clock of the gateway is not known"),
        Column("utc_err_ns", "bigint", "one-sigma error of the wall clock, ns"),
    )


_STREAM: Final = Column("stream", "text NOT NULL", "stream of the device: samples, statistics or events")
_T_NS: Final = Column("t_ns", "bigint NOT NULL", "CLOCK_MONOTONIC of the gateway at the same time, ns")
_T_ERR_NS: Final = Column("t_err_ns", "bigint NOT NULL", "one-sigma error of t_ns, ns; of an interval: the maximum")
_SYNC: Final = Column("sync", "text NOT NULL", "source of the time stamp, worst first: arrival, regression, edge, utc")

SAMPLES: Final = FleetTable(
    "imud_samples",
    "samples of devices, one row per sample",
    (
        *_timed("the measurement"),
        Column("seq", "bigint NOT NULL", "sequence number of the device since its boot; a gap is a loss"),
        _T_NS,
        _T_ERR_NS,
        _SYNC,
        Column("t_rx_ns", "bigint NOT NULL", "CLOCK_MONOTONIC of the gateway when the last byte was read, ns"),
        Column("t_dev_ns", "bigint", "device time, unwrapped, ns"),
        *(Column(one.column(), "double precision", one.comment) for one in COMPONENTS),
        Column("status", "bigint", "status bits as sent"),
        Column("pps_age_ms", "bigint", "time from the last edge on the PPS or SIN input to the measurement, ms"),
        Column("edge_seq", "bigint", "number of the edge on SOUT, or of the trigger on SIN, for this sample"),
        Column("gnss_utc_ns", "bigint", "UTC of the measurement from the GNSS receiver of the device, ns since 1970"),
        Column("latitude_rad", "double precision", "latitude, WGS 84, positive to the north, rad"),
        Column("longitude_rad", "double precision", "longitude, WGS 84, positive to the east, rad"),
        Column("height_m", "double precision", "height above mean sea level, m"),
        Column("position_quality", "bigint", "quality of the position as sent; 0: invalid"),
        Column("satellites", "bigint", "number of satellites in the position solution"),
    ),
    ("gateway", "boot", "device", "seq", "time", "utc_set"),
    is_by_time=True,
)
MEANINGS: Final = {"mean": "mean", "min": "minimum", "max": "maximum", "rms": "root mean square"}
INTERVALS: Final = FleetTable(
    "imud_intervals",
    "statistics of intervals, one row per device and interval",
    (
        *_timed("the first sample of the interval"),
        _STREAM,
        Column("first", "bigint NOT NULL", "sequence number of the first sample"),
        Column("last", "bigint NOT NULL", "sequence number of the last sample"),
        Column("samples", "bigint NOT NULL", "number of samples in the interval"),
        _T_NS,
        Column("end_t_ns", "bigint NOT NULL", "CLOCK_MONOTONIC of the gateway at the last sample, ns"),
        Column("end_utc_ns", "bigint NOT NULL", "UTC time of the last sample, ns since 1970"),
        _T_ERR_NS,
        _SYNC,
        Column("status", "bigint", "bitwise OR of the status bits of all samples"),
        *(
            Column(one.column(measure), "double precision", f"{MEANINGS[measure]} of: {one.comment}")
            for one in COMPONENTS
            for measure in MEASURES
        ),
    ),
    ("gateway", "boot", "device", "stream", "first", "last", "time", "utc_set"),
    is_by_time=True,
)
EVENTS: Final = FleetTable(
    "imud_events",
    "events of gateways and devices",
    (
        *_timed("the event"),
        Column("number", "bigint NOT NULL", "number of the event in its stream, from 1"),
        _T_NS,
        Column("kind", "text NOT NULL", "kind of the event, for example up, down, alarm"),
        Column("message", "text NOT NULL", "text for people"),
        Column("details", "jsonb", "further values of the event, by name"),
    ),
    ("gateway", "boot", "device", "number", "time", "utc_set"),
    is_by_time=True,
)
DROPPED: Final = FleetTable(
    "imud_dropped",
    "ranges of numbers that a gateway dropped, with the cause",
    (
        *_timed("the newest dropped sample or event"),
        _STREAM,
        Column("first", "bigint NOT NULL", "first dropped number"),
        Column("last", "bigint NOT NULL", "last dropped number"),
        Column("cause", "text NOT NULL", "queue, space, age, disk, off or damaged"),
        _T_NS._replace(type="bigint"),
    ),
    ("gateway", "boot", "device", "stream", "first", "last", "time", "utc_set"),
    is_by_time=True,
)
GATEWAYS: Final = FleetTable(
    "imud_gateways",
    "newest state of each gateway",
    (
        _SITE,
        _STREAM_KEY[0],
        Column("boot", "text NOT NULL", "present start of the daemon"),
        Column("online", "boolean NOT NULL", "false after a shutdown or a lost connection"),
        Column("reason", "text NOT NULL", "reason of an offline gateway"),
        Column("version", "text NOT NULL", "version of imud"),
        Column("devices", "text[] NOT NULL", "names of the devices"),
        Column("utc_set", "boolean", "whether the wall clock is synchronized; NULL if unknown"),
        Column("utc_err_ns", "bigint", "one-sigma error of the wall clock, ns"),
        Column("mqtt", "jsonb NOT NULL", "counters of the output mqtt of the gateway"),
        Column("stored_at", "timestamptz NOT NULL", "time of the database when this state was stored"),
    ),
    ("site", "gateway"),
)
BOOTS: Final = FleetTable(
    "imud_boots",
    "starts of the daemon of each gateway, with the offset of the wall clock when it became known",
    (
        _STREAM_KEY[0],
        Column("boot", "text NOT NULL", "start of the daemon, without the suffix -2, -3 …"),
        Column("first_at", "timestamptz NOT NULL DEFAULT now()", "time of the database at the first message"),
        Column("t_ns", "bigint", "CLOCK_MONOTONIC of the gateway when the offset was read, ns; NULL: not known yet"),
        Column("utc_offset_ns", "bigint", "CLOCK_REALTIME minus CLOCK_MONOTONIC of the gateway, ns"),
        Column("utc_err_ns", "bigint", "one-sigma error of the offset, ns"),
    ),
    ("gateway", "boot"),
)
# Half of each page stays free: PostgreSQL can then update a ledger within its page, without an index update.
LEDGER: Final = FleetTable(
    "imud_ledger",
    "ledger of each stream: newest - begin + 1 = whole + thinned + dropped + missing",
    (
        *_STREAM_KEY,
        _STREAM,
        _SITE,
        Column("begin", "bigint NOT NULL", "first number of the ledger"),
        Column("newest", "bigint NOT NULL", "highest number that a message contained"),
        Column("whole", "bigint NOT NULL", "numbers that arrived; in the stream statistics, as part of an interval"),
        Column("thinned", "bigint NOT NULL", "numbers that arrived as statistics because the spool was full"),
        Column("dropped", "bigint NOT NULL", "numbers that the gateway dropped"),
        Column("dropped_by_cause", "jsonb NOT NULL", "the same by cause"),
        Column("missing", "bigint NOT NULL", "numbers that no message contained; they can still arrive"),
        Column("duplicates", "bigint NOT NULL", "numbers that arrived again and were not stored again"),
        Column("gaps", "bigint[] NOT NULL", "first and last number of the newest 1000 missing ranges, alternating"),
        Column("sent", "bigint", "newest number in the state of the gateway; NULL before the first state"),
        Column("updated_at", "timestamptz NOT NULL", "time of the database at the newest message"),
    ),
    ("gateway", "boot", "device", "stream"),
    options=" WITH (fillfactor = 50)",
)  # fmt: skip
REJECTED: Final = FleetTable(
    "imud_rejected",
    "messages that the collector could not decode or the database could not store, newest 10,000",
    (
        Column("id", "bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY", "number of the message"),
        Column("rejected_at", "timestamptz NOT NULL DEFAULT now()", "time of the database"),
        Column("topic", "text NOT NULL", "topic of the message"),
        Column("reason", "text NOT NULL", "expected and received value"),
        Column("payload_bytes", "bigint NOT NULL", "length of the message, bytes"),
        Column("payload", "bytea NOT NULL", "first 4096 bytes of the message"),
    ),
    (),
)
SCHEMA: Final = FleetTable(
    "imud_schema",
    "version of the tables and views, one row",
    (
        Column("version", "integer NOT NULL", "version; imud refuses tables of another version"),
        Column("upkeep_at", "timestamptz", "time of the database when a collector last removed old rows"),
    ),
    ("version",),
)
LEASES: Final = FleetTable(
    "imud_leases",
    "running collectors, and the shares that they hold",
    (
        Column("kind", "text NOT NULL", "collector, share or metrics"),
        Column("name", "text NOT NULL", "name of the collector; empty for the metrics of the fleet"),
        Column("number", "bigint NOT NULL", "number of the share; of a collector: its random identifier"),
        Column("holder", "bigint NOT NULL", "random identifier of the connection that holds the lease"),
        Column("pid", "integer NOT NULL", "server process of this connection; the lease ends with it"),
        Column("detail", "text NOT NULL", "selection of the collector; otherwise empty"),
        Column("expires_at", "timestamptz NOT NULL", "time of the database at which the lease ends"),
    ),
    ("kind", "name", "number"),
    options=" WITH (fillfactor = 50)",
)
TIMED: Final = (SAMPLES, INTERVALS, EVENTS, DROPPED)
TABLES: Final = (*TIMED, GATEWAYS, BOOTS, LEDGER, REJECTED, LEASES, SCHEMA)
