"""The Prometheus endpoint: `http://ADDRESS:PORT/metrics`. Names and meanings: docs/metrics.md.

`/scrapes` says how often `/metrics` was asked and how long ago, which `imud doctor` asks without being counted.

    HTTP thread ──call_soon_threadsafe──▶ event loop: status, clients ──▶ HTTP thread: rings, render, send

The event loop gives a snapshot of plain records and goes on. Rendering holds Python's global lock, so the HTTP
thread pauses for PAUSE_S before every metric and every SAMPLES_PER_TURN lines of it: measured with 16 devices
(`python -m tests.bench.metrics`), a whole scrape without pauses keeps the loop waiting for 7 ms, one turn 0.3 ms.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from itertools import islice
from typing import Annotated, Final

import msgspec
from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample as Line

from imud.contracts.publisher import PublisherContext, PublisherType
from imud.contracts.status import ClientStatus, DeviceStatus
from imud.host.log import messages_dropped
from imud.model.event import Event
from imud.model.options import Options, is_ip_address, shown
from imud.model.units import NS_PER_S
from imud.publishers.metrics.families import (
    FAMILIES,
    FLIGHT_FAMILIES,
    MQTT_FAMILIES,
    OUTPUT_FAMILIES,
    RECORDER_FAMILIES,
    RECORDINGS_FAMILIES,
)
from imud.publishers.metrics.metric import Snapshot
from imud.publishers.metrics.rings import RingReader
from imud.publishers.metrics.scrape_server import HttpRequest, HttpResponse, ScrapeServer

log = logging.getLogger(__name__)

SNAPSHOT_S: Final = 2.0
"""Time-out for the event loop's answer; the scrape then reports that it is stuck."""
PAUSE_S: Final = 100e-6
"""Long enough for the kernel to wake the loop's thread, which takes some ten microseconds."""

SAMPLES_PER_TURN: Final = 64
"""Lines rendered without a pause; one costs some 4 µs."""

DEVICES_PER_TURN: Final = 8
"""Devices whose status is taken in one turn of the event loop, about 0.3 ms."""
JSON: Final = "application/json"
ABOUT: Final = b"imud: metrics for Prometheus are at /metrics\n"


class MetricsOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the Prometheus endpoint."""

    enabled: bool = True
    """Whether metrics are served at all."""
    address: Annotated[str, msgspec.Meta(min_length=1)] = "127.0.0.1"
    """IP address to listen on; `0.0.0.0` is every network of this machine. There is no password."""
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 9321
    """TCP port; 0 takes any free one."""
    motion: bool = True
    """Whether attitude, acceleration and vibration are among the metrics, computed from the rings in shared memory."""

    def __post_init__(self) -> None:
        """Raise ValueError for what is no address to listen on."""
        if not is_ip_address(self.address) and self.address != "localhost":
            raise ValueError(f"address: expected an IP address such as 127.0.0.1 or ::1, got {shown(self.address)}")


def pause() -> None:
    """Let another thread run that waits for Python's global lock."""
    time.sleep(PAUSE_S)


class Scrapes(msgspec.Struct, frozen=True):
    """Requests of `/metrics` since the start."""

    scrapes: int
    age_s: float
    """Time since the last one, or before the first since the endpoint was made, s."""


class ClientTotals:
    """Sums of samples sent to and dropped for clients; a sum over the present ones would fall when one leaves."""

    def __init__(self) -> None:
        self.sent = 0
        self.dropped = 0
        self._seen: dict[int, tuple[int, int]] = {}

    def update(self, clients: Sequence[ClientStatus]) -> None:
        """Add what happened since the last call."""
        for client in clients:
            sent, dropped = self._seen.get(client.number, (0, 0))
            self.sent += client.sent - sent
            self.dropped += client.dropped - dropped
        self._seen = {client.number: (client.sent, client.dropped) for client in clients}


class DaemonCollector(Collector):
    """Collector that makes metrics of a snapshot. Synchronization: the HTTP thread."""

    def __init__(self, pause: Callable[[], None]) -> None:
        self._snapshot = Snapshot()
        self._totals = ClientTotals()
        self._pause = pause

    def show(self, snapshot: Snapshot) -> None:
        """Collect from `snapshot` from now on."""
        totals = self._totals
        totals.update(snapshot.clients)
        self._snapshot = replace(
            snapshot, client_samples_sent=totals.sent, client_samples_dropped=totals.dropped
        )  # fmt: skip

    def describe(self) -> list[Metric]:
        """Describe nothing in advance: the registry would render everything once for it."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics of the snapshot, with pauses while they are rendered."""
        recorder = RECORDER_FAMILIES if self._snapshot.recorders else ()
        flight = FLIGHT_FAMILIES if self._snapshot.flights else ()
        outputs = OUTPUT_FAMILIES if self._snapshot.outputs else ()
        mqtt = MQTT_FAMILIES if self._snapshot.mqtts else ()
        recordings = RECORDINGS_FAMILIES if recorder or flight else ()
        for family in (*FAMILIES, *recorder, *flight, *recordings, *outputs, *mqtt):
            metric = family.metric(self._snapshot)
            metric.samples = _PausingList(metric.samples, self._pause)
            yield metric


class _PausingList(list[Line]):
    """The lines of a metric; iteration pauses before the first and after every SAMPLES_PER_TURN."""

    def __init__(self, samples: Sequence[Line], pause: Callable[[], None]) -> None:
        super().__init__(samples)
        self._pause = pause

    def __iter__(self) -> Iterator[Line]:
        for begin in range(0, len(self), SAMPLES_PER_TURN):
            self._pause()
            yield from self[begin : begin + SAMPLES_PER_TURN]


class Renderer:
    """The registry of all metrics and the text made from it. Synchronization: the HTTP thread."""

    def __init__(self, pause: Callable[[], None] = pause) -> None:
        self._registry = CollectorRegistry()
        self._collector = DaemonCollector(pause)
        self._registry.register(self._collector)
        ProcessCollector(registry=self._registry)

    def render(self, snapshot: Snapshot, accept: str) -> HttpResponse:
        """The metrics in the format that the Accept header asks for."""
        self._collector.show(snapshot)
        encode, content_type = encoder_for(accept)
        return HttpResponse("200 OK", encode(self._registry), content_type)


def encoder_for(accept: str) -> tuple[Callable[[CollectorRegistry], bytes], str]:
    """The encoder for an Accept header, and its content type; the default where prometheus_client cannot read it.

    `choose_encoder` raises for a `version` that is no number (seen with 0.26).
    """
    try:
        return choose_encoder(accept)
    except (TypeError, ValueError):
        return choose_encoder("")


class MetricsPublisher:
    """Publisher of metrics. Synchronization: the event loop's thread; `_answer` runs in the HTTP thread."""

    publish: Final = None
    """Samples are counted by the pipeline."""

    def __init__(self, settings: MetricsOptions, context: PublisherContext, *, snapshot_s: float = SNAPSHOT_S) -> None:
        self._settings = settings
        self._context = context
        self._snapshot_s = snapshot_s
        self._events: Counter[tuple[str, str]] = Counter()
        self._tick_ns = context.clock.now_ns()
        self._renderer = Renderer()
        self._rings = RingReader(pause, motion=settings.motion)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server: ScrapeServer | None = None
        self._scrapes = 0
        self._scraped_ns = context.clock.now_ns()
        self._turn = asyncio.Lock()
        """Of the HTTP thread: 32 snapshots at once would be 32 in one turn of the daemon's event loop."""
        self._pages: dict[str, asyncio.Task[HttpResponse]] = {}
        """Pages of which the event loop has given nothing yet, by content type, of which there are a handful."""

    @property
    def port(self) -> int:
        """The bound port; 0 while nothing is served."""
        return self._server.port if self._server else 0

    def start(self) -> None:
        """Listen, if enabled. Raises ServerError when address and port cannot be had."""
        if not self._settings.enabled:
            return
        self._loop = asyncio.get_running_loop()
        server = ScrapeServer(self._settings.address, self._settings.port, self._answer)
        server.start()
        self._server = server
        log.info("metrics at http://%s:%d/metrics", self._settings.address, self.port)

    def add_device(self, name: str, device_id: int) -> None:
        """No-op: devices are found in the status at every scrape."""

    def remove_device(self, name: str) -> None:
        """Forget the device's events."""
        for key in [key for key in self._events if key[0] == name]:
            del self._events[key]

    def event(self, event: Event) -> None:
        """Count it."""
        self._events[event.device, event.kind.value] += 1

    def tick(self, now_ns: int) -> None:
        """Note that the event loop runs."""
        self._tick_ns = now_ns

    def close(self) -> None:
        """End the HTTP thread; may be called twice."""
        if self._server:
            self._server.close()
        self._server = None

    async def _answer(self, request: HttpRequest) -> HttpResponse:
        if request.method not in ("GET", "HEAD"):
            return HttpResponse("405 Method Not Allowed", b"expected GET or HEAD\n")
        if request.path == "/":
            return HttpResponse("200 OK", ABOUT)
        if request.path == "/scrapes":
            age_ns = self._context.clock.now_ns() - self._scraped_ns
            return HttpResponse("200 OK", msgspec.json.encode(Scrapes(self._scrapes, age_ns / NS_PER_S)), JSON)
        if request.path != "/metrics":
            return HttpResponse("404 Not Found", b"there is only /metrics\n")
        self._scrapes += 1
        self._scraped_ns = self._context.clock.now_ns()
        return await self._page(request.accept)

    async def _page(self, accept: str) -> HttpResponse:
        """The page that others wait for as well, if there is one.

        Scrapers that gave up would be answered before the one that waits, and each costs the loop a snapshot.
        """
        content_type = encoder_for(accept)[1]
        page = self._pages.get(content_type)
        if page is None:
            page = self._pages[content_type] = asyncio.create_task(self._scrape(accept, content_type))
        return await asyncio.shield(page)

    async def _scrape(self, accept: str, content_type: str) -> HttpResponse:
        """Make one page; who asks from the snapshot on gets another one."""
        async with self._turn:
            try:
                snapshot = await self._ask_loop()
            except TimeoutError:
                text = f"the daemon gave no status within {self._snapshot_s:g} s\n"
                return HttpResponse("503 Service Unavailable", text.encode())
            finally:
                del self._pages[content_type]
            newest = {device.name: device.newest_seq for device in snapshot.devices}
            views = self._rings.look(snapshot.rings, newest, self._scraped_ns)
            return self._renderer.render(replace(snapshot, views=views), accept)

    async def _ask_loop(self) -> Snapshot:
        """Get a snapshot from the daemon's event loop. Raises TimeoutError when the loop is stuck or has ended."""
        answer: Future[Snapshot] = Future()
        if self._loop is None or self._loop.is_closed():
            raise TimeoutError
        self._loop.call_soon_threadsafe(self._begin_snapshot, answer)
        async with asyncio.timeout(self._snapshot_s):
            return await asyncio.wrap_future(answer)

    def _begin_snapshot(self, answer: "Future[Snapshot]") -> None:
        """Begin with how late the loop is: in its next turn it has ticked, and is late no more."""
        self._gather(answer, self._context.clock.now_ns() - self._tick_ns, self._context.devices.each_status(), [])

    def _gather(
        self, answer: "Future[Snapshot]", late_ns: int, rest: Iterator[DeviceStatus], found: list[DeviceStatus]
    ) -> None:
        """Take the status of some devices, of the next ones in the next turn of the loop, and answer at the end."""
        some = list(islice(rest, DEVICES_PER_TURN))
        found += some
        if len(some) == DEVICES_PER_TURN and not answer.cancelled():
            asyncio.get_running_loop().call_soon(self._gather, answer, late_ns, rest, found)
        else:
            self._give_snapshot(answer, late_ns, found)

    def _give_snapshot(self, answer: "Future[Snapshot]", late_ns: int, devices: list[DeviceStatus]) -> None:
        if answer.set_running_or_notify_cancel():
            outputs = self._context.outputs
            answer.set_result(
                Snapshot(
                    devices,
                    [client for source in outputs.clients for client in source()],
                    tuple(self._events.items()),
                    late_ns,
                    messages_dropped(),
                    rings=dict.fromkeys(outputs.without_ring, "") | outputs.rings,
                    recorders=tuple(status() for status in outputs.recorders),
                    flights=tuple(status() for status in outputs.flights),
                    mqtts=tuple(status() for status in outputs.mqtts),
                    outputs=tuple(output for source in outputs.sentences for output in source()),
                )
            )


PUBLISHER = PublisherType("metrics", MetricsOptions, MetricsPublisher, required=False)
