"""HTTP server of the metrics of `imud fleet collect`: `http://HOST:PORT/metrics`.

    HTTP thread ──request──▶ FleetGauges (a thread) ──one transaction──▶ database
        ◀── page ── FleetShares.status + newest snapshot of the fleet

One collector of a fleet reads the metrics of the fleet from the database, at most every REFRESH_S. It holds a lease. If
it ends, or if no Prometheus scrapes it for UNUSED_S, the next scraped collector takes the lease. The other collectors
have no metrics of the fleet. The scrape does not wait longer than WAIT_S for the database.
"""

import asyncio
import logging
import threading
from collections.abc import Callable
from typing import Final

from prometheus_client import CollectorRegistry, ProcessCollector

from imud.fleet.database.leases import LeaseHolder, LeaseKey, LeaseKind
from imud.fleet.database.overview import FleetSelection, OverviewReader
from imud.fleet.metrics import FleetSnapshot, MetricsPage
from imud.fleet.shares import CollectorStatus
from imud.host.scrape_server import HttpRequest, HttpResponse, ScrapeServer, encoder_for
from imud.model.errors import BadArgument, ImudError
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

REFRESH_S: Final = 15.0  # minimum time between two reads of the database, s
UNUSED_S: Final = 60.0  # time without a scrape after which another collector can read the metrics of the fleet, s
LEASE_S: Final = UNUSED_S + 30.0  # time without a read after which another collector can take the lease, s
LEASE: Final = LeaseKey(LeaseKind.METRICS, "", 0)
WAIT_S: Final = 3.0  # maximum time that a scrape waits for the database, s; the server closes connections after 5 s
POLL_S: Final = 0.02  # interval at which a scrape checks whether the snapshot is ready, s
STATEMENT_S: Final = 10.0  # maximum time of a statement, s; 10,000 gateways with 30 streams need 0.2 s
STALE_S: Final = 60.0  # age after which the page does not contain a snapshot, s
CLOSE_S: Final = 2.0  # maximum time that `close` waits for the thread, s
ABOUT: Final = b"imud fleet collect: metrics for Prometheus are at /metrics\n"
PORT_MAX: Final = 65535


def address_of(text: str) -> tuple[str, int]:
    """Return address and port of HOST:PORT; an IPv6 address can have brackets. Raises BadArgument."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdecimal() and int(port[:6]) <= PORT_MAX):
        raise BadArgument(f"metrics: expected HOST:PORT, for example 127.0.0.1:9322, got {text[:100]!r}")
    return host, int(port)


class FleetGauges:
    """Snapshot of the fleet, read by a thread of its own. Synchronization: one thread calls `start`, `refresh` and
    `close`."""

    def __init__(
        self, url: str, silent_s: float, now_ns: Callable[[], int], *, refresh_s: float = REFRESH_S,
        unused_s: float = UNUSED_S,
    ) -> None:  # fmt: skip
        """`silent_s`: time without a message after which a gateway is silent, s; `now_ns`: CLOCK_MONOTONIC."""
        self._url, self._selection = url, FleetSelection(silent_s=silent_s)
        self._now_ns, self._refresh_ns, self._unused_s = now_ns, round(refresh_s * NS_PER_S), unused_s
        self._reader: OverviewReader | None = None
        self._lease = LeaseHolder(url, LEASE_S)
        self._snapshot: tuple[FleetSnapshot, int] | None = None  # snapshot and its time (CLOCK_MONOTONIC), ns
        self._tried_ns: int | None = None  # time of the last read, ns; None before the first
        self._problem = ""
        self._wanted = threading.Condition()
        self._request: threading.Event | None = None  # request of all scrapes that wait
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="fleet gauges", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def refresh(self) -> threading.Event:
        """Request a snapshot. The event is set when the snapshot is at most REFRESH_S old, or after an error."""
        with self._wanted:
            self._request = self._request or threading.Event()
            self._wanted.notify()
            return self._request

    @property
    def snapshot(self) -> tuple[FleetSnapshot, float] | None:
        """Return the newest snapshot and its age, s; None if another collector reads it, or after STALE_S."""
        found = self._snapshot
        if found is None:
            return None
        age_s = (self._now_ns() - found[1]) / NS_PER_S
        return (found[0], age_s) if age_s < STALE_S else None

    def close(self) -> None:
        """End the thread. A second call does nothing."""
        with self._wanted:
            self._is_closed = True
            self._wanted.notify()
        if self._thread.is_alive():
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while not self._is_closed:
            with self._wanted:
                self._wanted.wait_for(lambda: self._request is not None or self._is_closed, self._unused_s)
                request, self._request = self._request, None
            if request is None:
                self._release()
                continue
            if self._tried_ns is None or self._now_ns() - self._tried_ns >= self._refresh_ns:
                self._tried_ns = self._now_ns()
                self._read()
            request.set()
        self._release()

    def _read(self) -> None:
        """Read a snapshot if no other collector does it."""
        try:
            if self._reader is None:
                self._reader = OverviewReader(self._url, statement_s=STATEMENT_S)
                self._lease.connect()
            if not self._lease.take(LEASE):
                self._snapshot = None
                return
            snapshot = FleetSnapshot(self._reader.groups(self._selection), self._reader.collectors().collectors)
            self._snapshot, self._problem = (snapshot, self._now_ns()), ""
        except ImudError as error:
            self._release()
            if str(error) != self._problem:
                log.warning("cannot read the metrics of the fleet: %s", error)
            self._problem = str(error)

    def _release(self) -> None:
        """Close the connections and thereby release the lease."""
        self._snapshot = None
        self._lease.close()
        if self._reader is not None:
            self._reader.close()
            self._reader = None


class CollectorMetricsServer:
    """HTTP server of the metrics. Synchronization: one thread; the HTTP thread runs `_answer`."""

    def __init__(self, address: str, status: Callable[[], CollectorStatus], gauges: FleetGauges) -> None:
        """`address` is HOST:PORT; any thread calls `status`. Raises BadArgument."""
        self._server = ScrapeServer(*address_of(address), keys=("--metrics", "--metrics"))
        self._gauges = gauges
        self._page = MetricsPage(status)
        self._registry = CollectorRegistry()
        self._registry.register(self._page)
        ProcessCollector(registry=self._registry)

    @property
    def port(self) -> int:
        """Return the bound port."""
        return self._server.port

    def start(self) -> None:
        """Start the server. Raises ServerError if address and port cannot be used."""
        self._server.start(self._answer)
        self._gauges.start()
        log.info("metrics at http://%s:%d/metrics", self._server.address, self.port)

    def close(self) -> None:
        """Stop the server. A second call does nothing."""
        self._server.close()
        self._gauges.close()

    async def _answer(self, request: HttpRequest) -> HttpResponse:
        if request.method not in ("GET", "HEAD"):
            return HttpResponse("405 Method Not Allowed", b"expected GET or HEAD\n")
        if request.path == "/":
            return HttpResponse("200 OK", ABOUT)
        if request.path != "/metrics":
            return HttpResponse("404 Not Found", b"expected /metrics\n")
        ready = self._gauges.refresh()
        for _ in range(round(WAIT_S / POLL_S)):
            if ready.is_set():
                break
            await asyncio.sleep(POLL_S)
        self._page.fleet = self._gauges.snapshot
        encode, content_type = encoder_for(request.accept)
        return HttpResponse("200 OK", encode(self._registry), content_type)
