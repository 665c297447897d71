"""Decimation: the first sample at or after each due instant, without drift."""

import random
from math import ceil
from pathlib import Path

import pytest

from imud.publishers.socket.subscription import Form, Pace, Subscription
from tests.support.socket_rig import Peer, batch, run, serving

START_NS = 80_000_000_000_001


def taken(pace: Pace, times_ns: list[int]) -> list[int]:
    return [t_ns for t_ns in times_ns if pace.is_due(t_ns)]


@pytest.mark.parametrize("rate_hz", [1.0, 3.0, 7.3, 99.9, 100.0])
def test_it_takes_the_first_sample_at_or_after_each_due_instant(rate_hz: float) -> None:
    rng = random.Random(5)
    times_ns = [START_NS]
    while times_ns[-1] < START_NS + 10_000_000_000:
        times_ns.append(times_ns[-1] + rng.randrange(1_900_000, 2_100_000))
    instants = [START_NS + ceil(k * 1e9 / rate_hz) for k in range(int(10 * rate_hz))]
    expected = [next(t_ns for t_ns in times_ns if t_ns >= due_ns) for due_ns in instants]
    assert taken(Pace(rate_hz), times_ns)[: len(expected)] == expected


def test_it_does_not_drift_in_a_day() -> None:
    pace = Pace(3.0)
    last_ns = START_NS + 86_400 * 1_000_000_000
    assert taken(pace, [START_NS, last_ns - 1]) == [START_NS, last_ns - 1]
    assert not pace.is_due(last_ns - 1)
    assert pace.is_due(last_ns)  # due instant number 259,200 exactly


def test_a_rate_above_the_device_s_takes_everything() -> None:
    for step_ns, rates_hz in ((1_000_000, (1000.0, 1001.0, 1e6)), (1, (1e9, 5e9, 1e300))):
        times_ns = [START_NS + k * step_ns for k in range(100)]
        for rate_hz in rates_hz:
            assert taken(Pace(rate_hz), times_ns) == times_ns


def test_after_a_pause_there_is_no_burst() -> None:
    times_ns = [START_NS, *(START_NS + 5_000_000_000 + k * 10_000_000 for k in range(10))]
    assert taken(Pace(10.0), times_ns) == times_ns[:2]


def test_subscription_matches() -> None:
    everything = Subscription(None, None, 0, Form.JSON)
    one = Subscription(("imu0",), None, 2.0, Form.BINARY)
    assert everything.matches("new")
    assert everything.pace_of("new") is None
    assert one.matches("imu0")
    assert not one.matches("imu1")
    assert one.pace_of("imu0") is one.pace_of("imu0")


@pytest.mark.parametrize("encoding", ["json", "binary"])
def test_rate_is_per_client_and_device(tmp_path: Path, encoding: str) -> None:
    async def body() -> None:
        async with serving(tmp_path) as server:
            slow, fast = await Peer.greeted(server), await Peer.greeted(server)
            await slow.result("watch", rate_hz=100, encoding=encoding)
            await fast.result("watch", rate_hz=250.0, encoding=encoding)
            for first in range(1, 1001, 25):
                server.publish(batch("imu0", first, 25))
                server.publish(batch("imu1", first, 25, period_ns=2_000_000))
            given = {client.number: client.sent + client.queue_samples for client in server.hub.clients()}
            assert given == {1: 100 + 200, 2: 250 + 500}
            slow.close()
            fast.close()

    run(body)


def test_rates_of_clients_are_independent(tmp_path: Path) -> None:
    async def body() -> None:
        async with serving(tmp_path) as server:
            peers = [await Peer.greeted(server) for _ in range(3)]
            for peer, rate_hz in zip(peers, (100, 500, 250), strict=True):
                await peer.result("watch", rate_hz=rate_hz)
            for seq in range(1, 12):
                server.publish(batch("imu0", seq))
            expected = ([1, 11], [1, 3, 5, 7, 9, 11], [1, 5, 9])
            for peer, numbers in zip(peers, expected, strict=True):
                assert [(await peer.message())["params"]["seq"] for _ in numbers] == numbers
                peer.close()

    run(body)


def test_a_change_elsewhere_does_not_disturb_the_pace(tmp_path: Path) -> None:
    async def body() -> None:
        async with serving(tmp_path) as server:
            peer = await Peer.greeted(server)
            await peer.result("watch", rate_hz=1)
            for seq in range(1, 2002):
                if seq % 100 == 0:
                    other = await Peer.greeted(server)
                    await other.result("watch")
                    other.close()
                server.publish(batch("imu0", seq))
            assert [(await peer.message())["params"]["seq"] for _ in range(3)] == [1, 1001, 2001]
            peer.close()

    run(body)
