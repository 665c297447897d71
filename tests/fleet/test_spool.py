"""Spool: order, size, age, full disk, damaged file. Exactly one message covers each number in all cases."""

import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from random import Random

import msgspec
import pytest

from imud.fleet import messages as fleet_messages
from imud.fleet import spool
from imud.fleet.accounts import FleetLedger, StreamCounts
from imud.fleet.messages import FleetMessage, MessageKind, Stream, decode_message, encode_message
from imud.formats.slot import encode_slots
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S

CLOCK_SET_NS, STEP = 1_577_836_800 * NS_PER_S, 32

HOUR_NS = 3600 * NS_PER_S
UTC_NS = CLOCK_SET_NS + 10_000 * HOUR_NS


def batch(first: int, count: int = 100, device: str = "bow", *, whole: bool = True) -> spool.SpoolRow:
    stream, last = Stream.SAMPLES if whole else Stream.EVENTS, first + count - 1
    samples = [
        Sample(device, seq, seq, 0, Sync.EDGE, seq, seq, accel_m_s2=(seq * 0.37, seq / 7, 9.8))
        for seq in range(first, last + 1)
    ]
    message = FleetMessage(
        v=fleet_messages.VERSION, gateway="gw", boot="1", device=device, begin=1,
        kind=MessageKind.SLOTS if whole else MessageKind.EVENTS, first=first, last=last, count=count, utc_ns=last,
    )  # fmt: skip
    payload = (
        fleet_messages.encode_slots_message(message, encode_slots(samples, 0)) if whole else encode_message(message)
    )
    return spool.row_of(fleet_messages.topic_of("site", "gw", device, stream), stream, message, payload, 0)


class SpoolBench:
    def __init__(self, path: Path, kilobytes: int = 100_000, hours: float = 100, *, newest_first: bool = False) -> None:
        self.spool = spool.Spool(path, kilobytes * 1000, round(hours * HOUR_NS), newest_first=newest_first)
        self.spool.open()
        self.now_ns = 0

    def commit(self, *rows: spool.SpoolRow, done: tuple[int, ...] = (), utc_ns: int = UTC_NS) -> None:
        self.now_ns += NS_PER_S
        self.spool.commit(rows, done, self.now_ns, utc_ns)

    def all(self) -> list[spool.SpoolRow]:
        self.spool.rewind()
        found = self.spool.after(1_000_000)
        self.spool.rewind()
        return found

    def counts(self) -> StreamCounts:
        ledger = FleetLedger(from_begin=True)
        for row in self.all():
            ledger.take(decode_message(row.payload), Stream(row.stream))
        (found,) = [one for key, one in ledger.counts.items() if key.stream == "samples"]
        assert found.balance == 0
        return found


def test_messages_are_given_in_order_until_they_are_acknowledged(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path)
    bench.commit(batch(1), batch(101), batch(201))
    first = bench.spool.after(2)
    assert [row.first for row in first] == [1, 101]
    assert ([row.first for row in bench.spool.after(5)], bench.spool.after(5)) == ([201], [])
    bench.commit(done=(first[0].id,))
    assert [row.first for row in bench.all()] == [101, 201]
    assert bench.spool.messages == 2


@pytest.mark.live
def test_committed_messages_survive_the_end_of_the_process(tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path; from tests.fleet.test_spool import SpoolBench, batch\n"
        "bench = SpoolBench(Path(sys.argv[1]))\n"
        "for n in range(5): bench.commit(batch(100 * n + 1))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code, tmp_path], check=False)
    assert ended.returncode == -9
    bench = SpoolBench(tmp_path)
    assert bench.counts() == StreamCounts(1, 500, whole=500)
    assert bench.spool.positions()[0].last == 500
    bench.commit(batch(501))
    assert [row.id for row in bench.all()] == [1, 2, 3, 4, 5, 6]


def test_the_oldest_samples_become_statistics_before_anything_is_dropped(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path, kilobytes=300)
    for number in range(150):
        bench.commit(batch(100 * number + 1))
        assert bench.spool.used_bytes <= 300_000
    counts = bench.counts()
    assert counts.dropped == {}
    assert counts.thinned >= 3_000
    assert counts.whole >= 1000
    assert (counts.whole + counts.thinned, bench.spool.thinned) == (15_000, counts.thinned)
    kinds = [row.kind for row in bench.all()]
    assert kinds == sorted(kinds), "intervals are the oldest, slots the newest"


def test_the_oldest_messages_are_dropped_and_counted_if_all_are_thinned(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path, kilobytes=100)
    for number in range(200):
        bench.commit(batch(100 * number + 1), batch(number + 1, 1, whole=False))
        assert bench.spool.used_bytes <= 100_000
    counts = bench.counts()
    assert (counts.missing, counts.newest) == (0, 20_000)
    assert counts.dropped["space"] > 5_000
    rows = bench.all()
    events = sum(row.items for row in rows if row.stream == "events" and row.kind == "dropped")
    assert bench.spool.dropped["space"] == counts.dropped["space"] + events
    assert sum(row.kind == "dropped" for row in rows) == 2, "neighbours share one note for each stream"


def test_new_messages_are_given_first_with_newest_first(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path, newest_first=True)
    bench.commit(batch(1), batch(101), batch(201), batch(301))
    bench.spool.rewind()
    assert [row.first for row in bench.spool.after(1)] == [1]
    bench.commit(batch(401), batch(501))
    assert [row.first for row in bench.spool.after(3)] == [401, 501, 101]
    bench.commit(batch(601))
    assert [row.first for row in bench.spool.after(9)] == [601, 201, 301]
    assert bench.spool.after(9) == []
    bench.commit(batch(701), batch(801))
    assert [row.first for row in bench.spool.after(1)] == [701]
    assert [row.first for row in bench.spool.after(9)] == [801]
    bench.spool.rewind()
    assert [row.first for row in bench.spool.after(9)] == list(range(1, 900, 100))


@pytest.mark.parametrize("newest_first", [False, True])
def test_messages_in_the_sender_are_not_changed(tmp_path: Path, newest_first: bool) -> None:
    bench = SpoolBench(tmp_path, kilobytes=150, newest_first=newest_first)
    bench.commit(batch(1), batch(101))
    bench.spool.rewind()
    bench.commit(batch(201), batch(301))
    given = bench.spool.after(2)
    assert [row.first for row in given] == ([201, 301] if newest_first else [1, 101])
    for number in range(4, 200):
        bench.commit(batch(100 * number + 1))
    assert bench.spool.thinned > 0
    assert bench.spool.dropped["space"] > 0
    kept = {row.id: row for row in bench.all()}
    assert [kept[row.id] for row in given] == given
    assert bench.counts().missing == 0


@pytest.mark.parametrize("newest_first", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_everything_is_given_once_and_never_changed_afterwards(tmp_path: Path, seed: int, newest_first: bool) -> None:
    random = Random(seed)
    bench = SpoolBench(tmp_path, kilobytes=random.choice([120, 250, 100_000]), newest_first=newest_first)
    ledger, first, given = FleetLedger(from_begin=True), 1, dict[int, spool.SpoolRow]()
    for _ in range(150):
        match random.randrange(8):
            case 0:
                bench.spool.rewind()
                given.clear()
            case 1 | 2 if given:
                done = tuple(random.sample(sorted(given), random.randint(1, len(given))))
                for number in done:
                    ledger.take(decode_message(given.pop(number).payload), Stream.SAMPLES)
                bench.commit(done=done)
            case 3 | 4:
                for row in bench.spool.after(random.randint(1, 6)):
                    assert row.id not in given
                    given[row.id] = row
            case _:
                bench.commit(*(batch(first + 100 * number) for number in range(2)))
                first += 200
    kept = {row.id: row for row in bench.all()}
    assert {number: row.payload for number, row in kept.items() if number in given} == {
        number: row.payload for number, row in given.items()
    }
    for row in kept.values():
        ledger.take(decode_message(row.payload), Stream.SAMPLES)
    (counts,) = ledger.counts.values()
    assert (counts.newest, counts.missing, counts.balance) == (first - 1, 0, 0)


def test_ages_count_only_while_the_clock_is_set(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path, hours=1)
    bench.commit(batch(1), batch(101))
    bench.commit(batch(201), utc_ns=UTC_NS + HOUR_NS // 2)
    bench.commit(utc_ns=UTC_NS + HOUR_NS + 1)
    assert bench.counts() == StreamCounts(1, 300, whole=100, dropped={"age": 200})
    assert bench.spool.dropped == {"age": 200}
    bench = SpoolBench(tmp_path / "other", hours=1)
    bench.commit(batch(1), utc_ns=5 * NS_PER_S)
    bench.commit(batch(101), utc_ns=UTC_NS)
    bench.commit(utc_ns=UTC_NS + 1)
    assert bench.counts() == StreamCounts(1, 200, whole=200)


def test_a_delivered_dropped_message_is_not_extended(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path, hours=1)
    bench.commit(batch(1))
    bench.commit(batch(101), utc_ns=UTC_NS + HOUR_NS)
    bench.commit(utc_ns=UTC_NS + HOUR_NS + 1)
    (note,) = bench.spool.after(1)
    assert note.kind == "dropped"
    bench.commit(utc_ns=UTC_NS + 2 * HOUR_NS + 2)
    bench.commit(done=(note.id,), utc_ns=UTC_NS + 2 * HOUR_NS + 2)
    (left,) = bench.all()
    assert (left.first, left.last, left.kind) == (101, 200, "dropped")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a file system of 512 kB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k", "x", disk], check=False).returncode:
        pytest.skip("no tmpfs can be mounted here")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_a_full_disk_does_not_change_the_spool_until_messages_are_acknowledged(small_disk: Path) -> None:
    bench, number = SpoolBench(small_disk), 0
    with pytest.raises(spool.SpoolError, match="full"):  # noqa: PT012
        while True:
            bench.commit(batch(100 * number + 1))
            number += 1
    assert (bench.spool.messages, bench.spool.thinned) == (number, 0)
    assert number > 5
    assert bench.counts() == StreamCounts(1, 100 * number, whole=100 * number)
    bench.spool.close()
    bench = SpoolBench(small_disk)
    assert bench.counts() == StreamCounts(1, 100 * number, whole=100 * number)
    given = bench.spool.after(1000)
    assert len(given) == number
    bench.spool.remove([row.id for row in given], bench.now_ns, UTC_NS)
    assert bench.spool.messages == 0
    for _ in range(300):  # after this loop the file does not grow, and imud thins messages
        bench.commit(batch(100 * number + 1))
        number += 1
    assert bench.spool.thinned > 0


def test_the_reserve_is_created_again_when_the_disk_has_room(small_disk: Path) -> None:
    reserve, other = small_disk / spool.RESERVE_FILE, small_disk / "other"
    bench = SpoolBench(small_disk)
    assert reserve.stat().st_size > 100_000
    bench.commit(batch(1))
    with suppress(OSError), other.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1024))
    (row,) = bench.spool.after(1)
    bench.spool.remove([row.id], bench.now_ns, UTC_NS)
    assert not reserve.exists()
    for number in range(1, 20):
        bench.commit(batch(100 * number + 1))
    assert not reserve.exists()
    other.unlink()
    for number in range(20, 26):
        bench.commit(batch(100 * number + 1))
    assert reserve.stat().st_size > 100_000


def test_a_damaged_file_and_a_file_with_the_maximum_row_id_are_renamed(tmp_path: Path) -> None:
    (tmp_path / spool.FILE).write_bytes(b"This is no database at all, and it is long enough to be seen as none." * 100)
    bench = SpoolBench(tmp_path)
    assert bench.spool.set_aside == str(tmp_path / "spool.db.damaged")
    bench.commit(batch(1))
    assert bench.counts() == StreamCounts(1, 100, whole=100)
    (tmp_path / "file").write_text("")
    with pytest.raises(spool.SpoolError, match="file"):
        spool.Spool(tmp_path / "file" / "spool", 1_000_000, HOUR_NS).open()
    folder = tmp_path / "maximum"
    bench = SpoolBench(folder)
    bench.commit(batch(1))
    bench.spool.close()
    damage(folder, "id = 9223372036854775807", "id = 1")
    again = SpoolBench(folder)
    again.commit(batch(101))
    assert again.spool.set_aside
    assert [row.first for row in again.all()] == [101]


def test_a_file_that_is_damaged_later_is_renamed_at_the_next_attempt(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path)
    for number in range(STEP):
        bench.commit(batch(100 * number + 1))
    bench.spool.close()
    path = tmp_path / spool.FILE
    content = bytearray(path.read_bytes())
    content[1024:] = b"\xa5" * (len(content) - 1024)
    path.write_bytes(content)
    bench = SpoolBench(tmp_path)
    for _ in range(2):
        try:
            bench.commit(batch(1))
        except spool.SpoolError:
            continue
    assert bench.spool.set_aside
    assert bench.counts().whole == 100
    for use in (spool.Spool.positions, spool.Spool.retained_topics, lambda one: one.store_topics(["a"])):
        bench = SpoolBench(tmp_path)
        bench.commit(batch(1))
        for one in tmp_path.glob("spool.db*"):
            one.write_bytes(b"\xff" * 10_000)
        with pytest.raises(spool.SpoolError, match="not a database"):
            use(bench.spool)
        assert [one.name for one in tmp_path.glob("spool.db*")] == ["spool.db.damaged"]


def test_an_invalid_payload_is_dropped_as_damaged(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path, kilobytes=60)
    bench.commit(batch(1)._replace(payload=b"IMUB" + bytes(30_000)))
    for number in range(1, 20):
        bench.commit(batch(100 * number + 1))
    assert bench.spool.dropped["damaged"] == 100
    assert bench.counts().dropped["damaged"] == 100


# Damage of a row by a disk, as SQL. SQLite returns all these values without an error.
DAMAGE = {
    "a topic that is no text": "topic = CAST(x'696d75642f73ff' AS TEXT)",
    "a topic with a wildcard": "topic = 'imud/site/#/bow/samples'",
    "a payload that is a number": "payload = 17",
    "a payload with other bytes": "payload = x'00ff'",
    "JSON that ends early": 'payload = CAST(\'{"boot":"1"\' AS BLOB)',
    "slots that cannot be decompressed": "payload = CAST(substr(payload, 1, length(payload) - 9) AS BLOB)",
    "a boot that is no text": "boot = CAST(x'ff' AS TEXT)",
    "a device that is not that of the topic": "device = 'stern'",
    "a kind that there is not": "kind = 'other'",
    "numbers that are not those of the payload": "first = 150",
    "a number that is a text": "last = 'many'",
    "a time that is a text": "stored_utc_ns = 'never'",
}


def damage(folder: Path, change: str, where: str = "id = 2", table: str = "message") -> None:
    base = sqlite3.connect(folder / spool.FILE, isolation_level=None)
    base.execute(f"UPDATE {table} SET {change} WHERE {where}")
    base.close()


@pytest.mark.parametrize("change", DAMAGE.values(), ids=DAMAGE)
@pytest.mark.parametrize("kilobytes", [100_000, 20], ids=["read", "thinned"])
def test_a_damaged_row_does_not_affect_other_rows(tmp_path: Path, change: str, kilobytes: int) -> None:
    bench = SpoolBench(tmp_path)
    bench.commit(*(batch(100 * number + 1) for number in range(10)))
    bench.spool.close()
    damage(tmp_path, change)
    again = SpoolBench(tmp_path, kilobytes=kilobytes)
    again.commit(batch(1001))
    assert [one.last for one in again.spool.positions()] == [1100]
    counts = again.counts()
    assert (counts.newest, counts.whole + counts.thinned + counts.dropped.get("space", 0)) == (1100, 1000)
    assert counts.dropped.get("damaged", 0) + counts.missing == 100
    assert set(again.spool.dropped) <= {"damaged", "space"}
    assert again.spool.dropped["damaged"]


def test_damaged_rows_are_dropped_or_deleted_and_damaged_positions_ignored(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path)
    bench.commit(*(batch(100 * number + 1) for number in range(3)))
    damage(tmp_path, "payload = 17")
    counts = bench.counts()
    assert (counts.whole, counts.dropped, counts.missing) == (200, {"damaged": 100}, 0)
    assert bench.counts() == counts, "the note is stored, and counts once"
    assert (bench.spool.dropped, bench.spool.messages) == ({"damaged": 100}, 3)
    bench = SpoolBench(tmp_path / "deleted")
    bench.commit(*(batch(100 * number + 1) for number in range(4)))
    damage(tmp_path / "deleted", "topic = ''", "id <= 2")
    assert ([row.first for row in bench.spool.after(2)], bench.spool.messages) == ([201, 301], 2)
    bench = SpoolBench(tmp_path / "position")
    bench.commit(batch(1), batch(1, device="stern"))
    damage(tmp_path / "position", "stored_utc_ns = 'never', boot = CAST(x'ff' AS TEXT)", "device = 'stern'", "progress")
    bench.commit(batch(101))
    assert [(one.device, one.last) for one in bench.spool.positions()] == [("bow", 200)]


def test_positions_and_dropped_messages_belong_to_one_name_of_the_gateway(tmp_path: Path) -> None:
    old = spool.Spool(tmp_path, 1 << 30, HOUR_NS, gateway="gw")
    old.open()
    old.commit([batch(1)], (), 1, UTC_NS)
    old.close()
    new = spool.Spool(tmp_path, 1 << 30, HOUR_NS, gateway="other")
    new.open()
    assert new.positions() == []
    row = batch(101)
    new.commit([row._replace(topic=row.topic.replace("gw", "other"))], (), 1, UTC_NS)
    assert [(one.begin, one.last) for one in new.positions()] == [(101, 200)]
    new.close()
    bench = SpoolBench(tmp_path / "dropped", hours=1)
    first, second = batch(1), batch(101)
    bench.commit(first, second._replace(topic=second.topic.replace("gw", "other")))
    bench.commit(utc_ns=UTC_NS + 2 * HOUR_NS)
    found = [(row.gateway, row.first, row.last, row.kind) for row in bench.spool.after(9)]
    assert found == [("gw", 1, 100, "dropped"), ("other", 101, 200, "dropped")]


def test_the_streams_of_the_maximum_number_of_devices_keep_their_begin(tmp_path: Path) -> None:
    bench = SpoolBench(tmp_path)
    for first in (1, 2):
        for whole in (True, False):
            bench.commit(*(batch(first, 1, f"device-{number}", whole=whole) for number in range(256)))
    positions = bench.spool.positions()
    assert (len(positions), {(one.begin, one.last) for one in positions}) == (512, {(1, 2)})


def test_a_row_survives_storing_and_its_numbers_are_checked() -> None:
    assert spool.undamaged_row(tuple(batch(1))) == batch(1)
    assert spool.undamaged_row(tuple(batch(7, 1, whole=False))) == batch(7, 1, whole=False)
    message = decode_message(batch(1).payload)
    for name, value in (("first", 2), ("last", 99), ("boot", "2"), ("device", "stern"), ("gateway", "other")):
        other = msgspec.structs.replace(message, kind=MessageKind.EVENTS, samples=[], **{name: value})
        row = spool.row_of(batch(1).topic, Stream.SAMPLES, message, msgspec.json.encode(other), 0)
        assert spool.undamaged_row(tuple(row)) is None, name


@pytest.mark.parametrize("column", spool.SpoolRow._fields[1:])
def test_a_column_of_another_type_is_detected_or_harmless(column: str) -> None:
    """Any number is a valid time. No sent message contains `items`."""
    for value in (None, 1.5, "text", b"\xff", -1, 1 << 63):  # values that SQLite can return in any column
        row = spool.undamaged_row(tuple(value if name == column else one for name, one in batch(1)._asdict().items()))
        assert row is None or column in ("stored_utc_ns", "items"), value


@pytest.mark.parametrize("column", ["kind", "payload"])
def test_a_row_with_known_numbers_becomes_a_dropped_message(column: str) -> None:
    row = spool.repaired_row([17 if name == column else one for name, one in batch(101)._asdict().items()])
    assert row is not None
    note = decode_message(row.payload)
    assert (note.kind, note.cause, note.first, note.last, note.count) == (
        MessageKind.DROPPED, fleet_messages.DropCause.DAMAGED, 101, 200, 100,
    )  # fmt: skip
    assert (note.gateway, note.boot, note.device) == ("gw", "1", "bow")
    assert spool.undamaged_row(tuple(row)) == row


@pytest.mark.parametrize("change", [{"last": 900}, {"items": 3}, {"topic": "imud/x"}, {"boot": ""}, {"first": 0}])
def test_a_row_with_inconsistent_numbers_does_not_become_a_dropped_message(change: dict[str, object]) -> None:
    """A `dropped` message with wrong numbers would make other messages duplicates."""
    assert spool.repaired_row([change.get(name, one) for name, one in batch(101)._asdict().items()]) is None


def test_positions() -> None:
    assert spool.is_position(("1", "bow", "samples", 1, 9))
    assert spool.is_position(("1", "", "events", 9, 9))
    for values in (
        ("1", "bow", "samples", 0, 9), ("1", "bow", "samples", 9, 1), ("1", "bow", "other", 1, 9),
        ("\ufffd", "bow", "samples", 1, 9), ("1", "bow", "samples", 1, "9"), ("1", None, "samples", 1, 9),
        ("1", "bow", "samples", 1, 1 << 62),
    ):  # fmt: skip
        assert not spool.is_position(values), values
