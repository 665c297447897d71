"""Reader with a real broker: repeated and acknowledged messages, and reconnections."""

import asyncio
import errno
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import pytest

import imud.fleet
from imud.fleet.accounts import GatewayState, StreamKey, StreamPosition
from imud.fleet.broker import BrokerError, ReaderAccess
from imud.fleet.messages import topic_of
from imud.fleet.reader import VERSIONS, Fleet, FleetBatch, FleetSession, ReaderConnection
from imud.fleet.settings import broker_of
from imud.model.errors import BadArgument
from tests.fleet.authority import Authority
from tests.fleet.fleet_gateway import SendingGateway, dropped_message, samples_message
from tests.fleet.mosquitto import NO_MOSQUITTO, Mosquitto, running_broker
from tests.fleet.proxy import Proxy
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.event_loops import in_loop
from tests.support.files import ROOT
from tests.support.surroundings import free_port

RECEIVE_MAX, WAITING_BYTES = 2000, 1 << 24

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


ACCESS = ReaderAccess()


async def opened(
    port: int, session_s: int = 0, *, scheme: str = "mqtt", access: ReaderAccess = ACCESS, is_v5: bool = True
) -> ReaderConnection:
    broker = broker_of(f"{scheme}://127.0.0.1:{port}")
    assert broker is not None
    return await ReaderConnection.open(broker, access, "reader", ["imud/#"], session_s, is_v5=is_v5)


async def lost(connection: ReaderConnection) -> None:
    """Receive messages until the connection is lost. Raises BrokerError."""
    while await connection.next(LIMIT_S) is not None:
        pass


BOTH = pytest.mark.parametrize("is_v5", [True, False], ids=["5", "3.1.1"])


@BOTH
@in_loop
async def test_a_message_is_sent_until_acknowledged(broker: Mosquitto, gateway: SendingGateway, is_v5: bool) -> None:
    gateway.publish([("imud/kept", b"x" * 200_000)], retain=True)
    connection = await opened(broker.port, is_v5=is_v5)
    found = await connection.next(LIMIT_S)
    assert found is not None
    assert (found.topic, len(found.payload), found.retain) == ("imud/kept", 200_000, True)
    assert await connection.next(0.01) is None
    connection.close()
    connection.close()
    with pytest.raises(BrokerError, match="closed"):
        await connection.next()
    await asyncio.to_thread(gateway.publish, [("imud/kept", b"")], retain=True)
    (await opened(broker.port, 60, is_v5=is_v5)).close()
    await asyncio.to_thread(gateway.publish, [(f"imud/{n}", b"") for n in range(4)])
    first = await opened(broker.port, 60, is_v5=is_v5)
    for _ in range(2):
        found = await first.next(LIMIT_S)
        assert found is not None
        first.acknowledge(found.number)
    first.close()
    second = await opened(broker.port, 60, is_v5=is_v5)
    topics = []
    for _ in range(2):
        found = await second.next(LIMIT_S)
        assert found is not None
        topics.append(found.topic)
    second.close()
    assert topics == ["imud/2", "imud/3"]


async def waiting_and_taken(connection: ReaderConnection, count: int) -> tuple[int, list[int]]:
    """Wait until no more messages arrive. Return their number, then receive all."""
    for _ in range(100):
        await asyncio.sleep(0.001)
    most, found = connection.waiting, []
    for _ in range(count):
        delivery = await connection.next(LIMIT_S)
        assert delivery is not None
        connection.acknowledge(delivery.number)
        found.append(int(delivery.topic.removeprefix("imud/")))
    connection.close()
    return most, found


@pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO)
@pytest.mark.parametrize("scheme", ["mqtt", "mqtts"])
def test_a_broker_without_a_limit_waits_for_the_reader(tmp_path: Path, authority: Authority, scheme: str) -> None:
    """A reader with MQTT 3.1.1 cannot set a limit, and this broker has no limit."""
    port, plain, count = free_port(), free_port(), 2 * RECEIVE_MAX
    listener = authority.listener(port) if scheme == "mqtts" else [f"listener {port} 127.0.0.1", "allow_anonymous true"]
    lines = [*listener, "max_inflight_messages 0", f"listener {plain} 127.0.0.1", "allow_anonymous true"]
    access = ReaderAccess(
        ca_file=authority["ca.pem"], cert_file=authority["gateway.pem"], key_file=authority["gateway.key"]
    )

    async def play() -> tuple[int, list[int]]:
        connection = await opened(port, scheme=scheme, access=access, is_v5=False)
        with closing(SendingGateway(plain)) as gateway:
            sent = [(f"imud/{number}", bytes(100)) for number in range(count)]
            sending = asyncio.ensure_future(asyncio.to_thread(gateway.publish, sent))
            async with asyncio.timeout(LIMIT_S):
                await sending
                while connection.waiting <= RECEIVE_MAX // 2:
                    await asyncio.sleep(0.002)
        return await waiting_and_taken(connection, count)

    with running_broker(tmp_path / "broker", "per_listener_settings true", *lines):
        most, found = asyncio.run(play())
    assert RECEIVE_MAX // 2 < most <= RECEIVE_MAX + 2, "a read takes two messages at most beyond the bound"
    assert found == list(range(count))


@in_loop
async def test_large_messages_wait_at_the_broker(broker: Mosquitto, gateway: SendingGateway) -> None:
    size, count = 200_000, 150
    connection = await opened(broker.port)
    sending = asyncio.to_thread(gateway.publish, [(f"imud/{number}", bytes(size)) for number in range(count)])
    async with asyncio.timeout(LIMIT_S):
        await sending
        while connection.waiting <= WAITING_BYTES // 2 // size:
            await asyncio.sleep(0.002)
    most, found = await waiting_and_taken(connection, count)
    assert most * size <= WAITING_BYTES + 2 * size, "a read takes two messages at most beyond the bound"
    assert found == list(range(count))


@BOTH
@in_loop
async def test_a_reset_during_an_acknowledgement_is_a_loss_and_removes_the_descriptor(
    broker: Mosquitto, gateway: SendingGateway, proxy: Proxy, is_v5: bool
) -> None:
    """paho-mqtt closes the socket inside `ack`. The next opened file then gets its descriptor."""
    connection = await opened(proxy.port, 60, is_v5=is_v5)
    await asyncio.to_thread(gateway.publish, [(f"imud/{n}", b"") for n in range(4)])
    first, second = await connection.next(LIMIT_S), await connection.next(LIMIT_S)
    assert first is not None
    assert second is not None
    proxy.reset()  # the event loop has no turn in which it could detect the reset
    connection.acknowledge(first.number)
    others = [socket.socketpair() for _ in range(8)]  # one of them gets the descriptor of the connection
    try:
        connection.acknowledge(second.number)
        for pair in others:
            for one in pair:
                assert not asyncio.get_running_loop().remove_reader(one)
                assert not asyncio.get_running_loop().remove_writer(one)
        with pytest.raises(BrokerError, match=f"mqtt://127.0.0.1:{proxy.port}: the connection was lost"):
            await lost(connection)
    finally:
        connection.close()
        for pair in others:
            for one in pair:
                one.close()


@in_loop
async def test_errors_of_the_loop_do_not_prevent_the_end(broker: Mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    """epoll raises for a closed descriptor if the loop waited for reading and writing."""
    connection = await opened(broker.port)
    waiting = asyncio.ensure_future(connection.next())
    await asyncio.sleep(0)
    loop, refuse = asyncio.get_running_loop(), Mock(side_effect=OSError(errno.EBADF, "Bad file descriptor"))
    monkeypatch.setattr(loop, "remove_writer", refuse)
    connection.close()
    with pytest.raises(BrokerError, match="the connection is closed"):
        async with asyncio.timeout(LIMIT_S):
            await waiting


@in_loop
async def test_data_that_the_socket_did_not_accept_is_sent_later(
    broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    connection, waiting, ack = await opened(broker.port), [b"ab", b"cd"], Mock()
    client = connection._client
    monkeypatch.setattr(client, "want_write", lambda: waiting)
    monkeypatch.setattr(client, "loop_write", lambda: waiting and waiting.pop())
    monkeypatch.setattr(client, "ack", ack)
    connection.acknowledge(7)
    await until(lambda: not waiting)
    await asyncio.sleep(0)
    ack.assert_called_once_with(7, 1)
    assert not asyncio.get_running_loop().remove_writer(client.socket()), "imud does not wait without data"
    connection.close()
