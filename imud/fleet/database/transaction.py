"""One transaction with messages of the fleet: locks, ledger, rows, clock offsets and states.

    lock boots ──▶ lock ledgers ──▶ new parts ──▶ COPY ──▶ ledgers ──▶ UTC times ──▶ states

Any number of collectors writes to one database. The ledger of a stream is a row. The transaction locks it before it
decides which numbers are new. It locks rows in the order of their keys: boots before ledgers before states.

A gateway without a battery-backed clock starts with a wrong time. Its rows have the time of this clock and `utc_set`
false, until a message or a state of the same boot contains a synchronized clock. The same transaction then moves all
rows of the boot to their UTC time. It uses DELETE and INSERT, because the tables are divided by time. A transaction
with rows of a boot without an offset holds a shared lock on the boot, so that no other transaction stores the offset
before these rows are visible.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from imud.fleet.accounts import (
    DRIFT,
    BootKey,
    BootOffset,
    GatewayState,
    StreamCounts,
    StreamKey,
    StreamLedger,
    boot_of,
    clock_offset,
    offset_of,
)
from imud.fleet.connection import FleetDelivery
from imud.fleet.database.rows import Names, TableRows, TurnRows
from imud.fleet.database.tables import TIMED, FleetTable
from imud.fleet.messages import FleetMessage, Stream
from imud.fleet.reader import FleetBatch

Offsets = Mapping[BootKey, BootOffset]

# Maximum number of days of the rows in a transaction. TimescaleDB creates a chunk for each day, and needs several locks
# for it. The spool of a gateway usually has at most seven days.
DAYS_MAX: Final = 100


class DecodedDelivery(NamedTuple):
    """Message of the broker with its content."""

    delivery: FleetDelivery
    site: str
    gateway: str
    leaf: str  # name of the stream; `state` for a state
    content: FleetMessage | GatewayState
    columns: Sequence[Names]  # columns of the intervals of a message


class StoreCounts(msgspec.Struct):
    """Counters of a store or of one transaction."""

    messages: int = 0  # stored messages and states
    rows: int = 0  # stored rows of samples, intervals, events and dropped ranges
    duplicates: int = 0  # numbers that arrived again and were not stored again
    rejected: int = 0  # messages that are in the table `imud_rejected`

    def add(self, other: "StoreCounts") -> None:
        """Add the counters of a transaction."""
        for name in self.__struct_fields__:
            setattr(self, name, getattr(self, name) + getattr(other, name))


class RowRemoved(Exception):
    """Another transaction removed a row between two statements. The caller repeats the transaction."""

    def __init__(self) -> None:
        super().__init__("another transaction removed a row between two statements")


_KEY: Final = "gateway text, boot text, device text, stream text"
_LEDGER_COLUMNS: Final = (
    "gateway, boot, device, stream, site, begin, newest, whole, thinned, missing, duplicates, sent, gaps, "
    "dropped_by_cause::text"
)
_LOCK_LEDGERS: Final = (
    f"SELECT {_LEDGER_COLUMNS} FROM imud_ledger JOIN json_to_recordset(%s::json) AS wanted({_KEY}) "
    "USING (gateway, boot, device, stream) ORDER BY gateway, boot, device, stream FOR UPDATE OF imud_ledger"
)
# A ledger without a message has `newest` below `begin`.
_NEW_LEDGERS: Final = (
    "INSERT INTO imud_ledger (gateway, boot, device, stream, site, begin, newest, whole, thinned, dropped, "
    "dropped_by_cause, missing, duplicates, gaps, updated_at) "
    "SELECT gateway, boot, device, stream, site, 1, 0, 0, 0, 0, '{}'::jsonb, 0, 0, '{}'::bigint[], now() "
    f"FROM json_to_recordset(%s::json) AS wanted({_KEY}, site text) ORDER BY gateway, boot, device, stream "
    f"ON CONFLICT DO NOTHING RETURNING {_LEDGER_COLUMNS}"
)
_WRITE_LEDGERS: Final = (
    "UPDATE imud_ledger SET site = new.site, begin = new.begin, newest = new.newest, whole = new.whole, "
    "thinned = new.thinned, dropped = new.dropped, dropped_by_cause = new.dropped_by_cause, missing = new.missing, "
    "duplicates = new.duplicates, gaps = new.gaps, sent = new.sent, "
    "updated_at = CASE WHEN new.has_message THEN now() ELSE imud_ledger.updated_at END "
    f"FROM json_to_recordset(%s::json) AS new({_KEY}, site text, begin bigint, newest bigint, whole bigint, "
    "thinned bigint, dropped bigint, dropped_by_cause jsonb, missing bigint, duplicates bigint, gaps bigint[], "
    "sent bigint, has_message boolean) WHERE imud_ledger.gateway = new.gateway AND imud_ledger.boot = new.boot "
    "AND imud_ledger.device = new.device AND imud_ledger.stream = new.stream"
)
_BOOT_COLUMNS: Final = "gateway, boot, t_ns, utc_offset_ns, utc_err_ns"
_LOCK_BOOTS: Final = (
    f"SELECT {_BOOT_COLUMNS} FROM imud_boots JOIN json_to_recordset(%s::json) AS wanted(gateway text, boot text) "
    "USING (gateway, boot) ORDER BY gateway, boot FOR {} OF imud_boots"
)
_NEW_BOOTS: Final = (
    f"INSERT INTO imud_boots ({_BOOT_COLUMNS}) SELECT {_BOOT_COLUMNS} FROM json_to_recordset(%s::json) AS new("
    "gateway text, boot text, t_ns bigint, utc_offset_ns bigint, utc_err_ns bigint) ORDER BY gateway, boot "
    f"ON CONFLICT DO NOTHING RETURNING {_BOOT_COLUMNS}"
)
# The will of an offline gateway does not contain its version and its devices.
_WRITE_STATES: Final = (
    "INSERT INTO imud_gateways AS old (site, gateway, boot, online, reason, version, devices, utc_set, utc_err_ns, "
    "mqtt, stored_at) SELECT site, gateway, boot, online, reason, version, devices, utc_set, "
    "utc_err_ns, mqtt, now() FROM json_to_recordset(%s::json) AS new(site text, gateway text, boot text, "
    "online boolean, reason text, version text, devices text[], utc_set boolean, utc_err_ns bigint, mqtt jsonb) "
    "ORDER BY site, gateway ON CONFLICT (site, gateway) DO UPDATE SET boot = EXCLUDED.boot, online = EXCLUDED.online, "
    "reason = EXCLUDED.reason, stored_at = EXCLUDED.stored_at, utc_set = EXCLUDED.utc_set, "
    "utc_err_ns = EXCLUDED.utc_err_ns, "
    + ", ".join(
        f"{name} = CASE WHEN EXCLUDED.online THEN EXCLUDED.{name} ELSE old.{name} END"
        for name in ("version", "devices", "mqtt")
    )
)
_UTC_NS: Final = "t_ns + %(utc_offset_ns)s"
# SQL expressions of the columns that change when the clock of a boot is known, equal to `accounts.placed`
_PLACED: Final = {
    "time": f"timestamptz 'epoch' + ({_UTC_NS}) / 1000 * interval '1 microsecond'",
    "utc_ns": _UTC_NS,
    "utc_set": "true",
    "utc_err_ns": f"%(utc_err_ns)s::bigint + abs(t_ns - %(t_ns)s) / {DRIFT}",
    "end_utc_ns": "end_t_ns + %(utc_offset_ns)s",
}


def _place_statement(table: FleetTable) -> str:
    """Return the statement that gives the rows of the boots of a gateway a UTC time."""
    return (
        f"WITH gone AS (DELETE FROM {table.name} WHERE gateway = %(gateway)s AND boot = ANY(%(boots)s) "
        f"AND NOT utc_set AND t_ns IS NOT NULL RETURNING *) INSERT INTO {table.name} ({', '.join(table.names)}) "
        f"SELECT {', '.join(_PLACED.get(name, name) for name in table.names)} FROM gone ON CONFLICT DO NOTHING"
    )


class _LedgerRow:
    """Row of the ledger that the transaction has locked."""

    def __init__(self, row: Sequence[Any]) -> None:
        self.key = StreamKey(*row[:4])
        self.site: str = row[4]
        begin, newest, whole, thinned, missing, duplicates = row[5:11]
        self.sent: int | None = row[11]
        dropped = msgspec.json.decode(row[13], type=dict[str, int])
        numbers = iter(row[12])
        self.ledger = StreamLedger(
            StreamCounts(begin, newest, whole, thinned, dropped, missing, duplicates),
            list(zip(numbers, numbers, strict=True)),
        )
        self.has_message = False  # True if the transaction contains a message of the stream
        self.is_changed = False

    @property
    def is_new(self) -> bool:
        """Return whether the stream has no message yet."""
        return self.ledger.counts.newest < self.ledger.counts.begin

    def values(self) -> dict[str, object]:
        """Return the columns of the row."""
        counts = self.ledger.counts
        gaps = [number for gap in self.ledger.gaps for number in gap]
        return {
            **self.key._asdict(), "site": self.site, "begin": counts.begin, "newest": counts.newest,
            "whole": counts.whole, "thinned": counts.thinned, "dropped": sum(counts.dropped.values()),
            "dropped_by_cause": counts.dropped, "missing": counts.missing, "duplicates": counts.duplicates,
            "gaps": gaps, "sent": self.sent, "has_message": self.has_message,
        }  # fmt: skip


class FleetTransaction:
    """Statements of one transaction. Synchronization: one thread."""

    def __init__(self, cursor: Any, items: Sequence[DecodedDelivery], known: Offsets, *, from_begin: bool) -> None:
        """`known`: newest clock offsets of boots that have an offset in the database. With `from_begin`, numbers before
        the first message of a stream count as missing."""
        self.counts = StoreCounts(messages=len(items))
        self.offsets: dict[BootKey, BootOffset] = {}  # newest offsets of the boots of this transaction
        self._cursor = cursor
        self._messages = [one for one in items if isinstance(one.content, FleetMessage)]
        states = {(one.site, one.gateway): one.content for one in items if isinstance(one.content, GatewayState)}
        self._states: dict[tuple[str, str], GatewayState] = states
        self._known, self._from_begin = known, from_begin
        self._fresh: list[tuple[BootKey, BootOffset]] = []  # boots with rows that get a UTC time

    def run(self, insert: Callable[[Any, TableRows], None]) -> None:
        """Execute all statements. `insert` is `copy_rows` or `insert_new_rows`. Raises ValueError if a value cannot be
        stored, RowRemoved, and the errors of psycopg."""
        self._lock_boots()
        ledgers = self._lock_ledgers()
        rows = self._take(ledgers)
        days = len(set[int]().union(*(one.days for one in rows.tables)))
        if days > DAYS_MAX:
            raise ValueError(
                f"expected records of at most {DAYS_MAX} different days, got {days}; is the clock of the gateway wrong?"
            )
        for one in rows.tables:
            if one.count:
                insert(self._cursor, one)
                self.counts.rows += one.count
        self._take_positions(ledgers)
        if changed := [one.values() for one in ledgers.values() if one.is_changed]:
            self._cursor.execute(_WRITE_LEDGERS, (_json(changed),))
        for key, offset in self._fresh:
            self._place(key, offset)
        self._write_states()

    # --- locks --------------------------------------------------------------------------------------------------------

    def _lock_boots(self) -> None:
        """Lock the boots without a known offset and read their offsets. Store new offsets."""
        first: dict[BootKey, BootOffset] = {}
        boots: set[BootKey] = set()
        for one in self._messages:
            assert isinstance(one.content, FleetMessage)
            self._note(boot_of(one.content), offset_of(one.content), first, boots)
        for (_, gateway), state in self._states.items():
            if state.positions or state.clock is not None:
                offset = None if state.clock is None else clock_offset(state.clock)
                self._note(BootKey(gateway, state.boot), offset, first, boots)
        wanted = boots - self._known.keys()
        if not wanted:
            return
        new = [key._asdict() | (first[key]._asdict() if key in first else {}) for key in sorted(wanted)]
        strength = "SHARE" if first.keys().isdisjoint(wanted) else "UPDATE"
        # a boot that this transaction creates has no earlier rows
        found, _ = self._locked(_LOCK_BOOTS.format(strength), _NEW_BOOTS, new, 2)
        for row in found:
            key = BootKey(*row[:2])
            if row[2] is not None:
                self.offsets.setdefault(key, BootOffset(*row[2:]))
            elif key in first:
                self._cursor.execute(
                    "UPDATE imud_boots SET t_ns = %s, utc_offset_ns = %s, utc_err_ns = %s "
                    "WHERE gateway = %s AND boot = %s", (*first[key], *key),
                )  # fmt: skip
                self._fresh.append((key, first[key]))

    def _note(
        self, key: BootKey, offset: BootOffset | None, first: dict[BootKey, BootOffset], boots: set[BootKey]
    ) -> None:  # fmt: skip
        boots.add(key)
        if offset is not None:
            first.setdefault(key, offset)
            self.offsets[key] = offset

    def _lock_ledgers(self) -> dict[StreamKey, _LedgerRow]:
        """Lock the ledgers of all streams. Create a ledger for each stream of a message or of a present boot."""
        sites: dict[StreamKey, str] = {}
        earlier: dict[StreamKey, str] = {}  # streams of earlier boots in states
        for one in self._messages:
            assert isinstance(one.content, FleetMessage)
            sites[StreamKey(one.gateway, one.content.boot, one.content.device, one.leaf)] = one.site
        for (site, gateway), state in self._states.items():
            for at in state.positions:
                is_present = at.boot.partition("-")[0] == state.boot
                (sites if is_present else earlier)[StreamKey(gateway, at.boot, at.device, at.stream)] = site
        if not sites and not earlier:
            return {}
        new = [key._asdict() | {"site": site} for key, site in sites.items()]
        old = [key._asdict() for key in earlier.keys() - sites.keys()]
        found, made = self._locked(_LOCK_LEDGERS, _NEW_LEDGERS, new, 4, old)
        return {one.key: one for one in map(_LedgerRow, (*found, *made))}

    def _locked(
        self, lock: str, create: str, wanted: Sequence[Mapping[str, object]], key_size: int,
        optional: Sequence[Mapping[str, object]] = (),
    ) -> tuple[list[Any], list[Any]]:  # fmt: skip
        """Lock rows and create the missing ones except `optional`. Return the rows that existed and the new rows. The
        key has `key_size` columns. Raises RowRemoved."""
        found = self._rows_of(lock, (*wanted, *optional))
        have = {row[:key_size] for row in found}
        missing = [one for one in wanted if tuple(one.values())[:key_size] not in have]
        if not missing:
            return found, []
        made = self._rows_of(create, missing)
        if len(made) < len(missing):
            # another transaction created the other rows after the first statement
            have = {row[:key_size] for row in made}
            others = [one for one in missing if tuple(one.values())[:key_size] not in have]
            more = self._rows_of(lock, others)
            if len(more) < len(others):
                raise RowRemoved
            found += more
        return found, made

    def _rows_of(self, statement: str, keys: Iterable[Mapping[str, object]]) -> list[Any]:
        self._cursor.execute(statement, (_json(list(keys)),))
        rows: list[Any] = self._cursor.fetchall()
        return rows

    # --- content ------------------------------------------------------------------------------------------------------

    def _take(self, ledgers: Mapping[StreamKey, _LedgerRow]) -> TurnRows:
        """Add the messages to their ledgers. Return the rows of the new parts."""
        rows = TurnRows()
        for one in self._messages:
            message = one.content
            assert isinstance(message, FleetMessage)
            own = ledgers[StreamKey(one.gateway, message.boot, message.device, one.leaf)]
            if own.is_new:
                own.ledger = StreamLedger.before(message, from_begin=self._from_begin)
            own.site, own.has_message, own.is_changed = one.site, True, True
            stream = Stream(one.leaf)
            before = own.ledger.counts.duplicates
            fresh = own.ledger.take(message, stream)
            self.counts.duplicates += own.ledger.counts.duplicates - before
            if fresh is not None:
                key = boot_of(message)
                offset = self.offsets.get(key) or self._known.get(key)
                rows.add(FleetBatch(one.site, stream, fresh, offset), one.columns)
        return rows

    def _take_positions(self, ledgers: Mapping[StreamKey, _LedgerRow]) -> None:
        """Note the newest numbers that the states contain."""
        for (_, gateway), state in self._states.items():
            for at in state.positions:
                own = ledgers.get(StreamKey(gateway, at.boot, at.device, at.stream))
                if own is None or (own.sent is not None and own.sent >= at.last):
                    continue
                if own.is_new and own.sent is None:
                    begin = at.begin if self._from_begin else at.last + 1
                    own.ledger = StreamLedger(StreamCounts(begin, begin - 1))
                own.sent, own.is_changed = at.last, True

    def _place(self, key: BootKey, offset: BootOffset) -> None:
        """Give the rows of a boot a UTC time."""
        self._cursor.execute(
            "SELECT DISTINCT boot FROM imud_ledger WHERE gateway = %s AND split_part(boot, '-', 1) = %s", key
        )
        values = {"gateway": key.gateway, "boots": [boot for (boot,) in self._cursor], **offset._asdict()}
        for table in TIMED:
            self._cursor.execute(_place_statement(table), values)

    def _write_states(self) -> None:
        new = [
            {
                "site": site, "gateway": gateway, "boot": one.boot, "online": one.online, "reason": one.reason,
                "version": one.imud, "devices": one.devices, "mqtt": one.mqtt,
                "utc_set": None if one.clock is None else one.clock.synchronised,
                "utc_err_ns": None if one.clock is None else one.clock.error_ns,
            }
            for (site, gateway), one in self._states.items()
        ]  # fmt: skip
        if new:
            self._cursor.execute(_WRITE_STATES, (_json(new),))


def copy_rows(cursor: Any, rows: TableRows) -> None:
    """Copy rows into their table."""
    rows.copy(cursor, rows.table.name)


def insert_new_rows(cursor: Any, rows: TableRows) -> None:
    """Copy rows into their table except rows that it already contains."""
    name, columns = rows.table.name, ", ".join(rows.names)
    cursor.execute(f"CREATE TEMPORARY TABLE new_{name} (LIKE {name}) ON COMMIT DROP")
    rows.copy(cursor, f"new_{name}")
    cursor.execute(f"INSERT INTO {name} ({columns}) SELECT {columns} FROM new_{name} ON CONFLICT DO NOTHING")


def _json(values: object) -> str:
    return msgspec.json.encode(values).decode()
