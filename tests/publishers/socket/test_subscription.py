"""Subscriptions: matching devices, and the rate of each client and device."""

from unittest.mock import Mock

import pytest

from imud.publishers.socket.outbox import Outbox
from imud.publishers.socket.scheduler import TokenBucket
from imud.publishers.socket.server import SocketServer
from imud.publishers.socket.subscription import DeliveryPlan, Form, Subscription
from tests.support.socket_rig import Peer, batch, in_server


def test_subscription_matches() -> None:
    everything = Subscription(None, None, 0, Form.JSON)
    one = Subscription(("imu0",), None, 2.0, Form.BINARY)
    assert everything.matches("new")
    assert one.matches("imu0")
    assert not one.matches("imu1")


def test_many_clients_and_forms_have_a_limited_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """imud reads the clock if a form has 33 clients or more. It encodes at most 16 forms per batch immediately."""
    monkeypatch.setattr(Outbox, "put_samples", Mock())
    plan = DeliveryPlan(Mock(side_effect=[1, 2, 3]), now_ns := Mock(return_value=0), TokenBucket(1, 1, 0, 1))
    for clients in range(1, 34):
        plan.add(Subscription(None, None, 0, Form.JSON), Mock())
        plan.send(batch())
        assert bool(now_ns.called) == (clients > 32)
    outboxes = [Mock() for _ in range(17)]
    for number, outbox in enumerate(outboxes):
        plan.add(Subscription(None, ("seq",) * number, 100 * (number == 16), Form.JSON), outbox)
    plan.add(wanted := Subscription(None, ("seq",) * 16, 0, Form.JSON), whole := Mock())
    plan.discard(wanted, Mock())
    assert len(plan) == 18
    plan.send(batch("imu0", 1, 20))
    deferred = [[call.args[0] for call in outbox.defer.call_args_list] for outbox in (*outboxes, whole)]
    assert [[(one.order, one._chosen) for one in each] for each in deferred] == [
        *[[]] * 15, [(1, None)], [(2, (0, 10))], [(3, None)]
    ]  # fmt: skip
    plan.discard(wanted, whole)
    plan.discard(Subscription(None, ("seq",) * 16, 100, Form.JSON), outboxes[16])
    assert len(plan) == 17


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
