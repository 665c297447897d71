"""Store of line protocol: lines of all records, replies of the server, and rows in a real InfluxDB despite kills."""

import subprocess
import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from imud.cli.fleet import store_of
from imud.fleet.accounts import BootKey, BootOffset
from imud.fleet.collector import LedgerStore
from imud.fleet.influx import ATTEMPTS, REQUEST_BYTES, InfluxStore, clock_lines, lines_of
from imud.fleet.messages import DropCause, FleetMessage, Stream
from imud.fleet.reader import Fleet, FleetBatch
from imud.host.http_post import HttpPost, PostAccess, RequestTooLarge, post_url
from imud.model.errors import BadArgument, ServerError
from imud.model.event import Event, EventKind
from tests.fleet.fleet_gateway import (
    UTC_NS,
    SendingGateway,
    dropped_message,
    event_message,
    intervals_message,
    not_set,
    samples_message,
    synchronised,
)
from tests.fleet.mosquitto import Mosquitto
from tests.support.daemon_process import wait_until
from tests.support.event_loops import VirtualClock
from tests.support.line_protocol import NO_INFLUX, FakeDatabase, fake_database, influx_server, parse_line


def batch(message: FleetMessage, stream: Stream = Stream.SAMPLES) -> FleetBatch:
    return FleetBatch("mill", stream, message)


def test_golden_lines() -> None:
    place = "device=bow,gateway=gw"
    (sample,) = lines_of(batch(synchronised(samples_message(3, 3), error_ns=40)))
    assert sample == (
        f'imud_sample,{place},site=mill boot="1",utc_set=true,utc_err_ns=40i,seq=3i,t_ns=3000000i,t_err_ns=500i,'
        'sync="edge",t_rx_ns=3000010i,accel_m_s2_x=0.375,accel_m_s2_y=0.0,accel_m_s2_z=9.75,temperature_c=21.5 '
        "1790000000003000000\n"
    )
    (interval,) = lines_of(batch(not_set(intervals_message(2, 4, utc_ns=0)), Stream.STATISTICS))
    assert interval == (
        f'imud_interval,{place},site=mill,stream=statistics boot="1",utc_set=false,first=2i,last=4i,count=3i,'
        't_ns=2000000i,end_t_ns=4000000i,t_err_ns=500i,sync="edge",accel_m_s2_x_mean=1.0,accel_m_s2_y_mean=2.0,'
        "accel_m_s2_z_mean=3.0 2000000\n"
    )
    message = event_message(5, 5_000_000)
    twice = msgspec.structs.replace(message, events=[*message.events, Event(5_000_000, "bow", EventKind.UP, "again")])
    first, second = map(parse_line, lines_of(batch(twice, Stream.EVENTS)))
    assert (first.tags["kind"], first.fields["message"], first.time_ns + 1) == ("up", "it is up", second.time_ns)
    dropped = msgspec.structs.replace(dropped_message(6, 7), cause=DropCause.AGE)
    (parsed,) = map(parse_line, lines_of(batch(dropped)))
    assert (parsed.measurement, parsed.tags["stream"]) == ("imud_dropped", "samples")
    assert {name: parsed.fields[name] for name in ("first", "last", "cause")} == {"first": 6, "last": 7, "cause": "age"}
    assert list(clock_lines({BootKey("gw", "1"): BootOffset(5, UTC_NS, None)})) == [
        f'imud_clock,gateway=gw boot="1",t_ns=5i,utc_offset_ns={UTC_NS}i 1790000000000000005\n'
    ]


@pytest.fixture
def database() -> Iterator[FakeDatabase]:
    with fake_database() as made:
        yield made


class Rig:
    def __init__(self, database: FakeDatabase) -> None:
        url = post_url(database.url)
        assert url is not None
        self.pauses: list[float] = []
        self.store = InfluxStore(HttpPost(url, PostAccess(), VirtualClock().now_ns), self.pauses.append)

    def write(self, *messages: FleetMessage) -> None:
        try:
            self.store.write([batch(one) for one in messages], {})
        finally:
            self.store.close()


def test_messages_are_written_after_failures_of_the_server(database: FakeDatabase) -> None:
    rig = Rig(database)
    database.replies = [(503, ""), (0, ""), (429, "")]
    rig.write(samples_message(1, 2), samples_message(3, 3))
    assert [one.fields["seq"] for one in database.lines] == [1, 2, 3] * 2, "the lost reply repeats the lines"
    assert rig.pauses == [0.5] * 3
    database.bodies.clear()
    rig.write(*(samples_message(first, first + 199) for first in range(1, 8000, 200)))
    assert len(database.bodies) > 1
    assert all(len(body) <= REQUEST_BYTES for body in database.bodies)
    assert [one.fields["seq"] for one in database.lines] == list(range(1, 8001))


@pytest.mark.parametrize(
    ("replies", "problem"),
    [
        ([(401, "bad token")] * (ATTEMPTS + 1), "cannot send: the server replied 401: bad token; the broker keeps"),
        ([(404, "no database")] * (ATTEMPTS + 1), "cannot send: the server replied 404: no database"),
        ([(413, "")] * 2, r"expected the reply 204 to \d+ bytes, but the server replied 413"),
        ([(500, "disk")] * (ATTEMPTS + 1), "cannot send: the server replied 500: disk"),
    ],
)
def test_a_server_that_confirms_nothing_ends_the_collector(
    database: FakeDatabase, replies: list[tuple[int, str]], problem: str
) -> None:
    rig = Rig(database)
    database.replies = replies
    with pytest.raises(ServerError, match=problem):
        rig.write(samples_message(1, 2))
    assert not database.replies


def test_a_rejected_message_affects_only_itself(database: FakeDatabase, caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig(database)
    database.replies = [(400, "all"), (204, ""), (400, "field type conflict")]
    rig.write(*(samples_message(number, number) for number in (1, 2, 3)))
    assert [one.fields["seq"] for one in database.lines] == [1, 3]
    assert rig.store.refused == 1
    assert "cannot store a message of gw: the server replied 400: field type conflict; ignoring it" in caplog.text


def test_messages_are_written_after_access_is_repaired(database: FakeDatabase) -> None:
    rig = Rig(database)
    database.replies = [(401, "")] * 5 + [(404, "no database")] * 5 + [(403, "")] * 5
    rig.write(samples_message(1, 3))
    assert [line.fields["seq"] for line in database.lines] == [1, 2, 3]
    assert rig.store.refused == 0


class SizedPost(HttpPost):
    """Server that refuses requests above a size with 413."""

    def __init__(self, bytes_max: int) -> None:
        self.bytes_max = bytes_max
        self.bodies: list[bytes] = []

    def post(self, body: bytes) -> None:
        if len(body) > self.bytes_max:
            raise RequestTooLarge(413, "")
        self.bodies.append(body)

    def close(self) -> None: ...


def test_refused_sizes_divide_requests() -> None:
    post = SizedPost(1000)
    store = InfluxStore(post)
    store.write([batch(samples_message(1, 500)), batch(samples_message(501, 900))], {})
    lines = b"".join(post.bodies).decode().splitlines(keepends=True)
    assert [parse_line(line).fields["seq"] for line in lines] == list(range(1, 901))
    assert store.refused == 0


def test_long_line_is_ignored_alone() -> None:
    post = SizedPost(1000)
    store = InfluxStore(post)
    long_event = msgspec.structs.replace(
        event_message(5, 5_000_000),
        events=[Event(1, "bow", EventKind.UP, "x" * 2000), Event(2, "bow", EventKind.UP, "y")],
    )
    store.write([batch(samples_message(1, 9)), batch(long_event, Stream.EVENTS)], {})
    assert len(set(b"".join(post.bodies).splitlines())) == 10
    assert store.refused == 1


def test_stop_ends_a_write_without_a_reply() -> None:
    class SilentPost(SizedPost):
        def post(self, body: bytes) -> None:
            store.stop()
            raise OSError("no complete reply")

        def stop(self) -> None: ...

    store = InfluxStore(SilentPost(0))
    with pytest.raises(ServerError, match="the broker keeps the messages"):
        store.write([batch(samples_message(1, 9))], {})


def test_urls_of_stores() -> None:
    def opened(to: str, token_file: str | None) -> LedgerStore:
        return store_of(Namespace(to=to, to_token_file=token_file, to_ca_file=None), Fleet("mqtt://broker"))

    assert isinstance(opened("https://db/api/v2/write?org=o&bucket=b", "/token").to, InfluxStore)
    with pytest.raises(BadArgument, match="expected - for standard output") as refused:
        opened("http://h/write?db=a&u=x&p=secret", None)
    assert "secret" not in str(refused.value)


@pytest.mark.live
@pytest.mark.skipif(bool(NO_INFLUX), reason=NO_INFLUX)
def test_influxdb_has_each_sample_once_after_kills_of_both_sides(
    tmp_path: Path, broker: Mosquitto, gateway: SendingGateway
) -> None:
    with influx_server(tmp_path) as server:
        words = [
            sys.executable,
            "-m",
            "imud",
            "fleet",
            "collect",
            f"mqtt://127.0.0.1:{broker.port}",
            "--to",
            server.url,
        ]

        def start() -> subprocess.Popen[bytes]:
            return subprocess.Popen(words, stderr=subprocess.DEVNULL)

        collecting = start()
        try:
            wait_until(lambda: any("imud-reader-collector 1 imud" in one for one in broker.log), "it has subscribed")
            for turn in range(3):
                gateway.send(*(samples_message(n, n + 9) for n in range(turn * 1000 + 1, turn * 1000 + 1000, 10)))
                wait_until(lambda turn=turn: server.count("imud_sample") > turn * 1000, "the first rows")  # type: ignore[misc]
                collecting.kill()
                collecting.wait()
                if turn == 1:
                    server.kill()
                    server.start()
                collecting = start()
            wait_until(lambda: server.count("imud_sample") >= 3000, "all rows")
        finally:
            collecting.kill()
            collecting.wait()
        rows = server.query("SELECT * FROM imud_sample")
        assert [row["seq"] for row in rows] == list(range(1, 3001))
        assert [row["accel_m_s2_x"] for row in rows] == [seq / 8 for seq in range(1, 3001)]
        assert {(row["site"], row["gateway"], row["device"], row["boot"]) for row in rows} == {
            ("mill", "gw", "bow", "1")
        }
