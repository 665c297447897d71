"""Rows of `imud fleet collect --to postgresql://…`: the tables, and what messages are in them.

The schema is in docs/fleet.md. Every row of samples and records has `time` and `utc_ns`, whether the wall clock of its
gateway was set (`utc_set`), and the error of that (`utc_err_ns`); `time` is in the primary keys because TimescaleDB
wants the column that it divides a table by in every unique index.
"""

from collections.abc import Iterable
from datetime import datetime, timedelta
from functools import lru_cache
from typing import Final, NamedTuple

import msgspec

from imud.fleet.reader import FleetBatch
from imud.formats.fleet.boots import PlacedTime
from imud.formats.fleet.messages import Interval
from imud.units import NS_PER_S

VECTORS: Final = ("accel_m_s2", "gyro_rad_s", "mag_t", "quat_wxyz", "euler_rad", "incli_rad")
SCALARS: Final = ("temperature_c", "pressure_pa")
NUMBERS: Final = ("status", "pps_age_ms", "edge_seq")
KEY: Final = "site text NOT NULL, gateway text NOT NULL, boot text NOT NULL, device text NOT NULL"
UTC_COLUMNS: Final = (("utc_ns", "bigint NOT NULL"), ("utc_set", "boolean NOT NULL"), ("utc_err_ns", "bigint"))
_OF_SAMPLE: Final = (
    ("seq", "bigint NOT NULL"), ("t_ns", "bigint NOT NULL"), ("t_err_ns", "bigint NOT NULL"),
    ("sync", "text NOT NULL"), ("t_rx_ns", "bigint NOT NULL"), ("t_dev_ns", "bigint"),
    *((name, "double precision[]") for name in VECTORS), *((name, "double precision") for name in SCALARS),
    *((name, "bigint") for name in NUMBERS),
)  # fmt: skip
_SAMPLE_NAMES: Final = tuple(name for name, _ in _OF_SAMPLE)
_EPOCH: Final = datetime(1970, 1, 1)  # noqa: DTZ001  # its text has no offset, which stands behind the fraction

Row = tuple[object, ...]
"""Values of all columns, in the order of `FleetTable.names`."""


class FleetTable(NamedTuple):
    """A table of rows that have a time."""

    name: str
    columns: tuple[tuple[str, str], ...]
    """Name and type, without those of time and key."""
    primary: str

    @property
    def names(self) -> tuple[str, ...]:
        """All columns, in the order of COPY."""
        return ("time", "site", "gateway", "boot", "device", *(name for name, _ in self.columns))

    def statement(self) -> str:
        """The statement that makes it where it is missing."""
        columns = ", ".join(f"{name} {kind}" for name, kind in self.columns)
        return (
            f"CREATE TABLE IF NOT EXISTS {self.name} (time timestamptz NOT NULL, {KEY}, {columns}, "
            f"PRIMARY KEY ({self.primary}));"
        )


SAMPLES: Final = FleetTable("imud_samples", (*UTC_COLUMNS, *_OF_SAMPLE), "gateway, boot, device, seq, time")
RECORDS: Final = FleetTable(
    "imud_records",
    (*UTC_COLUMNS, ("first", "bigint NOT NULL"), ("last", "bigint NOT NULL"), ("stream", "text NOT NULL"),
     ("kind", "text NOT NULL"), ("t_ns", "bigint"), ("content", "jsonb NOT NULL")),
    "gateway, boot, device, stream, first, last, kind, time",
)  # fmt: skip
LEDGER: Final = "imud_ledger"
BOOTS: Final = "imud_boots"
SCHEMA: Final = {
    SAMPLES.name: SAMPLES.statement(),
    RECORDS.name: RECORDS.statement(),
    # half of each page is free, so that an account is replaced in its page, without a change of the index
    LEDGER: f"CREATE TABLE IF NOT EXISTS {LEDGER} (gateway text, boot text, device text, stream text, "
    "account jsonb NOT NULL, PRIMARY KEY (gateway, boot, device, stream)) WITH (fillfactor = 50);",
    BOOTS: f"CREATE TABLE IF NOT EXISTS {BOOTS} (gateway text, boot text, t_ns bigint NOT NULL, "
    "utc_offset_ns bigint NOT NULL, utc_err_ns bigint, PRIMARY KEY (gateway, boot));",
}
"""Statements that make the tables, by their names."""


def sample_rows(batch: FleetBatch) -> Iterable[Row]:
    """Rows of the samples of a message."""
    head = _head(batch)
    for one in batch.message.samples:
        values = [getattr(one, name) for name in _SAMPLE_NAMES]
        yield (
            *_times(head, batch.time_of(one.utc_ns, one.t_ns)),
            *[list(value) if isinstance(value, tuple) else value for value in values],
        )


def record_rows(batch: FleetBatch) -> Iterable[Row]:
    """Rows of intervals, events and what was dropped."""
    message, stream, head = batch.message, batch.stream.value, _head(batch)
    for one in message.intervals:
        at = batch.time_of(one.begin_utc_ns, one.begin_t_ns)
        content = json_of(_placed(batch, one, at))
        yield (*_times(head, at), one.first, one.last, stream, "interval", one.begin_t_ns, content)
    for number, event in enumerate(message.events, message.first):
        at = batch.time_of(message.utc_ns, event.t_ns)
        yield (*_times(head, at), number, number, stream, "event", event.t_ns, json_of(event))
    if message.cause is not None:
        numbers, content = (message.first, message.last), json_of({"cause": message.cause})
        at = batch.time_of_newest()
        yield (*_times(head, at), *numbers, stream, "dropped", message.newest_t_ns, content)


def json_of(value: object) -> str:
    """A value as JSON."""
    return msgspec.json.encode(value).decode()


def _head(batch: FleetBatch) -> Row:
    message = batch.message
    return batch.site, message.gateway, message.boot, message.device


def _times(head: Row, at: PlacedTime) -> Row:
    second, rest_ns = divmod(at.utc_ns, NS_PER_S)
    return (f"{_second_text(second)}.{rest_ns // 1000:06}+00:00", *head, at.utc_ns, at.is_set, at.error_ns)


@lru_cache(1024)
def _second_text(second: int) -> str:
    """A second as text, UTC: many rows are of the same one."""
    return (_EPOCH + timedelta(seconds=second)).isoformat()


def _placed(batch: FleetBatch, one: Interval, begin: PlacedTime) -> Interval:
    """An interval with the times at which it lies: where its begin stays, the clock was not stepped after it."""
    if begin.utc_ns == one.begin_utc_ns:
        return one
    end = batch.time_of(one.end_utc_ns, one.end_t_ns)
    return msgspec.structs.replace(one, begin_utc_ns=begin.utc_ns, end_utc_ns=end.utc_ns)
