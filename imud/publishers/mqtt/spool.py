"""The spool: messages on disk, in their order, from the moment they are made until the broker has acknowledged them.

    commit(new, acknowledged) ──one transaction──▶ SQLite, write-ahead log ──after(id)──▶ sender

- What is in a transaction that was committed survives the end of the process at any moment; it is on the disk within
  SYNC_NS, which a power failure can take away.
- Room: the pages that are in use, within a number of bytes. Where they do not suffice, the oldest whole samples become
  statistics of their batch; when there are none left, the oldest messages are dropped. What is older than the age
  allows is dropped too. In the place of what was dropped there is a message that says so, and neighbours share it.
- Messages that were given to the sender are left alone until `rewind`. They are given in their order; with
  `newest_first` those that are new since `rewind` go before those that waited then.
- A full disk (SpoolError) leaves the spool as it was before the transaction.
- A file that is damaged is set aside, and a new one begun.
"""

import os
import sqlite3
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from imud.errors import reason_of
from imud.formats.fleet.messages import VERSION, DropCause, FleetMessage, MessageKind, decode_message, encode_message
from imud.formats.fleet.state import StreamPosition
from imud.formats.fleet.topics import Stream
from imud.publishers.mqtt.statistics import summed_up
from imud.units import NS_PER_S

FILE: Final = "spool.db"
SYNC_NS: Final = 5 * NS_PER_S
"""The log is synchronised with the disk so often: so much is lost when the power fails."""
PAGE_BYTES: Final = 1024
"""Room is in pages: with SQLite's usual 4096 bytes, most of what thinning frees would stay in the message's page."""
LOG_PAGES: Final = 4000
"""Pages of the log before it goes into the file: 4 MB, as many bytes as is SQLite's own default."""
STEP: Final = 32
"""Messages that are thinned or dropped between two looks at the room."""
STEPS_MAX: Final = 64
"""Steps in one transaction, so that it ends: 2,048 messages, more than ever come in one second."""
CLOCK_SET_NS: Final = 1_577_836_800 * NS_PER_S
"""2020: a wall clock before it is not set, and says nothing of ages."""
POSITIONS_MAX: Final = 256
"""Streams of which the last number is kept: those of a few boots of many devices."""
BUSY_S: Final = 1.0
"""Another program looks at the file: it is waited for so long."""

_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS message (
    id INTEGER PRIMARY KEY, boot TEXT NOT NULL, device TEXT NOT NULL, stream TEXT NOT NULL, kind TEXT NOT NULL,
    topic TEXT NOT NULL, first INTEGER NOT NULL, last INTEGER NOT NULL, items INTEGER NOT NULL,
    stored_utc_ns INTEGER NOT NULL, payload BLOB NOT NULL
);
CREATE TABLE IF NOT EXISTS position (
    boot TEXT NOT NULL, device TEXT NOT NULL, stream TEXT NOT NULL, begin INTEGER NOT NULL, last INTEGER NOT NULL,
    stored_utc_ns INTEGER NOT NULL, PRIMARY KEY (boot, device, stream)
) WITHOUT ROWID;
"""
_COLUMNS: Final = "id, boot, device, stream, kind, topic, first, last, items, stored_utc_ns, payload"
_FREE: Final = "id > ? AND NOT (id > ? AND id <= ?)"
"""Messages that were not given: what may become statistics or be dropped."""
_ID_MAX: Final = (1 << 63) - 1
_THICK: Final = (MessageKind.SAMPLES.value, MessageKind.SLOTS.value)


class SpoolError(Exception):
    """The spool cannot be used now. Example: the disk is full."""


class Spooled(NamedTuple):
    """A message that waits, as a row of the file."""

    id: int
    """Counts messages of this file, in their order; 0 for one that is not stored yet."""
    boot: str
    device: str
    stream: str
    kind: str
    topic: str
    first: int
    last: int
    items: int
    """Samples or events that the numbers stand for."""
    stored_utc_ns: int
    """CLOCK_REALTIME when it was stored; before that, of the newest of it."""
    payload: bytes

    @property
    def key(self) -> tuple[str, str, str]:
        """What its numbers count in."""
        return self.boot, self.device, self.stream


def row_of(topic: str, stream: Stream, message: FleetMessage, payload: bytes, stored_utc_ns: int) -> Spooled:
    """A message that is to be stored."""
    return Spooled(
        0, message.boot, message.device, stream.value, message.kind.value, topic, message.first, message.last,
        message.count, stored_utc_ns, payload,
    )  # fmt: skip


class Spool:
    """The file. Synchronization: one thread; the counters may be read by any."""

    def __init__(self, directory: Path, bytes_max: int, age_ns: int, *, newest_first: bool = False) -> None:
        self.messages = 0
        """Messages in the file."""
        self.used_bytes = 0
        """Room that is used, of `bytes_max`."""
        self.spooled = 0
        """Messages that were stored since the start."""
        self.thinned: int = 0
        """Samples of which only statistics are left."""
        self.dropped: dict[str, int] = {}
        """Samples and events that were dropped from the spool, by `DropCause`."""
        self.set_aside = ""
        """Name of a damaged file that was set aside; empty for none."""
        self._path = directory / FILE
        self._bytes_max, self._age_ns = bytes_max, age_ns
        self._base: sqlite3.Connection | None = None
        self._next_id = 1
        self._given = 0
        """Messages up to this id were given."""
        self._newest_first = newest_first
        self._ahead_from = self._ahead = 0
        """Those after the first id up to the second were given ahead of what waited; 0 while nothing waits behind."""
        self._thin_from = 0
        """Messages up to this id need not be looked at for thinning."""
        self._synced_ns = 0
        self._markers: dict[tuple[str, str, str], int] = {}
        """Id of the newest message about dropped ones, by stream."""

    # --- life --------------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Open the file, or make it. Raises SpoolError."""
        try:
            self._path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
            try:
                self._open()
            except sqlite3.DatabaseError as error:
                if isinstance(error, sqlite3.OperationalError):
                    raise
                self._set_aside()
                self._open()
        except (OSError, sqlite3.Error) as error:
            self._drop_connection()
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._drop_connection()

    def _open(self) -> None:
        os.close(os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o640))
        base = sqlite3.connect(self._path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        self._base = base
        for pragma in (
            f"page_size={PAGE_BYTES}", "journal_mode=WAL", "synchronous=NORMAL", f"wal_autocheckpoint={LOG_PAGES}",
            f"journal_size_limit={LOG_PAGES * PAGE_BYTES}",
        ):  # fmt: skip
            base.execute(f"PRAGMA {pragma}")
        base.executescript(_SCHEMA)
        newest, self.messages = base.execute("SELECT COALESCE(MAX(id), 0), COUNT(*) FROM message").fetchone()
        self._next_id = max(self._next_id, newest + 1)
        self.used_bytes = self._used()
        self._thin_from, self._markers = 0, {}

    def _set_aside(self) -> None:
        self._drop_connection()
        aside = self._path.with_name(f"{FILE}.damaged")
        os.replace(self._path, aside)
        for end in ("-wal", "-shm"):
            with suppress(FileNotFoundError):
                os.unlink(f"{self._path}{end}")
        self.set_aside = str(aside)

    def _drop_connection(self) -> None:
        base, self._base = self._base, None
        if base is not None:
            with suppress(sqlite3.Error):
                base.close()

    # --- messages ----------------------------------------------------------------------------------------------------

    def commit(self, new: Sequence[Spooled], acknowledged: Collection[int], now_ns: int, utc_ns: int) -> None:
        """Store and remove messages, and keep within room and age, all or nothing. Raises SpoolError."""
        if self._base is None:
            self.open()
        base = self._connection()
        before = (self.messages, self.thinned, dict(self.dropped), self._next_id, self._thin_from, dict(self._markers))
        try:
            is_due = now_ns - self._synced_ns >= SYNC_NS
            base.execute(f"PRAGMA synchronous={'FULL' if is_due else 'NORMAL'}")
            base.execute("BEGIN IMMEDIATE")
            self._store(base, new, utc_ns)
            self._remove(base, acknowledged)
            self._keep_age(base, utc_ns)
            self._keep_room(base)
            base.execute("COMMIT")
            if is_due:
                self._synced_ns = now_ns
        except sqlite3.Error as error:
            with suppress(sqlite3.Error):
                base.execute("ROLLBACK")
            self.messages, self.thinned, self.dropped, self._next_id, self._thin_from, self._markers = before
            self._look_at(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error
        self.spooled += len(new)

    def after(self, limit: int) -> list[Spooled]:
        """The next messages, oldest first, which count as given from now on. Raises SpoolError."""
        found: list[Spooled] = []
        if self._ahead_from:
            found = self._between(self._ahead, _ID_MAX, limit)
            self._ahead = found[-1].id if found else self._ahead
            waited = self._between(self._given, self._ahead_from, limit - len(found))
            self._given = waited[-1].id if waited else self._given
            if not waited and len(found) < limit:  # all that waited is given
                self._given, self._ahead_from, self._ahead = self._ahead, 0, 0
            return found + waited
        found = self._between(self._given, _ID_MAX, limit)
        self._given = found[-1].id if found else self._given
        return found

    def _between(self, after_id: int, last_id: int, limit: int) -> list[Spooled]:
        """Messages after an id up to another, oldest first. Raises SpoolError."""
        if limit <= 0:
            return []
        try:
            rows = self._connection().execute(
                f"SELECT {_COLUMNS} FROM message WHERE id > ? AND id <= ? ORDER BY id LIMIT ?",
                (after_id, last_id, limit),
            )
            return [Spooled(*row) for row in rows]
        except sqlite3.Error as error:
            self._look_at(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error

    def rewind(self) -> None:
        """Nothing was given: the connection that it was given to is gone."""
        self._given = 0
        self._ahead_from = self._ahead = self._next_id - 1 if self._newest_first else 0

    def positions(self) -> list[StreamPosition]:
        """How far streams have come, those of earlier boots included. Raises SpoolError."""
        try:
            rows = self._connection().execute("SELECT boot, device, stream, begin, last FROM position")
            return [StreamPosition(*row) for row in rows]
        except sqlite3.Error as error:
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error

    def _connection(self) -> sqlite3.Connection:
        if self._base is None:
            raise SpoolError(f"{self._path}: is not open")
        return self._base

    def _look_at(self, error: sqlite3.Error) -> None:
        """Begin a new file at the next attempt where this one is damaged."""
        if type(error) is sqlite3.DatabaseError:
            with suppress(OSError):
                self._set_aside()

    # --- inside a transaction ----------------------------------------------------------------------------------------

    def _store(self, base: sqlite3.Connection, new: Sequence[Spooled], utc_ns: int) -> None:
        rows = []
        for row in new:
            rows.append(row._replace(id=self._next_id, stored_utc_ns=utc_ns))
            self._next_id += 1
        base.executemany(f"INSERT INTO message ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
        self.messages += len(rows)
        ends = {row.key: row for row in rows}
        begins = {row.key: row.first for row in reversed(rows)}
        # where the clock is not set, 0 here: the newest must not be the first to go
        (after_ns,) = base.execute("SELECT COALESCE(MAX(stored_utc_ns), 0) FROM position").fetchone()
        base.executemany(
            "INSERT INTO position VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET last = excluded.last,"
            " stored_utc_ns = excluded.stored_utc_ns",
            [(*key, begins[key], row.last, max(utc_ns, after_ns + 1)) for key, row in ends.items()],
        )
        if begins and base.execute("SELECT COUNT(*) FROM position").fetchone()[0] > POSITIONS_MAX:
            base.execute(
                "DELETE FROM position WHERE (boot, device, stream) IN (SELECT boot, device, stream FROM position"
                " ORDER BY stored_utc_ns LIMIT ?)", (POSITIONS_MAX // 4,),
            )  # fmt: skip

    def _remove(self, base: sqlite3.Connection, acknowledged: Collection[int]) -> None:
        if acknowledged:
            done = base.executemany("DELETE FROM message WHERE id = ?", [(one,) for one in acknowledged])
            self.messages -= done.rowcount

    @property
    def _taken(self) -> tuple[int, int, int]:
        """What `_FREE` leaves out: all up to the first id, and all after the second up to the third."""
        return self._given, self._ahead_from, self._ahead

    def _keep_age(self, base: sqlite3.Connection, utc_ns: int) -> None:
        if utc_ns < CLOCK_SET_NS:
            return
        old_ns = utc_ns - self._age_ns
        oldest = base.execute(
            f"SELECT id, stored_utc_ns FROM message WHERE {_FREE} AND kind != 'dropped' AND stored_utc_ns >= ? "
            "ORDER BY id LIMIT ?",
            (*self._taken, CLOCK_SET_NS, STEP),
        ).fetchall()
        for number, stored_utc_ns in oldest:
            if stored_utc_ns >= old_ns:
                break
            (row,) = base.execute(f"SELECT {_COLUMNS} FROM message WHERE id = ?", (number,))
            self._drop(base, Spooled(*row), DropCause.AGE)

    def _keep_room(self, base: sqlite3.Connection) -> None:
        for _ in range(STEPS_MAX):
            self.used_bytes = self._used()
            if self.used_bytes <= self._bytes_max:
                return
            if not self._thin_some(base) and not self._drop_some(base):
                return

    def _used(self) -> int:
        base = self._connection()
        size, pages, free = (
            base.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_size", "page_count", "freelist_count")
        )
        return int(size * (pages - free))

    def _thin_some(self, base: sqlite3.Connection) -> bool:
        """Make statistics of the oldest whole samples; return whether there were any."""
        rows = base.execute(
            f"SELECT {_COLUMNS} FROM message WHERE {_FREE} AND id > ? AND kind IN (?, ?) ORDER BY id LIMIT ?",
            (*self._taken, self._thin_from, *_THICK, STEP),
        )  # fmt: skip
        found = [Spooled(*row) for row in rows]
        for row in found:
            self._thin(base, row)
            self._thin_from = row.id
        return bool(found)

    def _thin(self, base: sqlite3.Connection, row: Spooled) -> None:
        try:
            message = decode_message(row.payload)
        except ValueError:
            self._drop(base, row, DropCause.DAMAGED)
            return
        interval = summed_up(message.samples)
        thin = msgspec.structs.replace(
            message, kind=MessageKind.INTERVALS, samples=[], intervals=[interval] if interval is not None else []
        )
        base.execute(
            "UPDATE message SET kind = ?, payload = ? WHERE id = ?",
            (thin.kind.value, encode_message(thin), row.id),
        )
        self.thinned += row.items

    def _drop_some(self, base: sqlite3.Connection) -> bool:
        """Drop the oldest messages; return whether there were any."""
        rows = base.execute(
            f"SELECT {_COLUMNS} FROM message WHERE {_FREE} AND kind != 'dropped' ORDER BY id LIMIT ?",
            (*self._taken, STEP),
        )  # fmt: skip
        found = [Spooled(*row) for row in rows]
        for row in found:
            self._drop(base, row, DropCause.SPACE)
        return bool(found)

    def _drop(self, base: sqlite3.Connection, row: Spooled, cause: DropCause) -> None:
        """Put a note of what was dropped in the place of a message, or into the note before it."""
        self.dropped[cause.value] = self.dropped.get(cause.value, 0) + row.items
        before = None
        marker_id = self._markers.get(row.key, 0)
        if marker_id > self._given and not self._ahead_from < marker_id <= self._ahead:
            before = base.execute(f"SELECT {_COLUMNS} FROM message WHERE id = ?", (marker_id,)).fetchone()
        if before is not None:
            old = Spooled(*before)
            noted = decode_message(old.payload)
            if old.last + 1 == row.first and noted.cause is cause:
                wider = msgspec.structs.replace(noted, last=row.last, count=noted.count + row.items)
                base.execute(
                    "UPDATE message SET last = ?, items = ?, payload = ? WHERE id = ?",
                    (row.last, wider.count, encode_message(wider), old.id),
                )
                base.execute("DELETE FROM message WHERE id = ?", (row.id,))
                self.messages -= 1
                return
        self._markers[row.key] = row.id
        base.execute("UPDATE message SET kind = 'dropped', payload = ? WHERE id = ?", (_note_of(row, cause), row.id))


def _note_of(row: Spooled, cause: DropCause) -> bytes:
    """The payload that says that a message was dropped."""
    try:
        message = decode_message(row.payload)
    except ValueError:
        message = None
    if message is None:
        gateway = row.topic.split("/")[2]
        note = FleetMessage(
            v=VERSION, gateway=gateway, boot=row.boot, device=row.device, kind=MessageKind.DROPPED, begin=row.first,
            first=row.first, last=row.last, count=row.items, utc_ns=row.stored_utc_ns, cause=cause,
        )  # fmt: skip
    else:
        note = msgspec.structs.replace(
            message, kind=MessageKind.DROPPED, cause=cause, samples=[], intervals=[], events=[]
        )  # fmt: skip
    return encode_message(note)
