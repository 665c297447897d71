"""Prometheus endpoint: a scrape requests a snapshot of the event loop. Start, failure and end."""

import asyncio
import socket
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest
from prometheus_client.parser import text_string_to_metric_families as parse_text

from imud.contracts.publisher import PublisherContext
from imud.contracts.status import DeviceStatus
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.publishers.metrics.publisher import MetricsOptions, MetricsPublisher
from tests.support.event_loops import in_loop
from tests.support.metrics import LIMIT_S, ask, device, read_all
from tests.support.publisher_context import publisher_context
from tests.support.rings import DEVICE, Board

DEVICES_PER_TURN = 8
DEVICES = (device("front", 0), device("rear", 1))


def context(status: Callable[[], Sequence[DeviceStatus]] = lambda: DEVICES) -> PublisherContext:
    return publisher_context(status, 1, lambda: 5_000_000_000)


@asynccontextmanager
async def publisher(
    context: PublisherContext, snapshot_s: float = LIMIT_S, **settings: object
) -> AsyncIterator[MetricsPublisher]:
    # options by name
    made = MetricsPublisher(MetricsOptions(**{"port": 0, **settings}), context, snapshot_s=snapshot_s)  # type: ignore[arg-type]
    made.start()
    try:
        yield made
    finally:
        made.close()
        made.close()
        assert "scrape" not in {thread.name for thread in threading.enumerate()}


@in_loop
async def test_scrape_over_http_reads_the_status_in_the_loops_thread() -> None:
    threads = []

    def status() -> Sequence[DeviceStatus]:
        threads.append(threading.get_ident())
        return DEVICES

    async with publisher(context(status)) as served:
        served.event(Event(1, "front", EventKind.LOSS, ""))
        served.event(Event(1, "front", EventKind.LOSS, ""))
        served.event(Event(1, "", EventKind.CONFIGURATION, ""))
        served.tick(4_000_000_000)
        line, head, body = await ask(served.port)
        assert line == "HTTP/1.1 200 OK"
        assert "Content-Type: text/plain; version=0.0.4" in head
        assert f"Content-Length: {len(body.encode())}" in head
        shown = {(line.name, *line.labels.values()): line.value for found in parse_text(body) for line in found.samples}
        assert shown["imud_samples_total", "rear"] == DEVICES[1].ledger["samples"]
        assert shown["imud_events_total", "front", "loss"] == 2
        assert (shown["imud_events_total", "", "configuration"], shown["imud_heartbeat_age_seconds",]) == (1, 1.0)
        served.remove_device("front")
        assert 'imud_events_total{device="front"' not in (await ask(served.port))[2]
        _, head, body = await ask(served.port, headers="Accept: application/openmetrics-text; version=1.0.0\r\n")
        assert "application/openmetrics-text" in head
        assert body.endswith("# EOF\n")
    assert set(threads) == {threading.get_ident()}


@in_loop
async def test_scrapes_are_counted_without_requests_of_the_count() -> None:
    stepping = publisher_context(lambda: DEVICES, 1, iter(range(10**11, 10**12, 2 * 10**9)).__next__)
    async with publisher(stepping) as served:
        assert (await ask(served.port, "/scrapes"))[2] == '{"scrapes":0,"age_s":2.0}', "since the start"
        await ask(served.port)
        line, head, body = await ask(served.port, "/scrapes")
        assert line == "HTTP/1.1 200 OK"
        assert "Content-Type: application/json" in head
        assert body == '{"scrapes":1,"age_s":4.0}'  # the clock of the test advances by 2 s at each reading


@in_loop
async def test_waiting_scrapes_share_one_page_per_format() -> None:
    """Each snapshot costs time of the event loop. Scrapers that no longer wait would be served first."""
    seen: list[int] = []

    def status() -> Sequence[DeviceStatus]:
        seen.append(len(seen))
        return DEVICES

    def scrape(port: int, accept: str) -> str:
        request = urllib.request.Request(f"http://127.0.0.1:{port}/metrics", headers={"Accept": accept})
        with urllib.request.urlopen(request, timeout=LIMIT_S) as answer:
            return str(answer.headers["Content-Type"])

    def all_came(port: int, number: int) -> bool:
        end = time.monotonic() + LIMIT_S
        while time.monotonic() < end:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/scrapes", timeout=LIMIT_S) as answer:
                if f'"scrapes":{number},' in answer.read().decode():
                    return True
        return False

    async with publisher(context(status)) as served:
        with ThreadPoolExecutor(10) as threads:
            formats = ["text/plain"] * 9 + ["application/openmetrics-text; version=1.0.0"]
            answers = [threads.submit(scrape, served.port, accept) for accept in formats]
            assert all_came(served.port, len(formats))  # the event loop is blocked until then
            types = [await asyncio.wrap_future(answer) for answer in answers]
    assert [each.partition(";")[0] for each in types] == [each.partition(";")[0] for each in formats]
    assert len(seen) == 2


@in_loop
async def test_a_scrape_reads_few_devices_per_turn_and_pauses_for_each_metric(monkeypatch: pytest.MonkeyPatch) -> None:
    turn, seen, pauses_s = 0, [], list[float]()
    monkeypatch.setattr(time, "sleep", pauses_s.append)

    def each_status() -> Iterator[DeviceStatus]:
        for number in range(2 * DEVICES_PER_TURN + 1):
            seen.append(turn)
            yield device(f"imu{number}")

    async def count_turns() -> None:
        nonlocal turn
        while True:
            turn += 1
            await asyncio.sleep(0)

    async with publisher(publisher_context(each_status=each_status)) as served:
        counting = asyncio.create_task(count_turns())
        _, _, body = await ask(served.port)
        counting.cancel()
        assert f'imud_device_up{{device="imu{2 * DEVICES_PER_TURN}"' in str(body)
    assert pauses_s.count(100e-6) > 50
    assert (max(Counter(seen).values()), len(set(seen))) == (DEVICES_PER_TURN, 3)


@pytest.mark.parametrize("devices", [1, 3 * DEVICES_PER_TURN])
@in_loop
async def test_the_delay_of_a_blocked_loop_is_shown_although_it_ticks_during_the_snapshot(devices: int) -> None:
    now_ns = 5_000_000_000
    published: list[MetricsPublisher] = []

    def each_status() -> Iterator[DeviceStatus]:
        for number in range(devices):
            yield device(f"imu{number}")
            published[0].tick(now_ns)

    async with publisher(publisher_context(now_ns=lambda: now_ns, each_status=each_status)) as served:
        published.append(served)
        now_ns += 1_500_000_000
        _, _, body = await ask(served.port)
        assert "imud_heartbeat_age_seconds 1.5\n" in body


@in_loop
async def test_rings_of_the_daemon_are_read(board: Board) -> None:
    newest = device(DEVICE, newest_seq=10)
    board.now_ns = 20_000_000
    board.publish(range(1, 11))
    board.tick(0)
    outputs = replace(board.context.outputs, without_ring={"other"})
    context = publisher_context(lambda: [newest], 1, lambda: board.now_ns, outputs=outputs)
    for motion in (True, False):
        async with publisher(context, motion=motion) as served:
            body = (await ask(served.port))[2]
        assert f'imud_ring_written{{device="{DEVICE}"}} 1.0' in body
        assert 'imud_ring_written{device="other"} 0.0' in body
        assert (f'imud_motion_span_seconds{{device="{DEVICE}"}} 0.009' in body) == motion
        assert (f'imud_acceleration_norm_meters_per_second_squared{{device="{DEVICE}"}}' in body) == motion


@in_loop
async def test_paths_and_methods() -> None:
    async with publisher(context()) as served:
        assert "/metrics" in (await ask(served.port, "/"))[2]
        assert (await ask(served.port, "/metrics?x=1"))[0] == "HTTP/1.1 200 OK"
        invalid = "Accept: application/openmetrics-text; version=x\r\n"
        assert "Content-Type: text/plain; version=0.0.4" in (await ask(served.port, headers=invalid))[1]
        assert (await ask(served.port, "/other"))[0] == "HTTP/1.1 404 Not Found"
        assert (await ask(served.port, method="POST"))[0] == "HTTP/1.1 405 Method Not Allowed"
        line, head, body = await ask(served.port, method="HEAD")
        assert line == "HTTP/1.1 200 OK"
        assert int(head.partition("Content-Length: ")[2].split()[0]) > 1000
        assert body == ""


@in_loop
async def test_a_blocked_or_closed_loop_causes_status_503_and_close_does_not_wait() -> None:
    async with publisher(context(), snapshot_s=0.05) as served:
        with socket.create_connection(("127.0.0.1", served.port), LIMIT_S) as connection:
            connection.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
            assert b"503 Service Unavailable" in read_all(connection)  # this read blocks the event loop
    other = MetricsPublisher(MetricsOptions(port=0), context(), snapshot_s=3600)
    other.start()
    with socket.create_connection(("127.0.0.1", other.port), LIMIT_S) as connection:
        connection.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        other.close()
        assert b"200" not in read_all(connection)
    ended = MetricsPublisher(MetricsOptions(port=0), context())

    async def start() -> None:
        ended.start()

    await asyncio.to_thread(asyncio.run, start())
    line, _, body = await ask(ended.port)
    assert (line, body) == ("HTTP/1.1 503 Service Unavailable", "the daemon did not reply within 2 s\n")
    ended.close()


@in_loop
async def test_a_port_in_use_a_port_after_close_and_no_port() -> None:
    async with publisher(context()) as first:
        second = MetricsPublisher(MetricsOptions(port=first.port), context())
        with pytest.raises(ServerError, match=rf"127\.0\.0\.1 port {first.port}: Address already in use; .*ss -ltnp"):
            second.start()
        second.close()
        assert (await ask(first.port))[0] == "HTTP/1.1 200 OK"
    async with publisher(context()) as first:
        port = first.port
        await ask(port)
    async with publisher(context(), port=port) as second:
        assert second.port == port
    async with publisher(context(), enabled=False) as served:
        assert served.port == 0


def test_the_address_is_checked() -> None:
    assert MetricsOptions(address="localhost").address == "localhost"
    with pytest.raises(ValueError, match=r'expected an IP address such as 127\.0\.0\.1 or ::1, got "front\.example"'):
        MetricsOptions(address="front.example")


@in_loop
async def test_flood_of_scrapes_gets_the_newest_page() -> None:
    """Each page costs 20 ms of CPU time. A flood makes at most 10 pages per second."""
    seen: list[int] = []
    renderer_cpu_ns = [0]

    def take_cpu_ns() -> int:
        renderer_cpu_ns[0] += 20_000_000
        return renderer_cpu_ns[0]

    def status() -> Sequence[DeviceStatus]:
        seen.append(len(seen))
        return DEVICES

    flooded = context(status)
    clock = replace(flooded.clock, cpu_ns=take_cpu_ns)
    async with publisher(replace(flooded, clock=clock)) as served:
        for _ in range(100):
            line, _, _ = await ask(served.port)
            assert line == "HTTP/1.1 200 OK"
    assert len(seen) <= 11
