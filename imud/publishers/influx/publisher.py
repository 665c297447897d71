"""Output `influx`: samples, ledgers and events of devices as line protocol.

batch ─▶ rate_hz ─▶ lines ─▶ each destination
"""

import logging
import socket
from collections.abc import Callable
from typing import Final

from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import OutputStatus
from imud.formats.influx import DistinctTimes, event_fields, head, ledger_line, line, sample_fields
from imud.host.http_post import HttpPost, PostAccess, post_url
from imud.host.threads import BusThread, StartWorker
from imud.model.event import Event
from imud.model.units import NS_PER_S
from imud.publishers.influx.destinations import (
    Destination,
    FileDelivery,
    HttpDelivery,
    LineDelivery,
    QueuedDestination,
    TcpDelivery,
    UdpDestination,
)
from imud.publishers.influx.settings import (
    MEGABYTE,
    DestinationOptions,
    InfluxOptions,
    file_path,
    socket_address,
)
from imud.publishers.thinning import Pace

log = logging.getLogger(__name__)

WHO: Final = "influx"  # name of this output
LATENCY_NS: Final = NS_PER_S // 10  # maximum hold of samples, ns: databases show seconds
# Maximum wait at the end for the last lines of all destinations, ns. A stop of imud takes at most 1 s.
CLOSE_NS: Final = NS_PER_S // 2


class InfluxOutput:
    """Output of lines. Synchronization: the event loop's thread only."""

    def __init__(
        self, settings: InfluxOptions, context: PublisherContext, start_worker: StartWorker = BusThread,
        host_name: Callable[[], str] = socket.gethostname,
    ) -> None:  # fmt: skip
        self._settings, self._context, self._start_worker = settings, context, start_worker
        self._tags = {"site": settings.site, "gateway": settings.gateway or host_name().partition(".")[0]}
        self._series: dict[str, str] = {}  # measurement and tags of the samples of each selected device
        self._paces: dict[str, Pace] = {}
        self._newest_ns: dict[str, int] = {}
        self._times = DistinctTimes()
        self._ledger_due_ns = 0
        self.destinations: list[Destination] = []

    def start(self) -> None:
        """Start the threads. A missing receiver is a problem in the status, and imud tries again."""
        for url, options in self._settings.to.items():
            self.destinations.append(self._destination(url, options))
        self._context.outputs.ports[WHO] = self.status

    def add_device(self, name: str, _device_id: int) -> None:
        """Add a device if it is selected."""
        wanted = self._settings.devices
        if wanted is None or name in wanted:
            self._series[name] = head("imud_sample", {**self._tags, "device": name})
            if self._settings.rate_hz is not None:
                self._paces[name] = Pace(self._settings.rate_hz)
            self._context.latencies.ask(WHO, LATENCY_NS, tuple(self._series))

    def remove_device(self, name: str) -> None:
        for known in (self._series, self._paces, self._newest_ns):
            known.pop(name, None)
        if self._series:
            self._context.latencies.ask(WHO, LATENCY_NS, tuple(self._series))
        else:
            self._context.latencies.release(WHO)

    def publish(self, batch: Batch) -> None:
        """Send the selected samples of a batch."""
        series = self._series.get(batch.device)
        if series is None:
            return
        chosen = batch.samples
        pace = self._paces.get(batch.device)
        if pace is not None:
            times_ns, before_ns = batch.times_ns, self._newest_ns.get(batch.device, 0)
            self._newest_ns[batch.device] = times_ns[-1]
            if times_ns[-1] < pace.due_ns:
                return
            steps_ns = [t_ns - last for t_ns, last in zip(times_ns, (before_ns, *times_ns), strict=False)]
            chosen = [one for one, step_ns in zip(chosen, steps_ns, strict=True) if pace.is_due(one.t_ns, step_ns)]
        self._send([line(series, sample_fields(one), one.utc_ns) for one in chosen])

    def event(self, event: Event) -> None:
        """Send an event of a selected device, or of the daemon."""
        if event.device and event.device not in self._series:
            return
        series = head("imud_event", {**self._tags, "device": event.device, "kind": event.kind.value})
        utc_ns = self._times.at(series, event.t_ns + self._context.clock.utc_offset_ns())
        self._send([line(series, event_fields(event), utc_ns)])

    def tick(self, now_ns: int) -> None:
        """Send the ledgers that are due, and batches that are old enough."""
        if now_ns >= self._ledger_due_ns:
            self._ledger_due_ns = now_ns + round(self._settings.ledger_s * NS_PER_S)
            utc_ns = now_ns + self._context.clock.utc_offset_ns()
            found = self._context.devices.ledgers()
            self._send([
                ledger_line(head("imud_ledger", {**self._tags, "device": name}), counts, utc_ns)
                for name, _, counts in found if name in self._series
            ])  # fmt: skip
        for one in self.destinations:
            one.tick(now_ns)

    def close(self) -> None:
        """Deliver the last lines to receivers that reply within CLOSE_NS. A second call does nothing."""
        self._context.outputs.ports.pop(WHO, None)
        self._context.latencies.release(WHO)
        for destination in self.destinations:
            destination.finish()
        end_ns = self._context.clock.now_ns() + CLOSE_NS
        for destination in self.destinations:
            if isinstance(destination, QueuedDestination):
                destination.wait(max(end_ns - self._context.clock.now_ns(), 0) / NS_PER_S)
                destination.stop()
        for destination in self.destinations:
            destination.close()
        self.destinations.clear()

    def status(self) -> list[OutputStatus]:
        """Return the state of each destination."""
        return [one.status() for one in self.destinations]

    def _send(self, lines: list[str]) -> None:
        if lines:
            text, now_ns = "".join(lines).encode(errors="replace"), self._context.clock.now_ns()
            for one in self.destinations:
                one.put(text, len(lines), now_ns)

    def _destination(self, url: str, options: DestinationOptions) -> Destination:
        address = socket_address(url, "udp")
        if address is not None:
            return UdpDestination(url, address)
        settings = self._settings
        limits = round(settings.queue_mb * MEGABYTE), round(settings.batch_s * NS_PER_S)
        now_ns = self._context.clock.now_ns
        destination = QueuedDestination(url, delivery_of(url, options, now_ns), limits, now_ns, self._start_worker)
        destination.start()
        return destination


def delivery_of(url: str, options: DestinationOptions, now_ns: Callable[[], int]) -> LineDelivery:
    """Return the transport for a valid URL, except UDP."""
    if (path := file_path(url)) is not None:
        return FileDelivery(path, round(options.file_mb * MEGABYTE), options.files)
    if (address := socket_address(url, "tcp")) is not None:
        return TcpDelivery(address, now_ns)
    target = post_url(url)
    assert target is not None, url  # InfluxOptions checked it
    access = PostAccess(options.token_file, options.ca_file)
    return HttpDelivery(HttpPost(target, access, now_ns, compress=options.gzip))
