"""Floods of pages and requests on real connections, and the messages that the server processes of them."""

import asyncio
import base64
import json
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from aiohttp import WSMessage, web
from aiohttp.web import AppRunner

from imud.model.units import NS_PER_S
from imud.model.work_budget import EDGE_FACTOR
from imud.web import budgets
from imud.web.budgets import OPEN_PAGES, OPEN_REQUESTS, WebClock
from imud.web.connections import READ_BYTES, LimitedSite, MeteredProtocol
from imud.web.guard import WebGuard
from imud.web.hub import Browser
from imud.web.server import OPEN_BROWSERS_MAX, WebServer, server_log
from tests.support.socket_rig import until

TOKEN = b"correct-horse-battery-staple"
STEP_NS = 50_000  # CPU time of each measured work in a test
PAGES = 8
REFUSALS = 40  # refusals after which a budget at a fixed time permits nothing more


class StepClock(WebClock):
    """Clock that a test advances. Each read of the CPU time adds a step."""

    def __init__(self) -> None:
        super().__init__(lambda: self.time_ns, self._read_cpu)
        self.time_ns = 0
        self.spent_ns = 0
        self.step_ns = STEP_NS

    def advance(self) -> int:
        self.time_ns += NS_PER_S // 1000
        return self.time_ns

    def _read_cpu(self) -> int:
        self.spent_ns += self.step_ns
        return self.spent_ns


class CountingServer(WebServer):
    """Server that counts the messages of pages and the requests that it processes."""

    def __init__(self, path: str, clock: StepClock) -> None:
        super().__init__(path, WebGuard(TOKEN, lambda: 1e9, reading_needs_token=False), clock)
        self.counts = Counter[str]()

    def _take(self, browser: Browser, message: WSMessage) -> None:
        self.counts["messages"] += 1
        super()._take(browser, message)

    async def _checked(self, request: web.Request, handler: Any) -> web.StreamResponse:
        self.counts["requests"] += 1
        return await super()._checked(request, handler)


class Site:
    def __init__(self, server: CountingServer, clock: StepClock, address: tuple[str, int]) -> None:
        self.server, self.clock, self.address = server, clock, address
        self.host = f"{address[0]}:{address[1]}"
        self._writers: list[asyncio.StreamWriter] = []

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection(*self.address)
        self._writers.append(writer)
        return reader, writer

    async def get(self, path: str, *headers: str) -> bytes:
        """Return the head of the reply."""
        reader, writer = await self.connect()
        lines = (f"GET {path} HTTP/1.1", f"Host: {self.host}", *headers)
        writer.write("".join(f"{line}\r\n" for line in lines).encode() + b"\r\n")
        return await reader.readuntil(b"\r\n\r\n")

    async def open_page(self, *headers: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await self.connect()
        lines = (
            "GET /api/stream HTTP/1.1", f"Host: {self.host}", f"Origin: http://{self.host}", "Upgrade: websocket",
            "Connection: Upgrade", "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Key: {base64.b64encode(bytes(16)).decode()}", *headers,
        )  # fmt: skip
        writer.write("".join(f"{line}\r\n" for line in lines).encode() + b"\r\n")
        assert b" 101 " in await reader.readuntil(b"\r\n\r\n")
        return reader, writer

    async def close(self) -> None:
        for writer in self._writers:
            writer.transport.abort()


@asynccontextmanager
async def running(folder: Path) -> AsyncIterator[Site]:
    clock = StepClock()
    server = CountingServer(str(folder / "none"), clock)
    runner = AppRunner(server.make_app(), access_log=None, logger=server_log(), shutdown_timeout=0.1)
    await runner.setup()
    await LimitedSite(runner, "127.0.0.1", 0, server.connections).start()
    site = Site(server, clock, runner.addresses[0][:2])
    try:
        yield site
    finally:
        await site.close()
        await runner.cleanup()


def frame(opcode: int, body: bytes = b"") -> bytes:
    """Return a WebSocket frame with a mask of zeros."""
    size = bytes([0x80 | len(body)]) if len(body) < 126 else bytes([0x80 | 126]) + len(body).to_bytes(2, "big")
    return bytes([opcode]) + size + bytes(4) + body


def look(page: int, number: int) -> bytes:
    devices = {"look": "device", "device": f"x{page}-{number}", "other": f"y{page}-{number}", "rate_hz": 50}
    return frame(0x81, json.dumps(devices).encode())


FLOODS = {
    "views": b"".join(look(page, number) for number in range(1000) for page in range(2)),
    "empty messages": frame(0x81) * 20_000,
    "pings": frame(0x89) * 20_000,
    "pongs": frame(0x8A, b"x" * 125) * 2_000,
    "binary": frame(0x82, bytes(1000)) * 2_000,
    "continuations": frame(0x01) + frame(0x00) * 200_000,
}


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count the reads of all connections."""
    counts = Counter[str]()
    buffer_updated = MeteredProtocol.buffer_updated

    def counted(protocol: MeteredProtocol, nbytes: int) -> None:
        assert nbytes <= READ_BYTES
        counts["reads"] += 1
        buffer_updated(protocol, nbytes)

    monkeypatch.setattr(MeteredProtocol, "buffer_updated", counted)
    return counts


@pytest.mark.parametrize("kind", FLOODS)
async def test_flood_of_pages_has_bounded_work(tmp_path: Path, reads: Counter[str], kind: str) -> None:
    """Eight pages without a token send as fast as they can. The CPU time of a second is fixed."""
    async with running(tmp_path) as site:
        site.clock.time_ns = 10 * NS_PER_S
        pages = [await site.open_page() for _ in range(PAGES)]
        reads.clear()
        budget = site.server.pages[False].budget.work
        for _, writer in pages:
            writer.write(FLOODS[kind])
        await until(lambda: budget.refused >= REFUSALS * PAGES)
        # each read and each message costs at least a step; the last work of each page can exceed the budget
        steps_max = EDGE_FACTOR * OPEN_PAGES.second_cpu_ns // STEP_NS + 2 * PAGES
        assert 0 < site.server.counts["messages"] + reads["reads"] <= steps_max
        if kind != "continuations":
            assert site.server.counts["messages"] >= PAGES, "each page has its turn"
        # the floods have another budget than requests
        assert b" 200 " in await site.get("/api/session")


async def test_page_with_token_is_not_delayed(tmp_path: Path) -> None:
    async with running(tmp_path) as site:
        pages = [await site.open_page() for _ in range(PAGES)]
        for _, writer in pages:
            writer.write(FLOODS["views"])
        await until(lambda: site.server.pages[False].budget.work.refused >= REFUSALS * PAGES)
        processed = site.server.counts["messages"]
        _, writer = await site.open_page(f"Authorization: Bearer {TOKEN.decode()}")
        writer.write(look(9, 9))
        await until(lambda: site.server.counts["messages"] > processed)


async def test_flooding_page_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(tmp_path) as site:
        monkeypatch.setattr(budgets, "PAUSE_S", 0.0)
        reader, writer = await site.open_page()
        site.clock.now_ns = site.clock.advance
        site.clock.step_ns = 0  # only the number of messages counts
        writer.write(FLOODS["pongs"])
        await until(lambda: "sends more than imud web processes" in caplog.text)
        assert "page 1 of 127.0.0.1 sends more than imud web processes; " in caplog.text
        assert b"this page sends more than imud web processes" in await reader.readuntil(b"processes")
        assert caplog.text.count("sends more") == 1


async def test_pipelined_requests_have_bounded_work(tmp_path: Path) -> None:
    async with running(tmp_path) as site:
        reader, writer = await site.connect()
        writer.write(f"GET /api/session HTTP/1.1\r\nHost: {site.host}\r\n\r\n".encode() * 5_000)
        budget = site.server.requests[False].work
        await until(lambda: budget.refused >= REFUSALS)
        assert 0 < site.server.counts["requests"] <= OPEN_REQUESTS.second_cpu_ns // STEP_NS
        site.clock.time_ns += NS_PER_S
        with suppress(ConnectionError):
            await reader.read()  # the connection closes after the delayed request
        assert site.server.counts["requests"] <= 2 * OPEN_REQUESTS.second_cpu_ns // STEP_NS


async def test_pages_without_token_leave_places(tmp_path: Path) -> None:
    async with running(tmp_path) as site:
        for number in range(OPEN_BROWSERS_MAX):
            site.clock.time_ns = number * NS_PER_S
            await site.open_page()
        site.clock.time_ns += NS_PER_S
        with pytest.raises(AssertionError):
            await site.open_page()
        await site.open_page(f"Authorization: Bearer {TOKEN.decode()}")
