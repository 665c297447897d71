"""Subscriptions: matching devices, and the rate of each client and device."""

import pytest

from imud.publishers.socket.server import SocketServer
from imud.publishers.socket.subscription import Form, Subscription
from tests.support.socket_rig import Peer, batch, in_server


def test_subscription_matches() -> None:
    everything = Subscription(None, None, 0, Form.JSON)
    one = Subscription(("imu0",), None, 2.0, Form.BINARY)
    assert everything.matches("new")
    assert one.matches("imu0")
    assert not one.matches("imu1")


@pytest.mark.parametrize("encoding", ["json", "binary"])
@in_server()
async def test_rate_is_per_client_and_device(server: SocketServer, encoding: str) -> None:
    slow, fast = await Peer.greeted(server), await Peer.greeted(server)
    await slow.result("watch", rate_hz=100, encoding=encoding)
    await fast.result("watch", rate_hz=250.0, encoding=encoding)
    for first in range(1, 1001, 25):
        server.publish(batch("imu0", first, 25))
        server.publish(batch("imu1", first, 25, period_ns=2_000_000))
    given = {client.number: client.sent + client.queue_samples for client in server.hub.clients()}
    assert given == {1: 100 + 200, 2: 250 + 500}


@in_server()
async def test_clients_with_one_rate_get_the_same_samples(server: SocketServer) -> None:
    first, second = await Peer.greeted(server), await Peer.greeted(server)
    await first.result("watch", rate_hz=100)
    for seq in range(1, 6):
        server.publish(batch("imu0", seq))
    await second.result("watch", rate_hz=100, fields=["gyro_rad_s"])
    for seq in range(6, 32):
        server.publish(batch("imu0", seq))
    for peer, numbers in ((first, [1, 11, 21, 31]), (second, [11, 21, 31])):
        assert [(await peer.message())["params"]["seq"] for _ in numbers] == numbers
    first.close()
    await second.result("watch", rate_hz=500)  # no client uses the previous rate any longer
    for seq in range(32, 37):
        server.publish(batch("imu0", seq))
    assert [(await second.message())["params"]["seq"] for _ in range(3)] == [32, 34, 36]


@in_server()
async def test_a_change_elsewhere_does_not_disturb_the_pace(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    await peer.result("watch", rate_hz=1)
    for seq in range(1, 2002):
        if seq % 100 == 0:
            other = await Peer.greeted(server)
            await other.result("watch")
            other.close()
        server.publish(batch("imu0", seq))
    assert [(await peer.message())["params"]["seq"] for _ in range(3)] == [1, 1001, 2001]
