"""Spool: an ordered file of messages that the broker has not acknowledged.

    commit(new, acknowledged) ──one transaction──▶ SQLite, write-ahead log ──after(id)──▶ sender

- A committed transaction survives the end of the process. imud synchronizes the log with the disk every SYNC_NS, so a
  power failure can lose the transactions of this time.

- If the pages in use exceed the configured size, imud replaces the oldest complete samples by statistics. If there are
  none left, it drops the oldest messages. It also drops messages that are too old. A message of the kind `dropped`
  replaces dropped messages; adjacent ones are joined.

- imud does not change messages that the sender received until `rewind`. `after` returns messages in their order. With
  `newest_first`, messages that are newer than `rewind` come first.

- A full disk (SpoolError) does not change the spool. Removing messages also needs room in the log. imud therefore keeps
  a reserve file, removes it if necessary, and creates it again later.

- imud renames a damaged file and creates a new one. A damaged row becomes a message of the kind `dropped`.
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
    CLOCK_SET_NS,
    NUMBER_MOST,
    VERSION,
    DropCause,
    FleetMessage,
    MessageKind,
    Stream,
    check_payload,
    decode_message,
    encode_message,
    parse_topic,
)
from imud.fleet.settings import is_name
from imud.fleet.statistics import summed_up
from imud.model.errors import reason_of
from imud.model.units import NS_PER_S

_KINDS: Final = frozenset(kind.value for kind in MessageKind)
_STREAMS: Final = frozenset(stream.value for stream in Stream)


class SpoolRow(NamedTuple):
    """Message in the spool, a row of the file."""

    id: int  # row ID, in the order of the messages; 0 before the message is stored
    boot: str
    device: str
    stream: str
    kind: str
    topic: str
    first: int
    last: int
    items: int  # number of samples or events that the numbers stand for
    stored_utc_ns: int  # CLOCK_REALTIME of the transaction; before it, of the newest sample or event
    payload: bytes

    @property
    def key(self) -> tuple[str, str]:
        """Return the key of the numbers: boot and topic. The topic contains gateway, device and stream."""
        return self.boot, self.topic

    @property
    def gateway(self) -> str:
        """Return the name of the gateway when the message was made."""
        return self.topic.split("/")[2]


def row_of(topic: str, stream: Stream, message: FleetMessage, payload: bytes, stored_utc_ns: int) -> SpoolRow:
    """Return a message as a row that is not stored yet."""
    return SpoolRow(
        0, message.boot, message.device, stream.value, message.kind.value, topic, message.first, message.last,
        message.count, stored_utc_ns, payload,
    )  # fmt: skip


def undamaged_row(values: Sequence[object]) -> SpoolRow | None:
    """Return a row; None if the values are damaged."""
    row = _numbered(values)
    if row is None or row.kind not in _KINDS:
        return None
    try:
        head = check_payload(row.payload)
    except ValueError:
        return None
    own = (row.gateway, row.boot, row.device, row.first, row.last)
    return row if (head.gateway, head.boot, head.device, head.first, head.last) == own else None


def repaired_row(values: Sequence[object]) -> SpoolRow | None:
    """Return a `dropped` message in place of a damaged row; None if its numbers are unknown."""
    row = _numbered([*values[:4], "", *values[5:-1], b""])
    if row is None or row.items != row.last - row.first + 1:
        return None
    return row._replace(kind=MessageKind.DROPPED.value, payload=note_of(row, DropCause.DAMAGED))


def is_position(values: Sequence[object]) -> bool:
    """Return whether the values are boot, device, stream, begin and last of a stream."""
    match values:
        case (str() as boot, str(), str() as stream, int() as begin, int() as last):
            return is_name(boot) and stream in _STREAMS and 0 < begin <= last < NUMBER_MOST
    return False


def note_of(row: SpoolRow, cause: DropCause) -> bytes:
    """Return the payload of a `dropped` message in place of a row."""
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
    """Return a row with a valid stream and valid numbers, otherwise None."""
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
# Interval of the synchronization of the log with the disk, ns. A power failure loses the messages of this time.
SYNC_NS: Final = 5 * NS_PER_S
# Size of a page, bytes. The pages of a message that becomes statistics are only free if pages are small: with 4096
# bytes, the default of SQLite, most messages have only a few pages.
PAGE_BYTES: Final = 1024
LOG_PAGES: Final = 4000  # maximum number of pages in the log, 4 MB, the same size as the default of SQLite
LOG_PART: Final = 16  # maximum share of the disk for the log, 1/16: 0.5 MB on a disk of 8 MB
LOG_PAGES_LEAST: Final = 64
RESERVE_FILE: Final = "spool.reserve"
# Size of the reserve in logs: a checkpoint can grow the file by the size of one log, and one transaction needs another
RESERVE_LOGS: Final = 2
LONGEST_BYTES: Final = 1 << 18  # twice the maximum length of a message, bytes
STEP: Final = 32  # number of messages that imud thins or drops between two checks of the size
STEPS_MAX: Final = 64  # maximum number of steps in one transaction: 2,048 messages, more than arrive in one second
# Maximum number of streams with a stored position: three streams of each of 256 devices, and streams of earlier boots.
# A state message with all positions has 120 kB, not more than the longest message.
POSITIONS_MAX: Final = 1024
# Maximum number of stored topics of retained messages: four topics of each of 256 devices, also of removed devices
RETAINED_MAX: Final = 2048
BUSY_S: Final = 1.0  # time to wait for a program that has locked the file, s

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
# Topics of retained messages. Earlier versions stored only the topics to remove.
_RETAINED: Final = "CREATE TABLE IF NOT EXISTS removal (topic TEXT PRIMARY KEY) WITHOUT ROWID"
# Earlier versions stored positions without the name of the gateway, in the table `position`
_COLUMNS: Final = "id, boot, device, stream, kind, topic, first, last, items, stored_utc_ns, payload"
# Condition for messages that the sender did not receive. imud may thin or drop only these.
_FREE: Final = "id > ? AND NOT (id > ? AND id <= ?)"
_ID_MAX: Final = (1 << 63) - 1
_THICK: Final = (MessageKind.SAMPLES.value, MessageKind.SLOTS.value)
_OF_DAMAGE: Final = (sqlite3.DatabaseError, sqlite3.IntegrityError)  # errors that only a damaged file causes


class SpoolError(Exception):
    """The spool cannot be used now. Example: the disk is full."""


class Spool:
    """File of messages. Synchronization: one thread; any thread may read the counters."""

    def __init__(
        self, directory: Path, bytes_max: int, age_ns: int, *, newest_first: bool = False, gateway: str = ""
    ) -> None:
        """`gateway` selects the positions of one gateway name; empty selects the positions of all names."""
        self.messages = 0  # number of messages in the file
        self.used_bytes = 0  # size of the pages in use, bytes
        self.spooled = 0  # number of messages stored since the start
        self.thinned: int = 0  # number of samples that imud replaced by statistics
        self.dropped: dict[str, int] = {}  # number of dropped samples and events, by `DropCause`
        self.set_aside = ""  # path of a renamed damaged file; empty if there is none
        self._path = directory / FILE
        self._bytes_max, self._age_ns = bytes_max, age_ns
        self._gateway = gateway
        self._base: sqlite3.Connection | None = None
        self._next_id = 1
        self._given = 0  # the sender received messages up to this ID
        self._newest_first = newest_first
        # with newest_first: the sender received the messages from the first ID (exclusive) to the second ID before
        # older messages; 0 if no older message waits
        self._ahead_from = self._ahead = 0
        self._thin_from = 0  # all messages up to this ID are already thinned
        self._synced_ns = 0
        # maximum size of the file, pages, while the disk has no room for the reserve
        self._pages_max: int | None = None
        self._markers: dict[tuple[str, str], int] = {}  # ID of the newest `dropped` message, by stream

    # --- life --------------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Open or create the file. Raises SpoolError."""
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
        """Close the file. A second call does nothing."""
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
        newest, self.messages = base.execute("SELECT COALESCE(MAX(id), 0), COUNT(*) FROM message").fetchone()
        if newest >= NUMBER_MOST:
            raise sqlite3.DatabaseError("the row IDs are at their maximum")
        self._next_id = max(self._next_id, newest + 1)
        self.used_bytes = self._used()
        self._thin_from, self._markers = 0, {}
        self._reserve()

    def _log_pages(self) -> int:
        disk = os.statvfs(self._path.parent)
        return max(LOG_PAGES_LEAST, min(LOG_PAGES, disk.f_blocks * disk.f_frsize // LOG_PART // PAGE_BYTES))

    def _reserve(self) -> None:
        """Create the reserve file if the disk has room for it and for a log."""
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
            self._remove_reserve()

    def _restore_reserve(self) -> None:
        """Create the reserve again after it was removed."""
        if self._pages_max is not None:
            self._reserve()

    def _remove_reserve(self) -> None:
        with suppress(OSError):
            os.unlink(self._path.with_name(RESERVE_FILE))

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
        """Store and remove messages, and limit age and size, in one transaction. Raises SpoolError."""
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
                self._restore_reserve()
        except sqlite3.Error as error:
            with suppress(sqlite3.Error):
                base.execute("ROLLBACK")
            self.messages, self.thinned, self.dropped, self._next_id, self._thin_from, self._markers = before
            self._rename_if_damaged(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error
        self.spooled += len(new)

    def remove(self, acknowledged: Collection[int], now_ns: int, utc_ns: int) -> None:
        """Remove messages from a full disk. Raises SpoolError."""
        self._remove_reserve()
        try:
            for some in _batched(acknowledged, max(1, self._log_pages() * PAGE_BYTES // LONGEST_BYTES)):
                # the checkpoint empties the log, so that the next group fits into it
                self._connection().execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
                self.commit((), some, now_ns, utc_ns)
            base = self._connection()
            base.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            self._pages_max = base.execute("PRAGMA page_count").fetchone()[0]
        except sqlite3.Error as error:
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error
        finally:
            self._reserve()

    def after(self, limit: int, skipped: Collection[str] = ()) -> list[SpoolRow]:
        """Return the next messages for the sender, oldest first, without the topics in `skipped`. Raises SpoolError."""
        found: list[SpoolRow] = []
        if self._ahead_from:
            found = self._between(self._ahead, _ID_MAX, limit, skipped)
            self._ahead = found[-1].id if found else self._ahead
            waited = self._between(self._given, self._ahead_from, limit - len(found), skipped)
            self._given = waited[-1].id if waited else self._given
            if not waited and len(found) < limit:  # the sender received all older messages
                self._given, self._ahead_from, self._ahead = self._ahead, 0, 0
            return found + waited
        found = self._between(self._given, _ID_MAX, limit, skipped)
        self._given = found[-1].id if found else self._given
        return found

    def _between(self, after_id: int, last_id: int, limit: int, skipped: Collection[str]) -> list[SpoolRow]:
        """Return the messages after one ID up to another ID, oldest first. Raises SpoolError."""
        if limit <= 0:
            return []
        base = self._connection()
        try:
            topics = f"AND topic NOT IN ({', '.join('?' * len(skipped))})" if skipped else ""
            where = f"id > ? AND id <= ? {topics} ORDER BY id LIMIT ?"
            return self._undamaged(base, where, (after_id, last_id, *skipped, limit))
        except sqlite3.Error as error:
            self._rename_if_damaged(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error

    def rewind(self) -> None:
        """Give all messages again, because the connection was lost or a topic is no longer skipped."""
        self._given = 0
        self._ahead_from = self._ahead = self._next_id - 1 if self._newest_first else 0

    def positions(self) -> list[StreamPosition]:
        """Return the newest numbers of all streams, including earlier boots. Raises SpoolError."""
        try:
            rows = self._connection().execute(
                "SELECT boot, device, stream, begin, last FROM progress WHERE gateway = ? OR ? = ''",
                (self._gateway, self._gateway),
            )
            return [StreamPosition(*row) for row in rows if is_position(row)]
        except sqlite3.Error as error:
            self._rename_if_damaged(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error

    def retained_topics(self) -> list[str]:
        """Return the topics of retained messages that the broker may have. Raises SpoolError."""
        try:
            base = self._connection()
            if not base.execute("SELECT 1 FROM sqlite_master WHERE name = 'removal'").fetchone():
                return []
            rows = base.execute("SELECT topic FROM removal LIMIT ?", (RETAINED_MAX,))
            return [topic for (topic,) in rows if isinstance(topic, str) and topic]
        except sqlite3.Error as error:
            self._rename_if_damaged(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error

    def store_topics(self, topics: Collection[str]) -> None:
        """Replace the stored topics of retained messages. Raises SpoolError."""
        try:
            base = self._connection()
            base.execute("BEGIN IMMEDIATE")
            base.execute(_RETAINED)
            base.execute("DELETE FROM removal")
            base.executemany("INSERT INTO removal VALUES (?)", [(one,) for one in sorted(topics)[:RETAINED_MAX]])
            base.execute("COMMIT")
        except sqlite3.Error as error:
            with suppress(sqlite3.Error):
                base.execute("ROLLBACK")
            self._rename_if_damaged(error)
            raise SpoolError(f"{self._path}: {reason_of(error)}") from error

    def _connection(self) -> sqlite3.Connection:
        if self._base is None:
            raise SpoolError(f"{self._path} is not open")
        return self._base

    def _rename_if_damaged(self, error: Exception) -> None:
        """Rename the file if it is damaged. The next transaction creates a new one."""
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
        # with an unset clock, utc_ns is 0: use a larger number so that imud does not remove the newest first
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
    def _free_values(self) -> tuple[int, int, int]:
        """Return the parameters of `_FREE`."""
        return self._given, self._ahead_from, self._ahead

    def _undamaged(self, base: sqlite3.Connection, where: str, values: Sequence[object]) -> list[SpoolRow]:
        """Return undamaged rows. Replace a damaged row by a `dropped` message; delete it if its numbers are unknown."""
        while True:
            rows = base.execute(f"SELECT {_COLUMNS} FROM message WHERE {where}", values).fetchall()
            found = [row for one in rows if (row := undamaged_row(one) or self._repaired(base, one)) is not None]
            if found or not rows:  # otherwise all rows were deleted, and other rows may follow
                return found

    def _repaired(self, base: sqlite3.Connection, values: Sequence[Any]) -> SpoolRow | None:
        number, row, cause = values[0], repaired_row(values), DropCause.DAMAGED.value
        self.dropped[cause] = self.dropped.get(cause, 0) + (row.items if row is not None else 1)
        if row is None:
            log.warning("mqtt: %s: deleting the damaged message %d, whose numbers are unknown", self._path, number)
            base.execute("DELETE FROM message WHERE id = ?", (number,))
            self.messages -= 1
            return None
        log.warning("mqtt: %s: the numbers %d to %d of %s are damaged", self._path, row.first, row.last, row.topic)
        base.execute("UPDATE message SET kind = ?, payload = ? WHERE id = ?", (row.kind, row.payload, number))
        return row

    def _keep_age(self, base: sqlite3.Connection, utc_ns: int) -> None:
        if utc_ns < CLOCK_SET_NS:
            return
        old_ns = utc_ns - self._age_ns
        oldest = base.execute(
            f"SELECT id, stored_utc_ns FROM message WHERE {_FREE} AND kind != 'dropped' "
            "AND stored_utc_ns BETWEEN ? AND ? ORDER BY id LIMIT ?",
            (*self._free_values, CLOCK_SET_NS, NUMBER_MOST, STEP),
        ).fetchall()
        for number, stored_utc_ns in oldest:
            if stored_utc_ns >= old_ns:
                break
            for row in self._undamaged(base, "id = ?", (number,)):
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
        """Replace the oldest complete samples by statistics. Return whether there were any."""
        found = self._undamaged(
            base, f"{_FREE} AND id > ? AND kind IN (?, ?) ORDER BY id LIMIT ?",
            (*self._free_values, self._thin_from, *_THICK, STEP),
        )  # fmt: skip
        for row in found:
            if row.kind in _THICK:  # a damaged row became a `dropped` message
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
        """Drop the oldest messages. Return whether there were any."""
        found = self._undamaged(base, f"{_FREE} AND kind != 'dropped' ORDER BY id LIMIT ?", (*self._free_values, STEP))
        for row in found:
            self._drop(base, row, DropCause.SPACE)
        return bool(found)

    def _drop(self, base: sqlite3.Connection, row: SpoolRow, cause: DropCause) -> None:
        """Replace a message by a `dropped` message, or add it to the previous `dropped` message."""
        if row.kind == MessageKind.DROPPED.value:
            return
        self.dropped[cause.value] = self.dropped.get(cause.value, 0) + row.items
        before: list[SpoolRow] = []
        marker_id = self._markers.get(row.key, 0)
        if marker_id > self._given and not self._ahead_from < marker_id <= self._ahead:
            before = self._undamaged(base, "id = ?", (marker_id,))
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
    """Yield groups of at most `most` numbers in ascending order."""
    left = iter(sorted(numbers))
    while some := tuple(islice(left, most)):
        yield some


def _text_of(stored: bytes) -> str:
    """Return a stored string. Accept damaged UTF-8, because `undamaged_row` checks the row later."""
    return stored.decode("utf-8", "replace")
