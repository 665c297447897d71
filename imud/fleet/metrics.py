"""Prometheus metrics of `imud fleet collect`, in the order of the output. docs/fleet-operation.md lists them.

    FleetShares.status ──▶ metrics of this process ──────────────────────────────▶ MetricsPage
    database, at most every REFRESH_S, by one collector of the fleet ──▶ FleetGauges ──▶ MetricsPage

The number of time series has a limit: the labels are `state`, `site` (SITES_MAX values) and `version` (VERSIONS_MAX
values). The gateways of further sites and versions have the label value `other`.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Final, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from imud.fleet.collector import TransactionTimes
from imud.fleet.database.overview import FleetGroup
from imud.fleet.shares import CollectorStatus
from imud.host.log import printable

SITES_MAX: Final = 1000  # maximum number of values of the label `site`
VERSIONS_MAX: Final = 50  # maximum number of values of the label `version`
LABEL_CHARACTERS: Final = 64  # maximum length of a label value; a client of the broker can send any version
OTHER: Final = "other"  # value of `site` and `version` of the gateways above the limits


PREFIX: Final = "imud_fleet_collector_"


class CollectorMetricType(StrEnum):
    """Types of the metrics of a collector."""

    GAUGE = "gauge"
    COUNTER = "counter"
    HISTOGRAM = "histogram"


class CollectorMetric(NamedTuple):
    """Description of one metric."""

    name: str  # name in the text format, including `_total`
    type: CollectorMetricType
    labels: tuple[str, ...]
    help: str


def _gauge(name: str, help_: str, *labels: str) -> CollectorMetric:
    return CollectorMetric(name, CollectorMetricType.GAUGE, labels, help_)


def _counter(name: str, help_: str) -> CollectorMetric:
    return CollectorMetric(name, CollectorMetricType.COUNTER, (), help_)


COLLECTOR_METRICS: Final = (
    _counter("imud_fleet_collector_messages_total", "stored messages and states of gateways"),
    _counter("imud_fleet_collector_rows_total", "stored rows of samples, intervals, events and dropped ranges"),
    _counter("imud_fleet_collector_rejected_total", "messages that could not be decoded or stored"),
    _counter("imud_fleet_collector_duplicates_total", "numbers that arrived again and were not stored again"),
    CollectorMetric(
        "imud_fleet_collector_transaction_seconds", CollectorMetricType.HISTOGRAM, ("le",),
        "histogram of the durations of transactions",
    ),
    _gauge("imud_fleet_collector_waiting_messages", "received messages that are not stored yet"),
    _gauge("imud_fleet_collector_shares", "shares that this collector holds"),
    _gauge("imud_fleet_collector_free_shares", "shares that no collector holds, as this collector sees them"),
    _gauge("imud_fleet_collector_broker_connected", "1 while all shares of this collector have a broker, else 0"),
    _gauge(
        "imud_fleet_collector_database_connected",
        "1 while this collector is connected to the database and each transaction ends within 8 s, else 0",
    ),
    _gauge("imud_fleet_collector_transaction_age_seconds", "duration of the longest transaction that has not ended"),
)  # fmt: skip
FLEET_METRICS: Final = (
    _gauge("imud_fleet_gateways", "gateways by site and state: online, silent or offline", "site", "state"),
    _gauge("imud_fleet_gateways_by_version", "gateways by version of imud", "version"),
    _gauge("imud_fleet_missing_numbers", "numbers that no message contained, although later numbers arrived", "site"),
    _gauge("imud_fleet_dropped_numbers", "numbers that the gateways dropped", "site"),
    _gauge("imud_fleet_backlog_numbers", "numbers in the spools of the gateways", "site"),
    _gauge("imud_fleet_clocks_not_set", "gateways without a synchronized wall clock", "site"),
    _gauge("imud_fleet_newest_message_age_seconds", "time since the newest stored message of all gateways"),
    _gauge("imud_fleet_collectors", "running collectors of all names"),
)


class FleetSnapshot(NamedTuple):
    """State of the fleet at one instant."""

    groups: Sequence[FleetGroup]
    collectors: int  # number of running collectors


def collector_metrics(status: CollectorStatus) -> Iterator[Metric]:
    """Yield the metrics of this process."""
    values: dict[str, float | None] = {
        "messages_total": status.counts.messages,
        "rows_total": status.counts.rows,
        "rejected_total": status.counts.rejected,
        "duplicates_total": status.counts.duplicates,
        "waiting_messages": status.waiting,
        "shares": status.shares,
        "free_shares": status.free_shares,
        "broker_connected": status.broker_connected,
        "database_connected": status.database_connected,
        "transaction_age_seconds": status.write_s,
    }
    for one in COLLECTOR_METRICS:
        if one.type is CollectorMetricType.HISTOGRAM:
            yield _histogram(one, *status.transactions)
        elif (value := values[one.name.removeprefix(PREFIX)]) is not None:
            yield _metric(one, [((), float(value))])


def _histogram(one: CollectorMetric, buckets: Sequence[int], sum_s: float) -> Metric:
    total, cumulative = 0, []
    for bound, number in zip((*map(str, TransactionTimes.BOUNDS_S), "+Inf"), buckets, strict=True):
        total += number
        cumulative.append((bound, total))
    return HistogramMetricFamily(one.name, one.help, buckets=cumulative, sum_value=sum_s)


def _metric(one: CollectorMetric, lines: Iterable[tuple[tuple[str, ...], float]]) -> Metric:
    make = CounterMetricFamily if one.type is CollectorMetricType.COUNTER else GaugeMetricFamily
    metric = make(one.name, one.help, labels=one.labels)
    for labels, value in lines:
        metric.add_metric(labels, value)
    return metric


def fleet_metrics(snapshot: FleetSnapshot, age_s: float = 0.0) -> Iterator[Metric]:
    """Yield the metrics of the fleet. `age_s`: time since the snapshot, s."""
    groups = snapshot.groups
    site_of = _limited(groups, lambda group: group.site, SITES_MAX)
    version_of = _limited(groups, lambda group: group.version, VERSIONS_MAX)

    def by_site(read: Callable[[FleetGroup], int]) -> Counter[tuple[str, ...]]:
        return _sums(((site_of[group.site],), read(group)) for group in groups)

    states = ("online", "silent", "offline")
    newest = [group.newest_s for group in groups]
    lines: dict[str, Mapping[tuple[str, ...], float]] = {
        "imud_fleet_gateways": _sums(
            ((site_of[group.site], state), getattr(group, state)) for group in groups for state in states
        ),
        "imud_fleet_gateways_by_version": _sums(((version_of[group.version],), group.gateways) for group in groups),
        "imud_fleet_missing_numbers": by_site(lambda group: group.missing),
        "imud_fleet_dropped_numbers": by_site(lambda group: group.dropped),
        "imud_fleet_backlog_numbers": by_site(lambda group: group.in_spool),
        "imud_fleet_clocks_not_set": by_site(lambda group: group.clock_not_set),
        "imud_fleet_newest_message_age_seconds": {(): min(newest) + age_s} if newest else {},
        "imud_fleet_collectors": {(): snapshot.collectors},
    }
    for one in FLEET_METRICS:
        if lines[one.name]:
            yield _metric(one, lines[one.name].items())


def _sums(numbers: Iterable[tuple[tuple[str, ...], int]]) -> Counter[tuple[str, ...]]:
    found = Counter[tuple[str, ...]]()
    for key, number in numbers:
        found[key] += number
    return found


def _limited(groups: Sequence[FleetGroup], name: Callable[[FleetGroup], str], most: int) -> dict[str, str]:
    """Return the label value of each name: the name for the `most` names with the most gateways, otherwise OTHER."""
    counts = Counter[str]()
    for group in groups:
        counts[name(group)] += group.gateways
    order = sorted(counts, key=lambda one: (-counts[one], one))
    return {one: printable(one, LABEL_CHARACTERS) if place < most else OTHER for place, one in enumerate(order)}


class MetricsPage(Collector):
    """Metrics of a page. Synchronization: one thread at a time."""

    def __init__(self, status: Callable[[], CollectorStatus]) -> None:
        """Any thread calls `status`."""
        self._status = status
        self.fleet: tuple[FleetSnapshot, float] | None = None  # snapshot and its age, s; None: no metrics of the fleet

    def describe(self) -> list[Metric]:
        """Return an empty list. Otherwise the registry would render all metrics for the description."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        yield from collector_metrics(self._status())
        if self.fleet is not None:
            yield from fleet_metrics(*self.fleet)
