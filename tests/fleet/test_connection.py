"""Connection of a reader to a real broker: acknowledgements, limits, and lost connections."""

import asyncio
import errno
import socket
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import pytest

from imud.fleet.broker import BrokerError
from imud.fleet.connection import ReaderConnection
from imud.fleet.paho_client import ReaderAccess
from imud.fleet.settings import broker_of
from tests.fleet.authority import Authority
from tests.fleet.fleet_gateway import SendingGateway
from tests.fleet.mosquitto import NO_MOSQUITTO, Mosquitto, running_broker
from tests.fleet.proxy import Proxy
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import in_loop
from tests.support.surroundings import free_port

RECEIVE_MAX, WAITING_BYTES = 2000, 1 << 24

pytestmark = pytest.mark.live


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not true():
            await asyncio.sleep(0.02)


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
