"""The spool: messages on disk, in their order, from the moment they are made until the broker has acknowledged them.

    commit(new, acknowledged) ──one transaction──▶ SQLite, write-ahead log ──after(id)──▶ sender

- What is in a transaction that was committed survives the end of the process at any moment; it is on the disk within
  SYNC_NS, which a power failure can take away.
- Room: the pages that are in use, within a number of bytes. Where they do not suffice, the oldest whole samples become
  statistics of their batch; when there are none left, the oldest messages are dropped. What is older than the age
  allows is dropped too. In the place of what was dropped there is a message that says so, and neighbours share it.
- Messages that were given to the sender are left alone until `rewind`. They are given in their order; with
  `newest_first` those that are new since `rewind` go before those that waited then.
- A full disk (SpoolError) leaves the spool as it was before the transaction. What is removed needs room in the log as
  well: a reserve is given up for that, and taken again.
- A file that is damaged is set aside, and a new one begun. A row that is damaged in a file that can be read becomes a
  note that says so.
"""

import logging
import os
import sqlite3
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from imud.fleet.accounts import StreamPosition
from imud.fleet.messages import (
    NUMBER_MOST,
    VERSION,
    DropCause,
    FleetMessage,
    MessageKind,
    Stream,
    check_payload,
    decode_message,
    encode_message,
    is_name,
    parse_topic,
)
from imud.fleet.statistics import summed_up
from imud.model.errors import reason_of
from imud.model.units import NS_PER_S

_KINDS: Final = frozenset(kind.value for kind in MessageKind)
_STREAMS: Final = frozenset(stream.value for stream in Stream)


class SpoolRow(NamedTuple):
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
    def key(self) -> tuple[str, str]:
        """What its numbers count in: boot and topic, which has the names of gateway, device and stream."""
        return self.boot, self.topic

    @property
    def gateway(self) -> str:
        """Name that the gateway had when the message was made."""
        return self.topic.split("/")[2]


def row_of(topic: str, stream: Stream, message: FleetMessage, payload: bytes, stored_utc_ns: int) -> SpoolRow:
    """A message that is to be stored."""
    return SpoolRow(
        0, message.boot, message.device, stream.value, message.kind.value, topic, message.first, message.last,
        message.count, stored_utc_ns, payload,
    )  # fmt: skip


def sound_row(values: Sequence[object]) -> SpoolRow | None:
    """The row with these values; None for one that is damaged."""
    row = _numbered(values)
    if row is None or row.kind not in _KINDS:
        return None
    try:
        head = check_payload(row.payload)
    except ValueError:
        return None
    own = (row.gateway, row.boot, row.device, row.first, row.last)
    return row if (head.gateway, head.boot, head.device, head.first, head.last) == own else None


def mended_row(values: Sequence[object]) -> SpoolRow | None:
    """A note in place of a row that is damaged; None where it does not say which numbers it had."""
    row = _numbered([*values[:4], "", *values[5:-1], b""])
    if row is None or row.items != row.last - row.first + 1:
        return None
    return row._replace(kind=MessageKind.DROPPED.value, payload=note_of(row, DropCause.DAMAGED))


def is_position(values: Sequence[object]) -> bool:
    """Whether these are boot, device, stream, begin and last of a stream; damaged ones are not."""
    match values:
        case (str() as boot, str(), str() as stream, int() as begin, int() as last):
            return is_name(boot) and stream in _STREAMS and 0 < begin <= last < NUMBER_MOST
    return False


def note_of(row: SpoolRow, cause: DropCause) -> bytes:
    """The payload that says that a message was dropped."""
    try:
        message = decode_message(row.payload)
    except ValueError:
        note = FleetMessage(
            v=VERSION, gateway=row.gateway, boot=row.boot, device=row.device, kind=MessageKind.DROPPED,
            begin=row.first, first=row.first, last=row.last, count=row.items, utc_ns=row.stored_utc_ns, cause=cause,
        )  # fmt: skip
    else:
        note = msgspec.structs.replace(
            message, kind=MessageKind.DROPPED, cause=cause, samples=[], intervals=[], events=[]
        )  # fmt: skip
    return encode_message(note)


def _numbered(values: Sequence[object]) -> SpoolRow | None:
    """The row, where it says of which stream it is and which numbers it has."""
    try:
        row = msgspec.convert(values, SpoolRow)
    except msgspec.ValidationError:
        return None
    parts = parse_topic(row.topic)
    if parts is None or row.stream not in _STREAMS or (parts.device, parts.leaf) != (row.device, row.stream):
        return None
    return row if is_name(row.boot) and 0 < row.first <= row.last < NUMBER_MOST else None


log = logging.getLogger(__name__)

FILE: Final = "spool.db"
SYNC_NS: Final = 5 * NS_PER_S
"""The log is synchronised with the disk so often: so much is lost when the power fails."""
PAGE_BYTES: Final = 1024
"""Room is in pages: with SQLite's usual 4096 bytes, most of what thinning frees would stay in the message's page."""
LOG_PAGES: Final = 4000
"""Pages of the log before it goes into the file: 4 MB, as many bytes as is SQLite's own default."""
LOG_PART: Final = 16
"""Of the disk, where that is less: on a disk of 8 MB the log has 0.5 MB."""
LOG_PAGES_LEAST: Final = 64
RESERVE_FILE: Final = "spool.reserve"
RESERVE_LOGS: Final = 2
"""Logs that the reserve has room for: one that goes into the file, which can grow by as much, and a transaction."""
LONGEST_BYTES: Final = 1 << 18
"""Twice the longest message."""
STEP: Final = 32
"""Messages that are thinned or dropped between two looks at the room."""
STEPS_MAX: Final = 64
"""Steps in one transaction, so that it ends: 2,048 messages, more than ever come in one second."""
CLOCK_SET_NS: Final = 1_577_836_800 * NS_PER_S
"""2020: a wall clock before it is not set, and says nothing of ages."""
POSITIONS_MAX: Final = 1024
"""Streams of which the last number is kept: three of each of 256 devices, which is the most there are, and those of a
few boots before. A state of the gateway with all of them has 120 kB, no more than the longest message."""
BUSY_S: Final = 1.0
"""Another program looks at the file: it is waited for so long."""

_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS message (
    id INTEGER PRIMARY KEY, boot TEXT NOT NULL, device TEXT NOT NULL, stream TEXT NOT NULL, kind TEXT NOT NULL,
    topic TEXT NOT NULL, first INTEGER NOT NULL, last INTEGER NOT NULL, items INTEGER NOT NULL,
    stored_utc_ns INTEGER NOT NULL, payload BLOB NOT NULL
);
CREATE TABLE IF NOT EXISTS progress (
    gateway TEXT NOT NULL, boot TEXT NOT NULL, device TEXT NOT NULL, stream TEXT NOT NULL, begin INTEGER NOT NULL,
    last INTEGER NOT NULL, stored_utc_ns INTEGER NOT NULL, PRIMARY KEY (gateway, boot, device, stream)
) WITHOUT ROWID;
"""
_TAKE_OVER: Final = """
INSERT OR IGNORE INTO progress (gateway, boot, device, stream, begin, last, stored_utc_ns)
    SELECT ?, boot, device, stream, begin, last, stored_utc_ns FROM position
"""
"""Earlier versions kept positions without the name of the gateway, in a table `position`."""
_COLUMNS: Final = "id, boot, device, stream, kind, topic, first, last, items, stored_utc_ns, payload"
_FREE: Final = "id > ? AND NOT (id > ? AND id <= ?)"
"""Messages that were not given: what may become statistics or be dropped."""
_ID_MAX: Final = (1 << 63) - 1
_THICK: Final = (MessageKind.SAMPLES.value, MessageKind.SLOTS.value)
_OF_DAMAGE: Final = (sqlite3.DatabaseError, sqlite3.IntegrityError)
"""Errors that only a damaged file brings about."""


class SpoolError(Exception):
    """The spool cannot be used now. Example: the disk is full."""


class Spool:
    """The file. Synchronization: one thread; the counters may be read by any."""

    def __init__(
        self, directory: Path, bytes_max: int, age_ns: int, *, newest_first: bool = False, gateway: str = ""
    ) -> None:
        """`gateway`: whose positions are given; empty for those of all names that this one had."""
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
        self._gateway = gateway
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
        self._pages_max: int | None = None
        """The file may not grow beyond, while the disk was full and has no room for the reserve."""
        self._markers: dict[tuple[str, str], int] = {}
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
        base.text_factory = _text_of
        log_pages = self._log_pages()
        for pragma in (
            f"page_size={PAGE_BYTES}", "journal_mode=WAL", "synchronous=NORMAL", f"wal_autocheckpoint={log_pages}",
            f"journal_size_limit={log_pages * PAGE_BYTES}",
        ):  # fmt: skip
            base.execute(f"PRAGMA {pragma}")
        base.executescript(_SCHEMA)
        self._take_over(base)
        newest, self.messages = base.execute("SELECT COALESCE(MAX(id), 0), COUNT(*) FROM message").fetchone()
        if newest >= NUMBER_MOST:
            raise sqlite3.DatabaseError("the messages cannot be numbered on")
        self._next_id = max(self._next_id, newest + 1)
        self.used_bytes = self._used()
        self._thin_from, self._markers = 0, {}
        self._reserve()

    def _log_pages(self) -> int:
        disk = os.statvfs(self._path.parent)
        return max(LOG_PAGES_LEAST, min(LOG_PAGES, disk.f_blocks * disk.f_frsize // LOG_PART // PAGE_BYTES))

    def _reserve(self) -> None:
        """Take the reserve, unless it is there, or the disk has no room for it and a log beside it."""
        path, log_bytes = self._path.with_name(RESERVE_FILE), self._log_pages() * PAGE_BYTES
        size, disk = RESERVE_LOGS * log_bytes, os.statvfs(path.parent)
        if not path.exists() and disk.f_bavail * disk.f_frsize < size + log_bytes:
            return
        try:
            number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o640)
            try:
                os.posix_fallocate(number, 0, size)
            finally:
                os.close(number)
            self._pages_max = None
        except OSError:
            self._give_up_reserve()

    def _look_at_reserve(self) -> None:
        """Take the reserve again as soon as there is room."""
        if self._pages_max is not None:
            self._reserve()

    def _give_up_reserve(self) -> None:
        with suppress(OSError):
            os.unlink(self._path.with_name(RESERVE_FILE))

    def _take_over(self, base: sqlite3.Connection) -> None:
        """Take over positions of an earlier version, which are of the name that the gateway has."""
        found = base.execute("SELECT COUNT(*) FROM sqlite_master WHERE name = 'position'").fetchone()[0]
        if found and self._gateway:
            base.execute("BEGIN IMMEDIATE")
            base.execute(_TAKE_OVER, (self._gateway,))
            base.execute("DROP TABLE position")
            base.execute("COMMIT")

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

    def commit(self, new: Sequence[SpoolRow], acknowledged: Collection[int], now_ns: int, utc_ns: int) -> None:
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
                self._look_at_reserve()
        except sqlite3.Error as error:
            with suppress(sqlite3.Error):
                base.execute("ROLLBACK")
            self.messages, self.thinned, self.dropped, self._next_id, self._thin_from, self._markers = before
            self._look_at(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error
        self.spooled += len(new)

    def remove(self, acknowledged: Collection[int], now_ns: int, utc_ns: int) -> None:
        """Remove messages from a disk that has no room for more. Raises SpoolError."""
        self._give_up_reserve()
        try:
            for some in _batched(acknowledged, max(1, self._log_pages() * PAGE_BYTES // LONGEST_BYTES)):
                # the log begins anew for each, and takes as many bytes as the messages had
                self._connection().execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
                self.commit((), some, now_ns, utc_ns)
            base = self._connection()
            base.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            self._pages_max = base.execute("PRAGMA page_count").fetchone()[0]
        except sqlite3.Error as error:
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error
        finally:
            self._reserve()

    def after(self, limit: int) -> list[SpoolRow]:
        """The next messages, oldest first, which count as given from now on. Raises SpoolError."""
        found: list[SpoolRow] = []
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

    def _between(self, after_id: int, last_id: int, limit: int) -> list[SpoolRow]:
        """Messages after an id up to another, oldest first. Raises SpoolError."""
        if limit <= 0:
            return []
        base = self._connection()
        try:
            return self._sound(base, "id > ? AND id <= ? ORDER BY id LIMIT ?", (after_id, last_id, limit))
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
            rows = self._connection().execute(
                "SELECT boot, device, stream, begin, last FROM progress WHERE gateway = ? OR ? = ''",
                (self._gateway, self._gateway),
            )
            return [StreamPosition(*row) for row in rows if is_position(row)]
        except sqlite3.Error as error:
            self._look_at(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error

    def _connection(self) -> sqlite3.Connection:
        if self._base is None:
            raise SpoolError(f"{self._path}: is not open")
        return self._base

    def _look_at(self, error: Exception) -> None:
        """Begin a new file at the next attempt where this one is damaged."""
        if type(error) in _OF_DAMAGE:
            with suppress(OSError):
                self._set_aside()

    # --- inside a transaction ----------------------------------------------------------------------------------------

    def _store(self, base: sqlite3.Connection, new: Sequence[SpoolRow], utc_ns: int) -> None:
        rows = []
        for row in new:
            rows.append(row._replace(id=self._next_id, stored_utc_ns=utc_ns))
            self._next_id += 1
        base.executemany(f"INSERT INTO message ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
        self.messages += len(rows)
        ends = {row.key: row for row in rows}
        begins = {row.key: row.first for row in reversed(rows)}
        # where the clock is not set, 0 here: the newest must not be the first to go
        (after_ns,) = base.execute(
            "SELECT COALESCE(MAX(stored_utc_ns), 0) FROM progress WHERE stored_utc_ns < ?", (NUMBER_MOST,)
        ).fetchone()
        base.executemany(
            "INSERT INTO progress (gateway, boot, device, stream, begin, last, stored_utc_ns)"
            " VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET last = excluded.last,"
            " stored_utc_ns = excluded.stored_utc_ns",
            [
                (row.gateway, row.boot, row.device, row.stream, begins[key], row.last, max(utc_ns, after_ns + 1))
                for key, row in ends.items()
            ],
        )
        if begins and base.execute("SELECT COUNT(*) FROM progress").fetchone()[0] > POSITIONS_MAX:
            base.execute(
                "DELETE FROM progress WHERE (gateway, boot, device, stream) IN"
                " (SELECT gateway, boot, device, stream FROM progress ORDER BY stored_utc_ns LIMIT ?)",
                (POSITIONS_MAX // 4,),
            )

    def _remove(self, base: sqlite3.Connection, acknowledged: Collection[int]) -> None:
        if acknowledged:
            done = base.executemany("DELETE FROM message WHERE id = ?", [(one,) for one in acknowledged])
            self.messages -= done.rowcount

    @property
    def _taken(self) -> tuple[int, int, int]:
        """What `_FREE` leaves out: all up to the first id, and all after the second up to the third."""
        return self._given, self._ahead_from, self._ahead

    def _sound(self, base: sqlite3.Connection, where: str, values: Sequence[object]) -> list[SpoolRow]:
        """Rows that are not damaged; one that is becomes a note, or goes where it does not say of which numbers."""
        while True:
            rows = base.execute(f"SELECT {_COLUMNS} FROM message WHERE {where}", values).fetchall()
            found = [row for one in rows if (row := sound_row(one) or self._mended(base, one)) is not None]
            if found or not rows:  # else all of them are gone, and others stand behind them
                return found

    def _mended(self, base: sqlite3.Connection, values: Sequence[Any]) -> SpoolRow | None:
        number, row, cause = values[0], mended_row(values), DropCause.DAMAGED.value
        self.dropped[cause] = self.dropped.get(cause, 0) + (row.items if row is not None else 1)
        if row is None:
            log.warning("mqtt: %s: message %d is damaged and does not say which numbers it had", self._path, number)
            base.execute("DELETE FROM message WHERE id = ?", (number,))
            self.messages -= 1
            return None
        log.warning("mqtt: %s: %s %d to %d are damaged", self._path, row.topic, row.first, row.last)
        base.execute("UPDATE message SET kind = ?, payload = ? WHERE id = ?", (row.kind, row.payload, number))
        return row

    def _keep_age(self, base: sqlite3.Connection, utc_ns: int) -> None:
        if utc_ns < CLOCK_SET_NS:
            return
        old_ns = utc_ns - self._age_ns
        oldest = base.execute(
            f"SELECT id, stored_utc_ns FROM message WHERE {_FREE} AND kind != 'dropped' "
            "AND stored_utc_ns BETWEEN ? AND ? ORDER BY id LIMIT ?",
            (*self._taken, CLOCK_SET_NS, NUMBER_MOST, STEP),
        ).fetchall()
        for number, stored_utc_ns in oldest:
            if stored_utc_ns >= old_ns:
                break
            for row in self._sound(base, "id = ?", (number,)):
                self._drop(base, row, DropCause.AGE)

    def _keep_room(self, base: sqlite3.Connection) -> None:
        most = self._bytes_max
        if self._pages_max is not None:
            most = min(most, self._pages_max * PAGE_BYTES)
        for _ in range(STEPS_MAX):
            self.used_bytes = self._used()
            if self.used_bytes <= most:
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
        found = self._sound(
            base, f"{_FREE} AND id > ? AND kind IN (?, ?) ORDER BY id LIMIT ?",
            (*self._taken, self._thin_from, *_THICK, STEP),
        )  # fmt: skip
        for row in found:
            if row.kind in _THICK:  # else it was damaged, and is a note by now
                self._thin(base, row)
            self._thin_from = row.id
        return bool(found)

    def _thin(self, base: sqlite3.Connection, row: SpoolRow) -> None:
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
        found = self._sound(base, f"{_FREE} AND kind != 'dropped' ORDER BY id LIMIT ?", (*self._taken, STEP))
        for row in found:
            self._drop(base, row, DropCause.SPACE)
        return bool(found)

    def _drop(self, base: sqlite3.Connection, row: SpoolRow, cause: DropCause) -> None:
        """Put a note of what was dropped in the place of a message, or into the note before it. No-op for a note."""
        if row.kind == MessageKind.DROPPED.value:
            return
        self.dropped[cause.value] = self.dropped.get(cause.value, 0) + row.items
        before: list[SpoolRow] = []
        marker_id = self._markers.get(row.key, 0)
        if marker_id > self._given and not self._ahead_from < marker_id <= self._ahead:
            before = self._sound(base, "id = ?", (marker_id,))
        for old in before:
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
        base.execute("UPDATE message SET kind = 'dropped', payload = ? WHERE id = ?", (note_of(row, cause), row.id))


def _batched(numbers: Collection[int], most: int) -> Iterator[tuple[int, ...]]:
    """Numbers in groups, in their order."""
    left = iter(sorted(numbers))
    while some := tuple(islice(left, most)):
        yield some


def _text_of(stored: bytes) -> str:
    """A text of the file; one that is damaged comes as well, and is found when its row is looked at."""
    return stored.decode("utf-8", "replace")
