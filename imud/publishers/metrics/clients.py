"""Metrics of the socket's clients, summed: a label per client would make a new time series for every connection."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from imud.contracts.status import ClientStatus

CLIENTS_NAME: Final = "imud_clients"
CLIENTS_HELP: Final = "Clients by the encoding they watch in; none for those that do not watch."
QUEUE_SAMPLES_NAME: Final = "imud_client_queue_samples"
QUEUE_SAMPLES_HELP: Final = "Samples that wait for clients to read them, all clients together."
QUEUE_SAMPLES_MAX_NAME: Final = "imud_client_queue_samples_max"
QUEUE_SAMPLES_MAX_HELP: Final = "Samples that wait for the slowest client."
QUEUE_BYTES_NAME: Final = "imud_client_queue_bytes"
QUEUE_BYTES_HELP: Final = "Bytes that wait for clients to read them, all clients together."
SENT_NAME: Final = "imud_client_samples_sent_total"
SENT_HELP: Final = "Samples given to clients, as seen at scrapes."
DROPPED_NAME: Final = "imud_client_samples_dropped_total"
DROPPED_HELP: Final = "Samples dropped for clients that did not read fast enough, as seen at scrapes."

ENCODINGS: Final = ("json", "binary", "none")


class ClientTotals:
    """Adds up what clients were sent and denied. A sum over the clients of the moment would fall when one leaves."""

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


def client_metrics(clients: Sequence[ClientStatus], totals: ClientTotals) -> Iterator[Metric]:
    """All metrics of clients."""
    encodings = Counter(client.encoding or "none" for client in clients)
    by_encoding = GaugeMetricFamily(CLIENTS_NAME, CLIENTS_HELP, labels=("encoding",))
    for encoding in ENCODINGS:
        by_encoding.add_metric((encoding,), encodings[encoding])
    yield by_encoding
    waiting = [client.queue_samples for client in clients]
    yield GaugeMetricFamily(QUEUE_SAMPLES_NAME, QUEUE_SAMPLES_HELP, value=sum(waiting))
    yield GaugeMetricFamily(QUEUE_SAMPLES_MAX_NAME, QUEUE_SAMPLES_MAX_HELP, value=max(waiting, default=0))
    yield GaugeMetricFamily(QUEUE_BYTES_NAME, QUEUE_BYTES_HELP, value=sum(client.queue_bytes for client in clients))
    yield CounterMetricFamily(SENT_NAME, SENT_HELP, value=totals.sent)
    yield CounterMetricFamily(DROPPED_NAME, DROPPED_HELP, value=totals.dropped)
