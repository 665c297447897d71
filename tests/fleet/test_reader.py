"""Reader with a real broker: repeated and acknowledged messages, and reconnections."""

import asyncio
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

import imud.fleet
from imud.fleet.accounts import GatewayState, StreamKey, StreamPosition
from imud.fleet.messages import decode_message, topic_of
from imud.fleet.reader import VERSIONS, Fleet, FleetBatch, FleetSession, Share
from imud.model.errors import BadArgument
from imud.model.units import NS_PER_S
from tests.fleet.fleet_gateway import SendingGateway, dropped_message, samples_message
from tests.fleet.mosquitto import NO_MOSQUITTO, Mosquitto, running_broker
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.files import ROOT
from tests.support.surroundings import free_port

RECEIVE_MAX = 2000

pytestmark = pytest.mark.live

KEY = StreamKey("gw", "1", "bow", "samples")


def fleet_at(broker: Mosquitto, name: str = "") -> Fleet:
    return Fleet(f"mqtt://127.0.0.1:{broker.port}", name=name, retry_max_s=1.0)


async def taken(fleet: Fleet, number: int, done: Callable[[], bool] = lambda: True, **wanted: str) -> list[FleetBatch]:
    """Return `number` batches. The last one is not acknowledged. Close the connection when `done` returns True."""
    found = []
    async with asyncio.timeout(LIMIT_S):
        batches = fleet.watch(**wanted)
        async for batch in batches:
            found.append(batch)
            if len(found) == number:
                break
        await until(done)
        await batches.aclose()
    return found


async def session_begun(fleet: Fleet) -> None:
    batches = fleet.watch()
    waiting = asyncio.ensure_future(anext(batches))
    await until(lambda: not waiting.done() and bool(fleet.states))
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not true():
            await asyncio.sleep(0.02)


STATE = GatewayState(v=1, online=True, boot="1", positions=[StreamPosition("1", "bow", "samples", 1, 50)])


@in_loop
async def test_batches_contain_samples_and_the_ledger_balances(broker: Mosquitto, gateway: SendingGateway) -> None:
    gateway.send_state(STATE)
    fleet = fleet_at(broker, "archive")
    await session_begun(fleet)
    gateway.send(samples_message(1, 10), samples_message(1, 10), dropped_message(11, 15), samples_message(19, 20))
    batches = await taken(fleet, 3)
    assert [one.site for one in batches] == ["mill"] * 3
    assert (batches[0].message, fleet.states["mill", "gw"]) == (samples_message(1, 10), STATE)
    account = fleet.accounts[KEY]
    assert (account.sent, account.received, account.in_spool, account.balance) == (50, 12, 30, 0)
    assert (account.counts.dropped, account.counts.missing, account.counts.duplicates) == ({"space": 5}, 3, 10)


@in_loop
async def test_only_unacknowledged_messages_are_delivered_again(broker: Mosquitto, gateway: SendingGateway) -> None:
    gateway.send_state(STATE)

    def acknowledged() -> int:
        return sum("Received PUBACK from imud-reader-archive" in line for line in broker.log)

    await session_begun(fleet_at(broker, "archive"))
    # one acknowledgement before the acknowledgements of the samples
    gateway.publish([(topic_of("mill", "gw", "", "state"), b"")], retain=True)
    gateway.send(*(samples_message(10 * n + 1, 10 * n + 10) for n in range(5)))
    # closing a socket with unread data resets the connection, and the broker may never read the last messages
    before = acknowledged()
    assert len(await taken(fleet_at(broker, "archive"), 3, lambda: acknowledged() >= before + 3)) == 3
    assert [one.message.first for one in (await taken(fleet_at(broker, "archive"), 3))] == [21, 31, 41]


@in_loop
async def test_the_broker_sends_no_more_than_the_reader_can_hold(broker: Mosquitto, gateway: SendingGateway) -> None:
    gateway.send_state(STATE)
    fleet = fleet_at(broker, "slow")
    await session_begun(fleet)
    await asyncio.to_thread(gateway.send, *(samples_message(n, n) for n in range(1, 2 * RECEIVE_MAX + 1)))
    before, batches = sum("Sending PUBLISH to imud-reader-slow" in line for line in broker.log), fleet.watch()
    await anext(batches)
    gateway.send_state(STATE)  # the broker has processed all earlier messages
    sent, count = sum("Sending PUBLISH to imud-reader-slow" in line for line in broker.log) - before, 1
    async for _ in batches:
        count += 1
        if count == 2 * RECEIVE_MAX:
            break
    await batches.aclose()
    assert sent <= RECEIVE_MAX + 1
    assert (count, fleet.accounts[KEY].counts.missing) == (2 * RECEIVE_MAX, 0)


@in_loop
async def test_a_broker_that_restarts_loses_nothing(broker: Mosquitto, gateway: SendingGateway) -> None:
    gateway.send_state(STATE)
    fleet = fleet_at(broker, "archive")
    await session_begun(fleet)
    batches, found = fleet.watch(), []
    gateway.send(samples_message(1, 10))
    found.append((await anext(batches)).message.first)
    waiting = asyncio.ensure_future(anext(batches))
    await asyncio.to_thread(broker.stop)
    await asyncio.to_thread(broker.start)
    other = SendingGateway(broker.port)
    await asyncio.to_thread(other.send, samples_message(11, 20))
    async with asyncio.timeout(LIMIT_S):
        found.append((await waiting).message.first)
    other.close()
    await batches.aclose()
    assert found == [1, 11]


@in_loop
async def test_only_selected_topics_of_a_session_are_delivered(broker: Mosquitto, gateway: SendingGateway) -> None:
    gateway.send_state(STATE)
    await session_begun(fleet_at(broker, "archive"))
    gateway.send(samples_message(1, 1, gateway="other"), samples_message(1, 1, device="stern"))
    gateway.send(samples_message(1, 2))
    (only,) = await taken(fleet_at(broker, "archive"), 1, gateway="gw", device="bow")
    assert only.message.last == 2


@in_loop
async def test_messages_of_unknown_senders_are_acknowledged(broker: Mosquitto, gateway: SendingGateway) -> None:
    gateway.send_state(STATE)
    fleet = fleet_at(broker, "archive")
    await session_begun(fleet)
    wrong = topic_of("mill", "other", "bow", "samples")
    gateway.publish([(wrong, b"{}"), (wrong, b"IMUB\xff"), (topic_of("mill", "gw", "", "state"), b"[]")])
    gateway.publish([(wrong, b'{"v":1,"gateway":"gw","boot":"1","device":"bow","kind":"samples",'
                             b'"begin":1,"first":1,"last":1,"count":1,"utc_ns":0}')])  # fmt: skip
    gateway.send(samples_message(1, 1))
    await taken(fleet, 1)
    assert fleet.ignored == 4


@in_loop
async def test_the_next_broker_of_the_cluster_is_tried(broker: Mosquitto, gateway: SendingGateway) -> None:
    fleet = Fleet(
        f"mqtt://127.0.0.1:{free_port()}", f"mqtt://127.0.0.1:{broker.port}", version="3.1.1", retry_max_s=0.1
    )
    reading = asyncio.ensure_future(taken(fleet, 1))
    await until(lambda: any("Received SUBSCRIBE" in line for line in broker.log))
    await asyncio.to_thread(gateway.send, samples_message(1, 10))
    assert (await reading)[0].message == samples_message(1, 10)
    assert fleet.problem == ""


def session_of(broker: Mosquitto, share: Share, **selected: str | None) -> FleetSession:
    return FleetSession(
        fleet_at(broker, "archive"), **{"site": None, "gateway": None, "device": None} | selected, share=share
    )


async def received(session: FleetSession, count: int) -> list[tuple[str, int]]:
    """Acknowledge `count` messages. Return the topic and, for a message of a stream, its first number."""
    found: list[tuple[str, int]] = []
    async with asyncio.timeout(LIMIT_S):
        while len(found) < count:
            delivery = await session.next(LIMIT_S)
            if delivery is not None:
                is_state = delivery.topic.endswith("state")
                found.append((delivery.topic, 0 if is_state else decode_message(delivery.payload).first))
                session.acknowledge(delivery)
    return found


async def connected(*sessions: FleetSession) -> None:
    for session in sessions:
        await session.next(0.001)


@in_loop
async def test_shares_divide_the_messages(broker: Mosquitto, gateway: SendingGateway) -> None:
    """An absent share keeps its messages. Only share 0 receives states. All topics are topics of gateways."""
    gateway.send_state(STATE)
    sessions = [session_of(broker, Share(number, 3)) for number in range(3)]
    assert await received(sessions[0], 1) == [("imud/mill/gw/state", 0)]
    await connected(*sessions)
    sessions[2].close()
    gateway.send(*(samples_message(n, n) for n in range(1, 10)))
    parts = [await received(session, 3) for session in sessions]
    assert sorted(number for part in parts for _, number in part) == list(range(1, 10))
    assert {topic for part in parts for topic, _ in part} == {"imud/mill/gw/bow/samples"}
    for session in sessions:
        assert await session.next(0.001) is None
        session.close()


@in_loop
async def test_another_number_of_shares_neither_loses_nor_repeats_messages(
    broker: Mosquitto, gateway: SendingGateway
) -> None:
    async def numbers(count: int, *sessions: FleetSession) -> list[int]:
        gateway.send(*(samples_message(n, n) for n in range(1, count + 1)))
        found = [number for session in sessions for _, number in await received(session, count // len(sessions))]
        for session in sessions:
            assert await session.next(0.05) is None
            session.close()
        return sorted(found)

    for total in (1, 2, 1):
        sessions = [session_of(broker, Share(number, total)) for number in range(total)]
        await connected(*sessions)
        if total == 1:  # a surplus share ends its subscription
            surplus = session_of(broker, Share(1, 1))
            await connected(surplus)
            surplus.close()
        assert await numbers(4, *sessions) == [1, 2, 3, 4]


@in_loop
async def test_a_surplus_share_receives_only_waiting_messages(broker: Mosquitto, gateway: SendingGateway) -> None:
    clock, shares = VirtualClock(), [session_of(broker, Share(number, 2)) for number in range(2)]
    await connected(*shares)
    for session in shares:
        session.close()
    gateway.send(*(samples_message(n, n) for n in range(1, 7)))
    fleet = fleet_at(broker, "archive")
    fleet.now_ns = clock.now_ns
    surplus = FleetSession(fleet, site=None, gateway=None, device=None, share=Share(1, 1))
    assert len(await received(surplus, 2)) == 2
    last = await surplus.next(LIMIT_S)
    assert last is not None
    clock.advance(10 * NS_PER_S)
    assert not surplus.is_drained, "the last message has no acknowledgement"
    surplus.acknowledge(last)
    assert not surplus.is_drained
    clock.advance(10 * NS_PER_S)
    assert surplus.is_drained
    gateway.send(samples_message(7, 7), samples_message(8, 8))
    assert await surplus.next(0.05) is None
    surplus.close()
    assert len(await received(shares[0], 5)) == 5
    shares[0].close()


@in_loop
async def test_a_new_session_of_a_surplus_share_does_not_stay(broker: Mosquitto) -> None:
    for _ in range(2):
        surplus = session_of(broker, Share(1, 1))
        await connected(surplus)
        assert surplus.is_drained
        surplus.close()
        assert not surplus.is_drained


def test_shares_need_mqtt_5_and_a_name() -> None:
    old, unnamed = Fleet("mqtt://host", name="a", version="3.1.1"), Fleet("mqtt://host")
    with pytest.raises(BadArgument, match=r"expected MQTT 5 for several shares, got MQTT 3\.1\.1.*--site"):
        FleetSession(old, site=None, gateway=None, device=None, share=Share(0, 2))
    with pytest.raises(BadArgument, match="expected a name for several shares, got none"):
        FleetSession(unnamed, site=None, gateway=None, device=None, share=Share(0, 2))


@in_loop
async def test_a_timeout_before_the_next_attempt_returns_none() -> None:
    url = f"mqtt://127.0.0.1:{free_port()}"
    fleet = Fleet(url, retry_max_s=60.0)
    async with FleetSession(fleet, site=None, gateway=None, device=None) as session:
        for _ in range(3):
            assert await session.next(0.001) is None
            assert re.match(f"{url}: .*refused", fleet.problem)


@pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO)
@pytest.mark.parametrize("version", VERSIONS)
def test_over_websockets(tmp_path: Path, version: str) -> None:
    port, plain = free_port(), free_port()
    # one configuration for all listeners: otherwise mosquitto 2.0.21 stores nothing for a disconnected WebSocket client
    lines = (f"listener {port} 127.0.0.1", "protocol websockets", f"listener {plain} 127.0.0.1", "allow_anonymous true")

    async def play() -> list[FleetBatch]:
        fleet = Fleet(f"ws://127.0.0.1:{port}", name="archive", version=version)
        await session_begun(fleet)
        with closing(SendingGateway(plain)) as other:
            await asyncio.to_thread(other.send, *(samples_message(n, n) for n in range(1, 101)))
        return await taken(fleet, 100)

    with running_broker(tmp_path / "broker", *lines) as broker:
        if any("Websockets support not available" in line for line in broker.log):
            pytest.skip("this mosquitto has no websockets")
        with closing(SendingGateway(plain)) as gateway:
            gateway.send_state(STATE)
        found = asyncio.run(play())
    assert [one.message for one in found] == [samples_message(n, n) for n in range(1, 101)]


def test_the_example_of_the_document(broker: Mosquitto, gateway: SendingGateway) -> None:
    document = (ROOT / "docs" / "fleet.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", document, re.DOTALL)
    code = code.replace("127.0.0.1:1883", f"127.0.0.1:{broker.port}")
    with subprocess.Popen([sys.executable, "-u", "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        wait_until(lambda: any("Received SUBSCRIBE" in line for line in broker.log), "the example has subscribed")
        gateway.send(samples_message(7, 9, gateway="other"), samples_message(1, 3, gateway="gw-17"))
        line = process.stdout.readline()
        process.kill()
    assert line == "samples 1 3 3\n"


def test_names_are_checked() -> None:
    assert (imud.fleet.Fleet, imud.fleet.FleetBatch) == (Fleet, FleetBatch)
    with pytest.raises(AttributeError, match=r"module 'imud\.fleet' has no attribute 'Fleets'"):
        imud.fleet.Fleets  # noqa: B018
    for url in ("http://host", "mqtt://user:secret@host", "mqtt://", "host:1883", "mqtt://host:0"):
        with pytest.raises(BadArgument, match="expected a URL"):
            Fleet("mqtt://host", url)
    with pytest.raises(BadArgument, match="at least one broker"):
        Fleet()
    with pytest.raises(BadArgument, match=r"expected MQTT 5 or 3\.1\.1, got '3'"):
        Fleet("mqtt://host", version="3")
    with pytest.raises(BadArgument, match="a name"):
        Fleet("mqtt://host", name="a/b")
    with pytest.raises(BadArgument, match="gateway: expected"):
        asyncio.run(taken(Fleet("mqtt://host"), 1, gateway="#"))
