"""Latency requests of clients, until the clients leave."""

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from imud.publishers.socket.server import SocketServer
from tests.publishers.socket.test_client_waker import notified
from tests.support.publisher_context import FakeLatencies
from tests.support.socket_rig import Peer, batch, in_context, serving, until

MS = 1_000_000
Asked = dict[str, tuple[int, tuple[str, ...] | None]]
Scene = tuple[SocketServer, Asked, Peer]


@asynccontextmanager
async def listening(directory: Path) -> AsyncIterator[Scene]:
    """Start a server with one client. Yield also the latency requests."""
    latencies = FakeLatencies()
    async with serving(directory, latencies=latencies) as server:
        yield server, latencies.asked, await Peer.greeted(server)
    assert latencies.asked == {}


@pytest.mark.parametrize(
    ("params", "latency_ms"),
    [
        ({}, 0.0), ({"rate_hz": 0}, 0.0), ({"rate_hz": 1000}, 1.0), ({"rate_hz": 100}, 10.0), ({"rate_hz": 40}, 20.0),
        ({"rate_hz": 1}, 20.0), ({"rate_hz": 1, "latency_ms": 0}, 0.0), ({"latency_ms": 7.5}, 7.5),
        ({"rate_hz": 1000, "latency_ms": 60_000}, 60_000.0), ({"rate_hz": 10, "latency_ms": None}, 20.0),
    ],
)  # fmt: skip
@in_context("scene", listening)
async def test_a_watch_requests_its_latency_or_period(scene: Scene, params: dict[str, Any], latency_ms: float) -> None:
    _server, asked, peer = scene
    reply = await peer.ask("watch", **params)
    assert (reply["result"]["latency_ms"], asked) == (latency_ms, {"client 1": (latency_ms * MS, None)})


@pytest.mark.parametrize("latency_ms", [-0.001, 60_001, 1e300])
@pytest.mark.parametrize("method", ["watch", "notify"])
@in_context("scene", listening)
async def test_invalid_latencies_are_refused(scene: Scene, method: str, latency_ms: float) -> None:
    _server, asked, peer = scene
    devices = {"devices": ["imu0"]} if method == "watch" else {"device": "imu0"}
    _code, message = await peer.error(method, latency_ms=latency_ms, **devices)
    assert message.startswith("latency_ms: expected 0 (no delay) … 60000")
    assert asked == {}


@in_context("scene", listening)
async def test_a_watch_replaces_the_latency_request_and_unwatch_ends_it(scene: Scene) -> None:
    _server, asked, peer = scene
    await peer.ask("watch", latency_ms=5)
    await peer.ask("watch", latency_ms=9, devices=["imu1"])
    assert asked == {"client 1": (9 * MS, ("imu1",))}
    await peer.ask("unwatch")
    assert asked == {}


@in_context("scene", listening)
async def test_a_client_or_descriptor_that_ends_withdraws_its_request(scene: Scene) -> None:
    server, asked, peer = scene
    other = await Peer.greeted(server)
    fd = await notified(peer)
    await other.ask("watch", latency_ms=3)
    assert asked == {"client 1, notify imu0": (0, ("imu0",)), "client 2": (3 * MS, None)}
    peer.close()
    await until(lambda: len(server.hub.connections) == 1)
    assert asked == {"client 2": (3 * MS, None)}
    os.close(fd)
    os.close(await notified(other))
    assert len(asked) == 2
    server.publish(batch("imu0"))
    await until(lambda: len(asked) == 1)
