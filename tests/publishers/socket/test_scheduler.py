"""Scheduler: limited turns, fair order, parked and evicted clients, and errors that end only one client."""

import asyncio
import select
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from unittest.mock import Mock

import pytest

from imud.publishers.socket.scheduler import ScheduledClient, Scheduler, TokenBucket
from tests.support.socket_rig import SteppingClock, in_context, until

CPU_NEW_NS, CPU_PER_S_NS, OVER_TICKS_MAX = 100_000_000, 100_000_000, 100
MS = 1_000_000


class Worker(ScheduledClient):
    """A client with `pieces` pieces of work. Each costs `cost_ns`."""

    def __init__(self, name: str, rig: "SchedulerBench", uid: int, pieces: int, cost_ns: int) -> None:
        super().__init__(rig.scheduler, rig.socks[-2].fileno(), len(rig.socks), uid)
        self.name, self.rig = name, rig
        self.pieces, self.cost_ns = pieces, cost_ns
        self.error: Exception | None = None
        self.failures: list[Exception] = []
        self.overloads = 0

    def on_ready(self, events: int) -> None:
        assert events & select.EPOLLIN

    def serve(self) -> bool:
        self.rig.clock.ns += self.cost_ns
        self.rig.log.append(self.name)
        self.rig.on_piece()
        self.pieces -= 1
        if self.error is not None:
            raise self.error
        return self.pieces > 0

    def wanted_events(self) -> int:
        return 0

    def on_failure(self, error: Exception) -> None:
        self.failures.append(error)
        self.error = None

    def evict(self, reason: str) -> None:
        self.overloads += 1

    def enqueue(self) -> None:
        self.rig.scheduler.enqueue(self)


class SchedulerBench:
    def __init__(self) -> None:
        self.clock = SteppingClock()
        self.log: list[str] = []
        self.on_piece: Callable[[], object] = lambda: None
        """Called after each piece."""
        time = TokenBucket(1_000_000_000, 1_000 * MS, self.clock(), 1_000 * MS)
        self.scheduler = Scheduler(self.clock, self.clock, time)
        self.socks: list[socket.socket] = []

    def add(self, name: str, uid: int, pieces: int, cost_ns: int) -> Worker:
        self.socks += socket.socketpair()
        return Worker(name, self, uid, pieces, cost_ns)


@asynccontextmanager
async def scheduling(_folder: Path) -> AsyncIterator[SchedulerBench]:
    rig = SchedulerBench()
    try:
        yield rig
    finally:
        with suppress(ValueError):  # a test has closed it
            rig.scheduler.close()
        for sock in rig.socks:
            sock.close()


@in_context("rig", scheduling)
async def test_a_turn_is_limited_and_other_callbacks_run_in_between(rig: SchedulerBench) -> None:
    rig.add("busy", 1, 100, MS // 4).enqueue()
    for _ in range(20):
        asyncio.get_running_loop().call_soon(rig.log.append, "sample")
        await asyncio.sleep(0)
    served = "".join("b" if word == "busy" else "." for word in rig.log)
    assert "b" * 5 not in served  # 4 pieces of 0.25 ms make a turn
    assert served.count("b") > 40


@in_context("rig", scheduling)
async def test_the_user_and_the_client_with_the_least_run_time_are_next(rig: SchedulerBench) -> None:
    for number in range(8):
        rig.add(f"many{number}", 1, 50, MS // 4).enqueue()
    rig.add("one", 2, 50, MS // 4).enqueue()
    await until(lambda: len(rig.log) >= 60)
    assert 26 <= rig.log[:60].count("one") <= 34  # half of the time for each user
    counts = [rig.log[:60].count(f"many{number}") for number in range(8)]
    assert max(counts) - min(counts) <= 1


@in_context("rig", scheduling)
async def test_a_new_client_is_served_before_busy_clients(rig: SchedulerBench) -> None:
    for number in range(20):
        rig.add(f"many{number}", 1, 1000, MS // 2).enqueue()
    await until(lambda: len(rig.log) > 100)
    before = len(rig.log)
    rig.add("good", 1, 1, MS // 10).enqueue()
    await until(lambda: "good" in rig.log)
    assert rig.log.index("good") - before <= 20  # at most one round of the others


@in_context("rig", scheduling)
async def test_a_client_above_its_allowance_is_parked_and_evicted(rig: SchedulerBench) -> None:
    worker = rig.add("busy", 1, 1_000_000, 5 * MS)
    worker.enqueue()
    for _ in range(200):
        await asyncio.sleep(0)
    used = len(rig.log)
    assert used * 5 * MS <= CPU_NEW_NS + CPU_PER_S_NS  # then it is parked
    rig.clock.ns += 500 * MS
    rig.scheduler.tick()
    await until(lambda: len(rig.log) > used)
    ticks = 0
    while not worker.overloads:
        for _ in range(100):
            await asyncio.sleep(0)
        rig.clock.ns += 20 * MS
        rig.scheduler.tick()
        ticks += 1
    assert 100 <= ticks <= 102  # 10 s


@in_context("rig", scheduling)
async def test_a_client_has_an_allowance_of_cpu_time_and_of_bytes(rig: SchedulerBench) -> None:
    client = rig.add("talker", 1, 5, 0)
    now_ns = rig.clock()
    client.fill(now_ns + 499 * MS)
    assert not client.is_light
    client.fill(now_ns + 500 * MS)  # 100 ms for a new client, and 100 ms per second
    assert client.is_light
    client.data.use(1 << 20)
    assert (client.is_over, client.is_light) == (False, True)
    client.data.use(262_144)
    assert (client.is_over, client.is_light) == (True, False)
    client.fill(now_ns + 1499 * MS)
    assert client.is_over
    client.fill(now_ns + 1501 * MS)
    assert not client.is_over
    client.cpu.use(200 * MS)  # the maximum allowance
    assert not client.is_over
    client.cpu.use(1)
    assert client.is_over
    client.cpu.use(1000 * MS)  # the debt is at most the maximum allowance
    client.fill(now_ns + 3500 * MS)
    assert client.is_over
    client.fill(now_ns + 3502 * MS)
    assert not client.is_over


@in_context("rig", scheduling)
async def test_a_turn_has_a_limited_number_of_pieces(rig: SchedulerBench) -> None:
    rig.add("free", 1, 1000, 0).enqueue()
    await asyncio.sleep(0)
    assert len(rig.log) == 64


@in_context("rig", scheduling)
async def test_sockets_are_looked_at_again_within_a_turn(rig: SchedulerBench) -> None:
    """After 0.2 ms, so that a client with few requests is next."""
    busy = rig.add("busy", 1, 100, MS // 10)
    rig.add("asking", 2, 1, 0)
    busy.enqueue()
    rig.on_piece = lambda: rig.socks[3].send(b"x") if rig.log == ["busy"] else None
    await asyncio.sleep(0)
    assert rig.log[:4] == ["busy", "busy", "asking", "busy"]
    assert len(rig.log) == 11  # 10 pieces make a turn of 1 ms
    assert busy.pieces == 90


@in_context("rig", scheduling)
async def test_a_client_can_end_the_daemon_during_its_turn(rig: SchedulerBench) -> None:
    rig.add("last", 1, 1, MS // 4).enqueue()
    rig.on_piece = rig.scheduler.close
    await until(lambda: rig.log == ["last"])


@pytest.mark.parametrize("uid", [1, 2])
@in_context("rig", scheduling)
async def test_an_idle_client_has_a_lead_of_one_millisecond(rig: SchedulerBench, uid: int) -> None:
    rig.add("busy", 1, 1000, MS // 4).enqueue()
    idle = rig.add("idle", uid, 1000, MS // 4)
    await until(lambda: len(rig.log) >= 100)
    count = len(rig.log)
    idle.enqueue()
    await until(lambda: len(rig.log) >= count + 12)
    later = rig.log[count:]
    assert later.index("busy") in (4, 5)
    assert 2 <= later[4:12].count("busy") <= 6


@in_context("rig", scheduling)
async def test_when_the_time_for_serving_is_used_up_only_light_clients_are_served(rig: SchedulerBench) -> None:
    for number in range(4):
        rig.add(f"heavy{number}", 1, 10_000, MS // 2).enqueue()
    good = rig.add("good", 1, 1, MS // 10)
    good.fill(rig.clock() + 1000 * MS)  # it has sent nothing for a second
    await until(lambda: len(rig.log) >= 8)
    rig.scheduler.serving_time.use(2_000 * MS)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    before = len(rig.log)
    good.enqueue()
    await until(lambda: "good" in rig.log[before:])
    assert len(rig.log) - before <= 3  # at most one turn that serves all clients, every 10 ms
    assert not good.pieces


@in_context("rig", scheduling)
async def test_without_time_for_serving_all_clients_are_served_every_10_ms(rig: SchedulerBench) -> None:
    rig.add("heavy", 1, 10_000, MS // 2).enqueue()
    await until(lambda: bool(rig.log))
    rig.scheduler.serving_time.use(2_000 * MS)
    for _ in range(2):
        rig.clock.ns += 10 * MS
        count = len(rig.log)
        await until(lambda count=count: len(rig.log) > count)  # type: ignore[misc]
        count = len(rig.log)
        rig.clock.ns += 8 * MS  # the turn took 1 ms
        await asyncio.sleep(0.01)  # several pauses of 2 ms
        assert len(rig.log) == count


@in_context("rig", scheduling)
async def test_errors_end_only_their_client(
    rig: SchedulerBench, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = rig.add("bad", 1, 2, 1000)
    bad.error = RecursionError("deep")
    other = rig.add("other", 1, 3, 1000)
    bad.enqueue()
    other.enqueue()
    await until(lambda: not other.pieces and not bad.pieces)
    assert [str(error) for error in bad.failures] == ["deep"]
    assert not other.failures
    rig.log.clear()
    bad = rig.add("bad", 1, 1000, 1000)
    bad.error = RecursionError("deep")
    monkeypatch.setattr(bad, "on_failure", Mock(side_effect=ZeroDivisionError))
    other = rig.add("other", 1, 3, 1000)
    bad.enqueue()
    other.enqueue()
    await until(lambda: not other.pieces)
    assert rig.log.count("bad") == 1
    assert "no longer served" in caplog.text


@pytest.mark.parametrize("where", ["evict", "on_ready", "wanted_events"])
@in_context("rig", scheduling)
async def test_other_errors_end_their_client(rig: SchedulerBench, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """No exception may reach the handler of the event loop, which ends the daemon."""
    bad = rig.add("bad", 1, 10_000 if where == "evict" else 1, 5 * MS)
    monkeypatch.setattr(bad, where, Mock(side_effect=ZeroDivisionError(where)))
    if where == "on_ready":
        rig.socks[1].send(b"x")
    else:
        bad.enqueue()
    for _ in range(OVER_TICKS_MAX + 10):
        for _ in range(30):
            await asyncio.sleep(0)
        rig.clock.ns += 2 * MS
        rig.scheduler.tick()
        if bad.failures:
            break
    assert str(bad.failures[0]) == where
    other = rig.add("other", 1, 1, 1000)
    other.enqueue()
    await until(lambda: not other.pieces)


@in_context("rig", scheduling)
async def test_a_client_that_left_is_not_served(rig: SchedulerBench) -> None:
    gone = rig.add("gone", 1, 5, 1000)
    other = rig.add("other", 1, 1, 1000)
    gone.enqueue()
    rig.scheduler.remove(gone)
    rig.scheduler.remove(gone)
    other.enqueue()
    await until(lambda: rig.log == ["other"])
