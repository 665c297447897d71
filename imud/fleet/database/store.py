"""Store of `imud fleet collect --to postgresql://…`: connection, repeated transactions and rejected messages.

    messages ──▶ FleetTransaction ──▶ COMMIT ──▶ (the collector) acknowledge

Each record is stored exactly once, because one transaction contains the rows and their ledger. Any number of collectors
writes to one database. A deadlock, or a connection that the server ends, repeats the transaction. If the database
contains rows that the ledger does not, COPY fails. Then imud repeats the transaction with temporary tables and ON
CONFLICT DO NOTHING, which takes twice as long. If the database cannot store a value, imud halves the messages until it
finds the message, and stores this message in the table `imud_rejected`.
"""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from typing import Any, Final, TypeVar

from imud.fleet.accounts import BOOTS_MAX, BootKey, BootOffset
from imud.fleet.connection import FleetDelivery
from imud.fleet.database.connection import connected, deadline, sentence_of
from imud.fleet.database.rows import TableRows, columns_of
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.transaction import (
    DecodedDelivery,
    FleetTransaction,
    RowRemoved,
    StoreCounts,
    copy_rows,
    insert_new_rows,
)
from imud.fleet.database.upkeep import Upkeep
from imud.fleet.messages import FleetMessage
from imud.fleet.reader import decode_delivery
from imud.host.installation import needs_extra
from imud.model.errors import ServerError
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

T = TypeVar("T")

# Classes of SQLSTATE that the values of a row can cause: data exception, program limit exceeded
OF_VALUES: Final = ("22", "54")
# SQLSTATE of conflicts between collectors: serialization failure, deadlock, lock timeout
OF_CONFLICTS: Final = ("40001", "40P01", "55P03")
CONFLICTS_MAX: Final = 10  # maximum number of repetitions of a transaction after conflicts
# Number of attempts to connect again, and the pause before each, s. The restart of a server takes some seconds.
ATTEMPTS: Final = 20
ATTEMPT_PAUSE_S: Final = 0.5
TRANSACTION_S: Final = 60  # maximum time of a transaction, s, with waits for locks of rows
UPKEEP_NS: Final = 60 * NS_PER_S  # interval of the upkeep
REJECTED_MAX: Final = 10_000  # maximum number of rows in imud_rejected
PAYLOAD_BYTES: Final = 4096  # maximum length of a payload in imud_rejected
REASON_CHARACTERS: Final = 1000

_REJECT: Final = "INSERT INTO imud_rejected (topic, reason, payload_bytes, payload) VALUES (%s, %s, %s, %s)"
_FORGET_REJECTED: Final = (
    "DELETE FROM imud_rejected WHERE id IN (SELECT id FROM imud_rejected WHERE id < (SELECT id FROM imud_rejected "
    f"ORDER BY id DESC OFFSET {REJECTED_MAX - 1} LIMIT 1) FOR UPDATE SKIP LOCKED)"
)


class PostgresStore:
    """Store in a PostgreSQL database. Synchronization: one thread at a time."""

    def __init__(
        self, url: str, settings: CollectorSettings = CollectorSettings(), *,  # noqa: B008
        from_begin: bool = False, now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        """Connect and create missing tables. With `from_begin`, numbers before the first message of a stream count as
        missing. Raises ServerError."""
        with needs_extra("fleet", ServerError):
            import psycopg
        self.counts = StoreCounts()  # since the start of this process
        self._url, self._from_begin, self._now_ns = url, from_begin, now_ns
        self._error: type[Exception] = psycopg.Error
        self._conflict: type[Exception] = psycopg.errors.UniqueViolation
        self._offsets: dict[BootKey, BootOffset] = {}  # newest clock offsets of boots with an offset in the database
        self._upkeep = Upkeep(settings)
        self._upkeep_ns = now_ns()
        self._connect()

    # --- connection ---------------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        self._connection = connected(self._url)
        try:
            with (
                deadline(self._connection, TRANSACTION_S),
                self._connection.transaction(),
                self._connection.cursor() as cursor,
            ):
                self._upkeep.prepare(cursor)
        except self._error as error:
            self.close()
            raise ServerError(f"PostgreSQL: {sentence_of(error)}") from error
        except ServerError:
            self.close()
            raise

    @property
    def server_pid(self) -> int | None:
        """Return the server process of the connection; None while it is closed. Any thread may read it."""
        connection = self._connection
        return None if connection.closed else connection.info.backend_pid

    def close(self) -> None:
        """Close the connection. A second call does nothing."""
        connection = getattr(self, "_connection", None)
        if connection is not None:
            with suppress(self._error):
                connection.close()

    # --- messages -----------------------------------------------------------------------------------------------------

    def write(self, deliveries: Sequence[FleetDelivery]) -> None:
        """Store messages in one transaction, and do the upkeep. Raises ServerError."""
        items, invalid = _decoded(deliveries)
        try:
            self._write(items, invalid)
        except ServerError as error:
            if not self._connection.closed:
                raise
            self._connect_again(error)
            self._write(items, invalid)

    def ledger_text(self) -> str:
        """Return a summary of this run and of the ledger in the database. Raises ServerError."""

        def read(cursor: Any) -> Any:
            cursor.execute(
                "SELECT count(*), coalesce(sum(missing), 0), coalesce(sum(dropped), 0), count(*) FILTER (WHERE "
                "newest - begin + 1 <> whole + thinned + dropped + missing) FROM imud_ledger"
            )
            return cursor.fetchone()

        streams, missing, dropped, unbalanced = self._transact(read)
        own = self.counts
        open_streams = f", streams that do not balance: {unbalanced}" if unbalanced else ""
        return (
            f"this run: {own.messages} messages, {own.rows} rows, {own.duplicates} duplicate numbers, {own.rejected} "
            "rejected messages\n"
            f"ledger of the database: streams: {streams}, missing: {missing}, dropped: {dropped}{open_streams}"
        )

    def _connect_again(self, cause: ServerError) -> None:
        """Connect to a server that ended the connection. Raises ServerError after ATTEMPTS attempts."""
        log.warning("%s; connecting again", cause)
        for attempt in range(ATTEMPTS):
            time.sleep(ATTEMPT_PAUSE_S)
            with suppress(ServerError) if attempt < ATTEMPTS - 1 else nullcontext():
                self._connect()
                return

    def _write(self, items: Sequence[DecodedDelivery], invalid: Sequence[tuple[FleetDelivery, str]]) -> None:
        """Store messages and rejected messages. A repeated call stores each message once."""
        if items:
            self._store(items)
        if invalid:
            self._reject(invalid)
        if self._now_ns() >= self._upkeep_ns:
            self._upkeep_ns = self._now_ns() + UPKEEP_NS
            self._run_upkeep()

    def _store(self, items: Sequence[DecodedDelivery]) -> None:
        """Store messages in one transaction. Store halves if a value cannot be stored. Raises ServerError."""
        try:
            try:
                self._store_with(copy_rows, items)
            except self._conflict:
                self._store_with(insert_new_rows, items)
        except (self._error, ValueError, OverflowError) as error:
            if isinstance(error, self._error) and not _sqlstate(error).startswith(OF_VALUES):
                raise ServerError(f"PostgreSQL: {sentence_of(error)}") from error
            if len(items) == 1:
                self._reject([(items[0].delivery, sentence_of(error))])
                return
            middle = len(items) // 2
            self._store(items[:middle])
            self._store(items[middle:])

    def _store_with(self, insert: Callable[[Any, TableRows], None], items: Sequence[DecodedDelivery]) -> None:
        def run(cursor: Any) -> FleetTransaction:
            one = FleetTransaction(cursor, items, self._offsets, from_begin=self._from_begin)
            one.run(insert)
            return one

        done = self._repeated(run)
        self.counts.add(done.counts)
        self._offsets |= done.offsets
        while len(self._offsets) > BOOTS_MAX:
            del self._offsets[next(iter(self._offsets))]

    def _repeated(self, work: Callable[[Any], T]) -> T:
        """Run a transaction. Repeat it after a conflict with another collector."""
        for attempt in range(CONFLICTS_MAX):
            try:
                with (
                    deadline(self._connection, TRANSACTION_S),
                    self._connection.transaction(),
                    self._connection.cursor() as cursor,
                ):
                    return work(cursor)
            except (self._error, RowRemoved) as error:
                if isinstance(error, self._error) and _sqlstate(error) not in OF_CONFLICTS:
                    raise
                log.warning("PostgreSQL: %s; attempt %d of %d", sentence_of(error), attempt + 1, CONFLICTS_MAX)
        raise ServerError(
            f"PostgreSQL: cannot store messages after {CONFLICTS_MAX} conflicts with other transactions; see "
            "pg_stat_activity"
        )

    def _transact(self, work: Callable[[Any], T]) -> T:
        """Run a transaction. Raises ServerError."""
        try:
            return self._repeated(work)
        except self._error as error:
            raise ServerError(f"PostgreSQL: {sentence_of(error)}") from error

    def _reject(self, invalid: Sequence[tuple[FleetDelivery, str]]) -> None:
        """Store messages in the table `imud_rejected`. Raises ServerError."""
        for delivery, reason in invalid:
            log.warning("%s: %s; the message is in imud_rejected", delivery.topic, reason)
        rows = [
            (one.topic, _storable(reason), len(one.payload), bytes(one.payload[:PAYLOAD_BYTES]))
            for one, reason in invalid
        ]

        def insert(cursor: Any) -> None:
            cursor.executemany(_REJECT, rows)
            cursor.execute(_FORGET_REJECTED)

        self._transact(insert)
        self.counts.rejected += len(invalid)

    def _run_upkeep(self) -> None:
        """Do the upkeep of the tables, in transactions of its own. Raises ServerError if the connection is lost."""
        try:
            with self._connection.cursor() as cursor:
                self._upkeep.run(cursor)
        except self._error as error:
            raise ServerError(f"PostgreSQL: {sentence_of(error)}") from error


def _decoded(
    deliveries: Sequence[FleetDelivery],
) -> tuple[list[DecodedDelivery], list[tuple[FleetDelivery, str]]]:
    """Return the decoded messages, and the other messages with the reason."""
    items, invalid = list[DecodedDelivery](), list[tuple[FleetDelivery, str]]()
    for one in deliveries:
        try:
            parts, content = decode_delivery(one)
            columns = columns_of(content.intervals) if isinstance(content, FleetMessage) else []
        except ValueError as error:
            invalid.append((one, str(error)))
        else:
            items.append(DecodedDelivery(one, parts.site, parts.gateway, parts.leaf, content, columns))
    return items, invalid


def _sqlstate(error: Exception) -> str:
    return getattr(error, "sqlstate", None) or ""


def _storable(text: str) -> str:
    """Return text that PostgreSQL can store."""
    return text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")[:REASON_CHARACTERS]
