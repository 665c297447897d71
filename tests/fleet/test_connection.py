"""One connection of a reader with a real broker: deliveries, acknowledgements, its end."""

import asyncio

import pytest

from imud.fleet import ReaderAccess
from imud.fleet.connection import ReaderConnection
from imud.publishers.mqtt.access import BrokerError
from imud.publishers.mqtt.settings import broker_of
from tests.fleet.fleet_gateway import LIMIT_S, SendingGateway
from tests.publishers.mqtt.mosquitto import Mosquitto, free_port

ACCESS = ReaderAccess()


async def opened(port: int, session_s: int = 0) -> ReaderConnection:
    broker = broker_of(f"mqtt://127.0.0.1:{port}")
    assert broker is not None
    return await ReaderConnection.open(broker, ACCESS, "reader", ["imud/#"], session_s)


def test_a_retained_message_says_so_and_none_comes_in_no_time(broker: Mosquitto, gateway: SendingGateway) -> None:
    gateway.publish([("imud/kept", b"x" * 200_000)], retain=True)

    async def play() -> None:
        connection = await opened(broker.port)
        found = await connection.next(LIMIT_S)
        assert found is not None
        assert (found.topic, len(found.payload), found.retain) == ("imud/kept", 200_000, True)
        assert await connection.next(0.01) is None
        connection.close()
        connection.close()
        with pytest.raises(BrokerError, match="closed"):
            await connection.next()

    asyncio.run(play())


def test_only_what_was_acknowledged_is_done_with(broker: Mosquitto, gateway: SendingGateway) -> None:
    async def play() -> list[str]:
        (await opened(broker.port, 60)).close()
        await asyncio.to_thread(gateway.publish, [(f"imud/{n}", b"") for n in range(4)])
        first = await opened(broker.port, 60)
        for _ in range(2):
            found = await first.next(LIMIT_S)
            assert found is not None
            first.acknowledge(found.number)
        first.close()
        second = await opened(broker.port, 60)
        topics = []
        for _ in range(2):
            found = await second.next(LIMIT_S)
            assert found is not None
            topics.append(found.topic)
        second.close()
        return topics

    assert asyncio.run(play()) == ["imud/2", "imud/3"]


def test_a_port_without_a_broker_is_named() -> None:
    port = free_port()
    with pytest.raises(BrokerError, match=f"mqtt://127.0.0.1:{port}: .*refused"):
        asyncio.run(opened(port))


def test_a_broker_that_ends_is_noticed(broker: Mosquitto) -> None:
    async def play() -> None:
        connection = await opened(broker.port)
        await asyncio.to_thread(broker.stop)
        with pytest.raises(BrokerError, match=f"mqtt://127.0.0.1:{broker.port}: "):
            await connection.next(LIMIT_S)
        connection.close()

    asyncio.run(play())
