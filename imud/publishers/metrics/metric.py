"""Descriptions of metrics: name, type, unit, help text, labels, and a reader of the values.

A `Reader` contains the label names and returns the values of a snapshot. A `DevicePart` finds the record of a value in
the status of each device. It omits devices without this record, because absent is not zero.
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

from imud.contracts.status import (
    ClientStatus,
    DeviceStatus,
    FlightStatus,
    MqttStatus,
    OutputStatus,
    RecorderStatus,
    RulesStatus,
)
from imud.model.units import NS_PER_S, PPM_PER_ONE
from imud.publishers.metrics.rings import RingView

T = TypeVar("T")

Lines = Iterable[tuple[tuple[str, ...], float]]  # label values and value of each time series


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Content of one scrape, from one turn of the event loop."""

    devices: Sequence[DeviceStatus] = ()
    clients: Sequence[ClientStatus] = ()
    events: Sequence[tuple[tuple[str, str], int]] = ()  # number of events by device and kind
    heartbeat_age_ns: int = 0
    log_messages_dropped: int = 0
    # Number of samples sent to all clients until the scrape, including disconnected clients
    client_samples_sent: int = 0
    client_samples_dropped: int = 0
    # Path of the ring of each device; empty if imud could not create it
    rings: Mapping[str, str] = field(default_factory=dict)
    views: Mapping[str, RingView] = field(default_factory=dict)  # content of the rings
    recorders: Sequence[RecorderStatus] = ()  # state of the recorder, if it runs
    flights: Sequence[FlightStatus] = ()  # state of the flight recorder, if it runs
    # States of the ports of outputs, by the name of the output
    ports: Mapping[str, Sequence[OutputStatus]] = field(default_factory=dict)
    mqtts: Sequence[MqttStatus] = ()  # state of the output `mqtt`, if it runs
    rules: Sequence[RulesStatus] = ()  # state of the output `rules`, if it runs


@dataclass(frozen=True, slots=True)
class Unit:
    """Unit of a metric."""

    name: str  # suffix of the metric name before `_total`; empty for numbers without a unit
    divisor: float = 1  # divisor that converts a value into this unit


NO_UNIT: Final = Unit("")
BYTES: Final = Unit("bytes")
CELSIUS: Final = Unit("celsius")
HERTZ: Final = Unit("hertz")
RADIANS: Final = Unit("radians")
ACCELERATION: Final = Unit("meters_per_second_squared")
RATIO: Final = Unit("ratio", PPM_PER_ONE)
SECONDS: Final = Unit("seconds", NS_PER_S)


class MetricType(StrEnum):
    """Metric types with one value per set of labels, by their OpenMetrics names."""

    GAUGE = "gauge"
    COUNTER = "counter"
    INFO = "info"  # value is always 1; the labels contain the information


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
    """Description of one metric."""

    name: str  # name in the text format, including `_total` and `_info`
    type: MetricType
    unit: Unit
    help: str
    reader: Reader

    def metric(self, snapshot: Snapshot) -> Metric:
        """Return the metric with its values."""
        info, divisor = self.type is MetricType.INFO, self.unit.divisor
        metric: Metric = _MAKE[self.type](self.name.removesuffix("_info"), self.help, labels=self.reader.labels)
        add = metric.add_metric  # type: ignore[attr-defined]  # all three classes have this method
        for labels, value in self.reader.lines(snapshot):
            add(labels, {} if info else value / divisor)
        return metric


@dataclass(frozen=True, slots=True)
class Histogram:
    """Description of a histogram of times, ns, with the label `device`. The output is in seconds."""

    name: str
    help: str
    bounds_ns: Sequence[int]  # Upper bounds of the buckets. The last bucket has no bound.
    # Returns the number of values per bucket and the sum of all values, ns
    read: Callable[[DeviceStatus], tuple[Sequence[int], int]]

    def metric(self, snapshot: Snapshot) -> Metric:
        """Return the metric with cumulative counts, as Prometheus requires."""
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


# Name and record of each device. None if the device has no such record: its metrics are then absent.
Parts = Iterable[tuple[str, T | None]]


@dataclass(frozen=True, slots=True)
class DevicePart(Generic[T]):
    """Record of each device. The value of the label `device` is the device name."""

    find: Callable[[Snapshot], Parts[T]]

    def one(self, read: Callable[[T], float | None]) -> Reader:
        """Return a reader of one value without further labels; absent if the value is None."""

        def lines(snapshot: Snapshot) -> Iterator[tuple[tuple[str], float]]:
            for name, part in self.find(snapshot):
                value = None if part is None else read(part)
                if value is not None:
                    yield (name,), value

        return Reader(("device",), lines)

    def by(self, label: str, read: Callable[[T], Mapping[str, float]]) -> Reader:
        """Return a reader of values with one further label."""

        def lines(snapshot: Snapshot) -> Iterator[tuple[tuple[str, str], float]]:
            for name, part in self.find(snapshot):
                if part is not None:
                    for key, value in read(part).items():
                        yield (name, key), value

        return Reader(("device", label), lines)


def status_part(find: Callable[[DeviceStatus], T | None]) -> DevicePart[T]:
    """Return the part of the record that `find` returns for the status of a device."""
    return DevicePart(lambda snapshot: ((device.name, find(device)) for device in snapshot.devices))


def daemon(read: Callable[[Snapshot], float]) -> Reader:
    """Return a reader of one value of the daemon, without labels."""
    return Reader((), lambda snapshot: (((), read(snapshot)),))


def each(find: Callable[[Snapshot], Sequence[T]], read: Callable[[T], float]) -> Reader:
    """Return a reader of one value without labels, of an output that exists once or not at all."""
    return Reader((), lambda snapshot: [((), read(status)) for status in find(snapshot)])
