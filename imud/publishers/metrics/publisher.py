"""Output `metrics`: the Prometheus endpoint `http://ADDRESS:PORT/metrics`. docs/metrics.md describes the metrics.

`/scrapes` reports the number of scrapes and the time since the last one. `imud doctor` requests it, and this request
does not count.

    HTTP thread ──call_soon_threadsafe──▶ event loop: status, clients ──▶ HTTP thread: rings, render, send

The event loop only creates a snapshot of plain records. Rendering holds Python's global lock. The HTTP thread therefore
pauses for PAUSE_S before each metric and after SAMPLES_PER_TURN lines. With 16 devices, a scrape without pauses delays
the event loop by 7 ms, one turn by 0.3 ms.
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
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample as Line

from imud.contracts.publisher import OutputListener, PublisherContext, PublisherType
from imud.contracts.status import ClientStatus, DeviceStatus
from imud.host.log import messages_dropped
from imud.host.scrape_server import HttpRequest, HttpResponse, ScrapeServer, encoder_for
from imud.model.event import Event
from imud.model.host_object import ListenAddress
from imud.model.options import Options, is_ip_address, shown
from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget, WorkLimits
from imud.publishers.metrics.families import (
    FAMILIES,
    FLIGHT_FAMILIES,
    MQTT_FAMILIES,
    PORT_FAMILIES,
    RECORDER_FAMILIES,
    RECORDINGS_FAMILIES,
    RULE_FAMILIES,
)
from imud.publishers.metrics.metric import Snapshot
from imud.publishers.metrics.rings import RingReader

log = logging.getLogger(__name__)

# Time limit for the reply of the event loop, s. After it, the scrape reports a blocked event loop.
SNAPSHOT_S: Final = 2.0
# Pause of the HTTP thread, s. The kernel needs some ten microseconds to wake the thread of the event loop.
PAUSE_S: Final = 100e-6

SAMPLES_PER_TURN: Final = 64  # Number of lines rendered without a pause. One line costs about 4 us.

DEVICES_PER_TURN: Final = 8  # number of devices whose status the event loop reads in one turn, about 0.3 ms
# CPU time of all scrapers per second in the HTTP thread. Above it, a scraper gets the newest page again: a page of one
# device costs about 10 ms, and Prometheus reads a page every 15 s.
SCRAPE_LIMITS: Final = WorkLimits(second_cpu_ns=200_000_000)
SCRAPERS: Final = "scrapers"  # peer of the budget: a snapshot serves all waiting scrapers together
JSON: Final = "application/json"
ABOUT: Final = b"imud: metrics for Prometheus are at /metrics\n"


class MetricsOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the Prometheus endpoint."""

    enabled: bool = True
    """Serve metrics."""
    address: ListenAddress = "127.0.0.1"
    """IP address of the server; `0.0.0.0`: all networks of the host. There is no password."""
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 9321
    """TCP port; 0: any free port."""
    motion: bool = True
    """Include attitude, acceleration and vibration. imud computes them from the rings in shared memory."""

    def __post_init__(self) -> None:
        """Raise ValueError if the address is invalid."""
        if not is_ip_address(self.address) and self.address != "localhost":
            raise ValueError(f"address: expected an IP address such as 127.0.0.1 or ::1, got {shown(self.address)}")


def pause() -> None:
    """Release Python's global lock for other threads."""
    time.sleep(PAUSE_S)


class Scrapes(msgspec.Struct, frozen=True):
    """Number of scrapes since the start."""

    scrapes: int
    age_s: float  # time since the last scrape, or since the start of the endpoint, s


class ClientTotals:
    """Sums of the samples sent and dropped for all clients, also for disconnected clients."""

    def __init__(self) -> None:
        self.sent = 0
        self.dropped = 0
        self._seen: dict[int, tuple[int, int]] = {}

    def update(self, clients: Sequence[ClientStatus]) -> None:
        """Add the samples since the previous call."""
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
        """Set the snapshot for `collect`."""
        totals = self._totals
        totals.update(snapshot.clients)
        self._snapshot = replace(
            snapshot, client_samples_sent=totals.sent, client_samples_dropped=totals.dropped
        )  # fmt: skip

    def describe(self) -> list[Metric]:
        """Return an empty list. Otherwise the registry would render all metrics for the description."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics of the snapshot."""
        recorder = RECORDER_FAMILIES if self._snapshot.recorders else ()
        flight = FLIGHT_FAMILIES if self._snapshot.flights else ()
        outputs = PORT_FAMILIES if self._snapshot.ports else ()
        mqtt = MQTT_FAMILIES if self._snapshot.mqtts else ()
        rules = RULE_FAMILIES if self._snapshot.rules else ()
        recordings = RECORDINGS_FAMILIES if recorder or flight else ()
        for family in (*FAMILIES, *recorder, *flight, *recordings, *outputs, *mqtt, *rules):
            metric = family.metric(self._snapshot)
            metric.samples = _PausingList(metric.samples, self._pause)
            yield metric


class _PausingList(list[Line]):
    """Lines of a metric. The iterator pauses before the first line and after each SAMPLES_PER_TURN lines."""

    def __init__(self, samples: Sequence[Line], pause: Callable[[], None]) -> None:
        super().__init__(samples)
        self._pause = pause

    def __iter__(self) -> Iterator[Line]:
        for begin in range(0, len(self), SAMPLES_PER_TURN):
            self._pause()
            yield from self[begin : begin + SAMPLES_PER_TURN]


class Renderer:
    """Registry of all metrics. Synchronization: the HTTP thread."""

    def __init__(self, pause: Callable[[], None] = pause) -> None:
        self._registry = CollectorRegistry()
        self._collector = DaemonCollector(pause)
        self._registry.register(self._collector)
        ProcessCollector(registry=self._registry)

    def render(self, snapshot: Snapshot, accept: str) -> HttpResponse:
        """Return the metrics in the format that the Accept header requests."""
        self._collector.show(snapshot)
        encode, content_type = encoder_for(accept)
        return HttpResponse("200 OK", encode(self._registry), content_type)


class MetricsPublisher:
    """Output of metrics. Synchronization: the event loop's thread; the HTTP thread runs `_answer`."""

    publish: Final = None  # this output does not need samples

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
        # held in the HTTP thread: 32 snapshots at once would need one long turn of the daemon's event loop
        self._turn = asyncio.Lock()
        self._pages: dict[str, asyncio.Task[HttpResponse]] = {}  # tasks that wait for a snapshot, by content type
        self._newest: dict[str, HttpResponse] = {}  # newest page by content type
        self._budget = WorkBudget(SCRAPE_LIMITS, context.clock.cpu_ns)  # used in the HTTP thread

    @property
    def port(self) -> int:
        """Return the bound port; 0 if the server is closed."""
        return self._server.port if self._server else 0

    def start(self) -> None:
        """Start the server if the output is enabled. Raises ServerError if address and port cannot be used."""
        if not self._settings.enabled:
            return
        self._loop = asyncio.get_running_loop()
        server = ScrapeServer(self._settings.address, self._settings.port)
        server.start(self._answer)
        self._server = server
        log.info("metrics at http://%s:%d/metrics", self._settings.address, self.port)

    def add_device(self, name: str, device_id: int) -> None:
        """Do nothing: each scrape reads the devices from the status."""

    def remove_device(self, name: str) -> None:
        """Remove the event counters of a device."""
        for key in [key for key in self._events if key[0] == name]:
            del self._events[key]

    def event(self, event: Event) -> None:
        self._events[event.device, event.kind.value] += 1

    def tick(self, now_ns: int) -> None:
        """Store the time: the heartbeat of the event loop."""
        self._tick_ns = now_ns

    def close(self) -> None:
        """Stop the HTTP thread. A second call does nothing."""
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
            return HttpResponse("404 Not Found", b"expected /metrics or /scrapes\n")
        self._scrapes += 1
        self._scraped_ns = self._context.clock.now_ns()
        return await self._page(request.accept)

    async def _page(self, accept: str) -> HttpResponse:
        """Return a page, together with other requests that wait for a snapshot. Otherwise imud would first serve
        clients that no longer wait, and each would need a snapshot."""
        content_type = encoder_for(accept)[1]
        page = self._pages.get(content_type)
        if page is None and content_type in self._newest and not self._may_scrape():
            return self._newest[content_type]
        if page is None:
            page = self._pages[content_type] = asyncio.create_task(self._scrape(accept, content_type))
        return await asyncio.shield(page)

    async def _scrape(self, accept: str, content_type: str) -> HttpResponse:
        """Return a new page. Requests after the snapshot get the next page."""
        async with self._turn:
            try:
                snapshot = await self._ask_loop()
            except TimeoutError:
                text = f"the daemon did not reply within {self._snapshot_s:g} s\n"
                return HttpResponse("503 Service Unavailable", text.encode())
            finally:
                del self._pages[content_type]
            newest = {device.name: device.newest_seq for device in snapshot.devices}
            self._may_scrape()
            views = self._rings.read(snapshot.rings, newest, self._scraped_ns)
            page = self._renderer.render(replace(snapshot, views=views), accept)
            self._budget.end_turn()
            self._newest[content_type] = page
            return page

    def _may_scrape(self) -> bool:
        """Return whether the budget of all scrapers permits a new page. Charge the work that follows to it."""
        self._budget.start_turn(self._scraped_ns)
        return self._budget.admit(SCRAPERS)

    async def _ask_loop(self) -> Snapshot:
        """Return a snapshot from the event loop. Raises TimeoutError if the loop is blocked or has ended."""
        answer: Future[Snapshot] = Future()
        if self._loop is None or self._loop.is_closed():
            raise TimeoutError
        # the last tick before the request: a late loop ticks before it calls `_begin_snapshot`
        self._loop.call_soon_threadsafe(self._begin_snapshot, answer, self._tick_ns)
        async with asyncio.timeout(self._snapshot_s):
            return await asyncio.wrap_future(answer)

    def _begin_snapshot(self, answer: "Future[Snapshot]", tick_ns: int) -> None:
        """Start a snapshot. `tick_ns` is the time of the last tick before the request."""
        self._gather(answer, self._context.clock.now_ns() - tick_ns, self._context.devices.each_status(), [])

    def _gather(
        self, answer: "Future[Snapshot]", late_ns: int, rest: Iterator[DeviceStatus], found: list[DeviceStatus]
    ) -> None:
        """Add the status of some devices. Continue in the next turn of the loop, and return the snapshot at the end."""
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
                    rules=tuple(status() for status in outputs.rules),
                    ports={output: source() for output, source in outputs.ports.items()},
                )
            )


def _listeners(options: MetricsOptions) -> list[OutputListener]:
    return [OutputListener(("port",), options.address, options.port)]


PUBLISHER = PublisherType("metrics", MetricsOptions, MetricsPublisher, listeners=_listeners)
