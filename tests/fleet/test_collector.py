"""Collector with a real broker: it acknowledges stored messages and continues with the stored ledger.
Lines of the collector: each record once, with its source."""

import asyncio
import gc
import io
import json
import math
import threading
from collections.abc import Sequence

import msgspec
import pytest

from imud.fleet import accounts as fleet_accounts
from imud.fleet.collector import FleetCollector, JsonLines, LedgerStore, Offsets, lines_of
from imud.fleet.messages import FleetMessage, GatewayClock, Stream, decode_message, encode_message
from imud.fleet.reader import Fleet, FleetBatch
from imud.host.threads import rare_garbage_collection
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from tests.fleet import fleet_gateway
from tests.fleet.fleet_gateway import UTC_NS, SendingGateway, intervals_message, samples_message, synchronised
from tests.fleet.mosquitto import Mosquitto
from tests.fleet.proxy import Proxy
from tests.support.daemon_process import LIMIT_S

BATCHES_MAX, GC_ALLOCATIONS, TURN_BYTES, RECEIVE_MAX = 1000, 100_000, 1 << 23, 2000

pytestmark = pytest.mark.live


class MemoryStore:
    """Store in memory. It fails if the test requests it."""

    def __init__(self) -> None:
        self.rows: list[int] = []
        self.offsets: dict[fleet_accounts.BootKey, fleet_accounts.BootOffset] = {}
        self.fails = False
        self.collector: FleetCollector | None = None
        self.most = 1 << 30

    def write(self, batches: Sequence[FleetBatch], offsets: Offsets) -> None:
        if self.fails:
            raise ServerError("the store is full")
        self.rows += [sample.seq for batch in batches for sample in batch.message.samples]
        self.offsets |= offsets
        if len(self.rows) >= self.most and self.collector is not None:
            self.collector.stop()

    def close(self) -> None:
        pass


def collect(broker: Mosquitto | Proxy, store: MemoryStore, most: int) -> Fleet:
    fleet = Fleet(f"mqtt://127.0.0.1:{broker.port}", name="archive", retry_max_s=1.0)
    store.most = most
    store.collector = FleetCollector(fleet, LedgerStore(fleet, store))

    async def run() -> None:
        assert store.collector is not None
        async with asyncio.timeout(LIMIT_S):
            await store.collector.run()

    asyncio.run(run())
    return fleet


def begin_session(broker: Mosquitto) -> None:
    fleet = Fleet(f"mqtt://127.0.0.1:{broker.port}", name="archive", retry_max_s=1.0)

    async def run() -> None:
        running = asyncio.ensure_future(FleetCollector(fleet, LedgerStore(fleet, MemoryStore())).run())
        async with asyncio.timeout(LIMIT_S):
            while not any("Sending SUBACK to imud-reader-archive" in line for line in broker.log):
                await asyncio.sleep(0.005)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(run())
    assert not fleet.problem


def test_refused_messages_are_delivered_to_the_next_collector(broker: Mosquitto, gateway: SendingGateway) -> None:
    begin_session(broker)
    gateway.send(samples_message(1, 5), samples_message(6, 9))
    store = MemoryStore()
    store.fails = True
    with pytest.raises(ServerError, match="the store is full"):
        collect(broker, store, 9)
    store.fails = False
    collect(broker, store, 9)
    assert store.rows == list(range(1, 10))


class ResettingStore(MemoryStore):
    """Store whose collector loses its connection during a write, so that acknowledgements fail."""

    def __init__(self, proxy: Proxy, resets: int) -> None:
        super().__init__()
        self.proxy, self.resets = proxy, resets

    def write(self, batches: Sequence[FleetBatch], offsets: Offsets) -> None:
        super().write(batches, offsets)
        if self.resets:
            self.resets -= 1
            self.proxy.reset()


def test_a_reset_loses_only_the_connection(broker: Mosquitto, gateway: SendingGateway, proxy: Proxy) -> None:
    begin_session(broker)
    number = BATCHES_MAX + 100
    gateway.send(*(samples_message(n, n) for n in range(1, number + 1)))
    store = ResettingStore(proxy, 3)
    fleet = collect(proxy, store, number)
    assert store.rows == list(range(1, number + 1))
    (account,) = fleet.accounts.values()
    assert (account.received, account.balance) == (number, 0)
    assert fleet.connections >= 2
    assert account.counts.duplicates > 0


class SlowStore(MemoryStore):
    def __init__(self, *, is_slow: bool) -> None:
        super().__init__()
        self.goes_on = threading.Event()
        self.sizes: list[int] = []
        if not is_slow:
            self.goes_on.set()

    def write(self, batches: Sequence[FleetBatch], offsets: Offsets) -> None:
        self.sizes.append(len(batches))
        assert self.goes_on.wait(LIMIT_S)
        super().write(batches, offsets)


def test_a_slow_store_receives_larger_transactions(broker: Mosquitto, gateway: SendingGateway) -> None:
    begin_session(broker)
    number, store = RECEIVE_MAX + BATCHES_MAX, SlowStore(is_slow=True)

    def send() -> None:
        gateway.send(samples_message(1, 1))
        while not store.sizes:  # the first transaction contains only the first message
            store.goes_on.wait(0.005)
        gateway.send(*(samples_message(n, n) for n in range(2, number + 1)))
        store.goes_on.set()

    sending = threading.Thread(target=send)
    sending.start()
    gateway.send_state(
        fleet_accounts.GatewayState(
            v=1, online=True, boot="1", positions=[fleet_accounts.StreamPosition("1", "bow", "samples", 1, number)]
        )
    )
    fleet = collect(broker, store, number)
    sending.join()
    assert store.rows == list(range(1, number + 1))
    assert max(store.sizes) == BATCHES_MAX, "messages received during a transaction fill the next one"
    (account,) = fleet.accounts.values()
    assert (account.sent, account.received, account.in_spool, account.balance) == (number, number, 0, 0)
    assert (account.counts.missing, account.counts.duplicates) == (0, 0)


def test_the_size_of_waiting_messages_is_limited(broker: Mosquitto, gateway: SendingGateway) -> None:
    begin_session(broker)
    text = [Event(0, "bow", EventKind.UP, "1" * 100_000)]
    large = [msgspec.structs.replace(samples_message(n, n), events=text) for n in range(1, 151)]
    gateway.send(*large)
    store = SlowStore(is_slow=False)
    collect(broker, store, 150)
    assert store.rows == list(range(1, 151))
    assert max(store.sizes) <= TURN_BYTES // 100_000 + 1


def test_a_state_with_a_clock_gives_the_store_its_offset(broker: Mosquitto, gateway: SendingGateway) -> None:
    clock = GatewayClock(9, UTC_NS, synchronised=True, error_ns=700)
    gateway.send_state(fleet_accounts.GatewayState(v=1, online=True, boot="1", clock=clock))
    store = MemoryStore()
    collect(broker, store, 0)
    assert store.offsets == {fleet_accounts.BootKey("gw", "1"): fleet_accounts.BootOffset(9, UTC_NS, 700)}


def test_the_garbage_collector_does_not_track_stored_objects() -> None:
    """The collector holds hundreds of thousands of objects. The garbage collector must not visit them."""
    message = decode_message(encode_message(synchronised(intervals_message(1, 5))))
    (interval,) = message.intervals
    for one in (message, message.clock, interval, interval.values["accel_m_s2"]):
        assert not gc.is_tracked(one)
    before = gc.get_threshold()
    with rare_garbage_collection(GC_ALLOCATIONS):
        assert gc.get_threshold()[0] == GC_ALLOCATIONS > before[0]
    assert gc.get_threshold() == before
    assert not gc.get_freeze_count()


HEAD = {"site": "mill", "gateway": "gw", "boot": "1", "device": "bow", "stream": "samples"}


def test_the_line_of_a_sample_contains_its_values() -> None:
    (line,) = lines_of(FleetBatch("mill", Stream.SAMPLES, samples_message(3, 3)))
    assert json.loads(line) == HEAD | {
        "kind": "sample", "seq": 3, "t_ns": 3_000_000, "t_err_ns": 500, "sync": "edge", "t_rx_ns": 3_000_010,
        "utc_ns": 1_790_000_000_003_000_000, "accel_m_s2": [0.375, 0.0, 9.75], "temperature_c": 21.5,
    }  # fmt: skip
    message = samples_message(1, 1)
    sample = msgspec.structs.replace(message.samples[0], accel_m_s2=(math.nan, 0.0, math.inf))
    (line,) = lines_of(FleetBatch("mill", Stream.SAMPLES, msgspec.structs.replace(message, samples=[sample])))
    assert json.loads(line)["accel_m_s2"] == [None, 0.0, None]


def test_lines_of_dropped_records_intervals_and_events_have_kinds() -> None:
    out = io.TextIOWrapper(io.BytesIO())
    batches = [
        FleetBatch("mill", Stream.SAMPLES, fleet_gateway.dropped_message(1, 4)),
        FleetBatch("mill", Stream.SAMPLES, intervals_message(1, 2)),
        FleetBatch("mill", Stream.EVENTS, fleet_gateway.event_message(1, 5)),
    ]
    JsonLines(out).write(batches, {})
    dropped, found, up = map(json.loads, out.buffer.getvalue().splitlines())
    assert dropped == HEAD | {
        "kind": "dropped", "first": 1, "last": 4, "cause": "space", "utc_ns": UTC_NS + 4_000_000,
    }  # fmt: skip
    assert (found["kind"], found["values"]["accel_m_s2"]["mean"]) == ("interval", [1.0, 2.0, 3.0])
    assert (up["stream"], up["kind"], up["event"], up["message"]) == ("events", "event", "up", "it is up")


def test_lines_report_an_unset_clock_and_a_later_line_contains_its_offset() -> None:
    messages = [
        samples_message(1, 1, utc_ns=0), intervals_message(2, 3, utc_ns=0),
        fleet_gateway.event_message(4, 4_000_000, utc_ns=0), fleet_gateway.dropped_message(5, 6),
    ]  # fmt: skip
    out, clocks = io.StringIO(), fleet_accounts.BootClocks()

    def write(message: FleetMessage) -> None:
        offset = clocks.take(message)
        JsonLines(out).write([FleetBatch("mill", Stream.SAMPLES, message, offset)], clocks.take_fresh())

    for one in messages:
        write(fleet_gateway.not_set(one))
    write(synchronised(samples_message(7, 7), t_ns=7_000_000, error_ns=900))
    write(fleet_gateway.not_set(samples_message(8, 8, utc_ns=0)))
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [line.get("utc") for line in lines] == ["not set"] * 4 + [None] * 3
    assert [line["kind"] for line in lines] == ["sample", "interval", "event", "dropped", "sample", "clock", "sample"]
    assert lines[5] == {
        "kind": "clock", "gateway": "gw", "boot": "1", "t_ns": 7_000_000, "utc_offset_ns": UTC_NS, "utc_err_ns": 900,
    }  # fmt: skip
    assert lines[0]["t_ns"] + lines[5]["utc_offset_ns"] == UTC_NS + 1_000_000
    assert (lines[4]["utc_ns"], lines[4]["utc_err_ns"]) == (UTC_NS + 7_000_000, 900)
    assert (lines[6]["utc_ns"], lines[6]["utc_err_ns"]) == (UTC_NS + 8_000_000, 900 + 1_000_000 // 2000)
