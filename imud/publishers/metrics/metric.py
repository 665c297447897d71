"""Descriptions of metrics: name, type, unit, help, labels, and how the values are read from the snapshot of a scrape.

A `Reader` has the names of the labels and gives the values. Those of devices come from a `DevicePart`: it finds the
record that the values are in, and leaves out devices that have none, because absent is not zero.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final, Generic, TypeVar

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)

from imud.contracts.status import ClientStatus, DeviceStatus, FlightStatus, MqttStatus, OutputStatus, RecorderStatus
from imud.model.units import NS_PER_S, PPM_PER_ONE
from imud.publishers.metrics.rings import RingView

T = TypeVar("T")

Lines = Iterable[tuple[tuple[str, ...], float]]
"""Values of the labels, and the value."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Contents of one scrape, all of one moment of the event loop."""

    devices: Sequence[DeviceStatus] = ()
    clients: Sequence[ClientStatus] = ()
    events: Sequence[tuple[tuple[str, str], int]] = ()
    """Events so far, by device and kind."""
    heartbeat_age_ns: int = 0
    log_messages_dropped: int = 0
    client_samples_sent: int = 0
    """Samples sent to clients, those that disconnected included, as seen at scrapes."""
    client_samples_dropped: int = 0
    rings: Mapping[str, str] = field(default_factory=dict)
    """Path of the ring by device; empty where there is none though there should be."""
    views: Mapping[str, RingView] = field(default_factory=dict)
    """What was found in these rings."""
    recorders: Sequence[RecorderStatus] = ()
    """One while there is a recorder."""
    flights: Sequence[FlightStatus] = ()
    """One while there is a flight recorder."""
    outputs: Sequence[OutputStatus] = ()
    """Ways out of outputs that send sentences."""
    mqtts: Sequence[MqttStatus] = ()
    """One while there is the output `mqtt`."""


@dataclass(frozen=True, slots=True)
class Unit:
    """The unit of a metric."""

    name: str
    """The end of the metric's name, in front of `_total`; empty for numbers without a unit."""
    divisor: float = 1
    """Turns the values that are read into this unit."""


NO_UNIT: Final = Unit("")
BYTES: Final = Unit("bytes")
CELSIUS: Final = Unit("celsius")
HERTZ: Final = Unit("hertz")
RADIANS: Final = Unit("radians")
ACCELERATION: Final = Unit("meters_per_second_squared")
RATIO: Final = Unit("ratio", PPM_PER_ONE)
SECONDS: Final = Unit("seconds", NS_PER_S)


class MetricType(StrEnum):
    """Types of metrics with one value per set of labels, by their names in OpenMetrics."""

    GAUGE = "gauge"
    COUNTER = "counter"
    INFO = "info"
    """Always 1; the information is in the labels."""


_MAKE: Final[Mapping[MetricType, Callable[..., Any]]] = {
    MetricType.GAUGE: GaugeMetricFamily,
    MetricType.COUNTER: CounterMetricFamily,
    MetricType.INFO: InfoMetricFamily,
}


@dataclass(frozen=True, slots=True)
class Reader:
    """Reader of the values of one metric."""

    labels: tuple[str, ...]
    lines: Callable[[Snapshot], Lines]


@dataclass(frozen=True, slots=True)
class Family:
    """The description of one metric."""

    name: str
    """Name in the text format, `_total` and `_info` included."""
    type: MetricType
    unit: Unit
    help: str
    reader: Reader

    def metric(self, snapshot: Snapshot) -> Metric:
        """The metric with its values."""
        info, divisor = self.type is MetricType.INFO, self.unit.divisor
        metric: Metric = _MAKE[self.type](self.name.removesuffix("_info"), self.help, labels=self.reader.labels)
        add = metric.add_metric  # type: ignore[attr-defined]  # all three have it
        for labels, value in self.reader.lines(snapshot):
            add(labels, {} if info else value / divisor)
        return metric


@dataclass(frozen=True, slots=True)
class Histogram:
    """The description of one histogram over times in ns, shown in seconds, with the label `device`."""

    name: str
    help: str
    bounds_ns: Sequence[int]
    """Upper bounds of the buckets; one without bound follows."""
    read: Callable[[DeviceStatus], tuple[Sequence[int], int]]
    """Values per bucket, the unbounded last included, and the sum of all in ns."""

    def metric(self, snapshot: Snapshot) -> Metric:
        """The metric with its values; its counts are cumulative, as Prometheus has them."""
        bounds = (*(str(bound / SECONDS.divisor) for bound in self.bounds_ns), "+Inf")
        metric = HistogramMetricFamily(self.name, self.help, labels=("device",))
        for device in snapshot.devices:
            counts, sum_ns = self.read(device)
            total, buckets = 0, []
            for bound, count in zip(bounds, counts, strict=True):
                total += count
                buckets.append((bound, total))
            metric.add_metric((device.name,), buckets, sum_ns / SECONDS.divisor)
        return metric


Parts = Iterable[tuple[str, T | None]]
"""The name of each device and a record of it; None for a device without it: its metrics are absent."""


@dataclass(frozen=True, slots=True)
class DevicePart(Generic[T]):
    """A record of each device; the label `device` of its values is the device's name."""

    find: Callable[[Snapshot], Parts[T]]

    def one(self, read: Callable[[T], float | None]) -> Reader:
        """Reads one value without further labels; absent where it is None."""

        def lines(snapshot: Snapshot) -> Iterator[tuple[tuple[str], float]]:
            for name, part in self.find(snapshot):
                value = None if part is None else read(part)
                if value is not None:
                    yield (name,), value

        return Reader(("device",), lines)

    def by(self, label: str, read: Callable[[T], Mapping[str, float]]) -> Reader:
        """Reads values by one further label."""

        def lines(snapshot: Snapshot) -> Iterator[tuple[tuple[str, str], float]]:
            for name, part in self.find(snapshot):
                if part is not None:
                    for key, value in read(part).items():
                        yield (name, key), value

        return Reader(("device", label), lines)


def status_part(find: Callable[[DeviceStatus], T | None]) -> DevicePart[T]:
    """A record that `find` finds in the status of a device."""
    return DevicePart(lambda snapshot: ((device.name, find(device)) for device in snapshot.devices))


def daemon(read: Callable[[Snapshot], float]) -> Reader:
    """Reads one value of the daemon, without labels."""
    return Reader((), lambda snapshot: (((), read(snapshot)),))


def each(find: Callable[[Snapshot], Sequence[T]], read: Callable[[T], float]) -> Reader:
    """Reads one value, without labels, of an output of which there is one or none."""
    return Reader((), lambda snapshot: [((), read(status)) for status in find(snapshot)])
