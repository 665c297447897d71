"""What a metric of devices is: name, help, labels, and how it is read from a device's status."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from imud.contracts.status import DeviceStatus
from imud.units import NS_PER_S

T = TypeVar("T")

Labelled = Iterable[tuple[tuple[str, ...], float]]
"""Label values (besides `device`) and value."""
DeviceReader = Callable[[DeviceStatus], Labelled]
"""Reads the values of one metric from one device."""


@dataclass(frozen=True, slots=True)
class Family:
    """One metric of every device."""

    name: str
    """As it stands in the text, `_total` included."""
    help: str
    labels: tuple[str, ...]
    """Labels besides `device`."""
    read: DeviceReader

    def metric(self, devices: Sequence[DeviceStatus]) -> Metric:
        """The metric with its samples."""
        make = CounterMetricFamily if self.name.endswith("_total") else GaugeMetricFamily
        family = make(self.name, self.help, labels=("device", *self.labels))
        for device in devices:
            for labels, value in self.read(device):
                family.add_metric((device.name, *labels), value)
        return family


def one(read: Callable[[DeviceStatus], float | None]) -> DeviceReader:
    """A value without labels; absent where the device has none, because absent is not zero."""

    def labelled(device: DeviceStatus) -> Labelled:
        value = read(device)
        return () if value is None else (((), value),)

    return labelled


def seconds(read: Callable[[DeviceStatus], int]) -> DeviceReader:
    """A time in ns, shown in seconds."""
    return one(lambda device: read(device) / NS_PER_S)


def part(get: Callable[[DeviceStatus], T | None], read: Callable[[T], float | None]) -> DeviceReader:
    """A value of what only some devices have: absent where `get` gives None."""

    def value(device: DeviceStatus) -> float | None:
        found = get(device)
        return None if found is None else read(found)

    return one(value)


def part_labelled(get: Callable[[DeviceStatus], T | None], read: Callable[[T], Labelled]) -> DeviceReader:
    """The same with labels."""

    def labelled(device: DeviceStatus) -> Labelled:
        found = get(device)
        return () if found is None else read(found)

    return labelled
