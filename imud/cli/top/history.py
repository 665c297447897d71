"""What `imud top` keeps of each device: its newest status, its samples of the last while."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

from imud.contracts.status import DeviceStatus
from imud.sample import Sample, Vector3
from imud.units import NS_PER_S, RAD_PER_DEG, T_PER_UT

POINTS_MAX: Final = 1200
"""Samples kept of a device: a minute at 20 Hz."""
SPAN_NS: Final = 60 * NS_PER_S
"""Older samples are not shown."""


class Curve(NamedTuple):
    """One value over time that the page of a device shows."""

    name: str
    unit: str
    value: Callable[[Sample], float | None]
    """Its value in a sample in that unit; None where the sample has none."""


def _part(member: str, index: int, unit: float) -> Callable[[Sample], float | None]:
    def value(sample: Sample) -> float | None:
        vector: Sequence[float] | None = getattr(sample, member)
        return None if vector is None or not math.isfinite(vector[index]) else vector[index] / unit

    return value


CURVES: Final = (
    *(Curve(name, "°", _part("euler_rad", index, RAD_PER_DEG)) for index, name in enumerate(("roll", "pitch", "yaw"))),
    *(Curve(f"accel {axis}", "m/s²", _part("accel_m_s2", index, 1.0)) for index, axis in enumerate("xyz")),
    *(Curve(f"gyro {axis}", "°/s", _part("gyro_rad_s", index, RAD_PER_DEG)) for index, axis in enumerate("xyz")),
    *(Curve(f"mag {axis}", "µT", _part("mag_t", index, T_PER_UT)) for index, axis in enumerate("xyz")),
)
"""Rows of a device's page, in their order."""


class Series(NamedTuple):
    """A curve and what came of it."""

    curve: Curve
    values: list[float]
    """Oldest first; empty where the device does not send it."""


class DeviceHistory:
    """One device."""

    def __init__(self, status: DeviceStatus) -> None:
        self.status = status
        self._samples: deque[Sample] = deque(maxlen=POINTS_MAX)

    @property
    def newest(self) -> Sample | None:
        """The newest sample; None before the first."""
        return self._samples[-1] if self._samples else None

    def add(self, sample: Sample) -> None:
        """Keep a sample; one that is older than the newest begins the history anew: the daemon was restarted."""
        samples = self._samples
        if samples and sample.t_ns < samples[-1].t_ns:
            samples.clear()
        samples.append(sample)
        while samples[0].t_ns < sample.t_ns - SPAN_NS:
            samples.popleft()

    def series(self) -> list[Series]:
        """All curves, in the order of CURVES."""
        found = []
        for curve in CURVES:
            values = (curve.value(sample) for sample in self._samples)
            found.append(Series(curve, [value for value in values if value is not None]))
        return found


class DeviceHistories:
    """All devices of a daemon, by name, in the order of its configuration."""

    def __init__(self) -> None:
        self.devices: dict[str, DeviceHistory] = {}
        self.now_ns = 0
        """CLOCK_MONOTONIC of the newest news."""
        self.clients = 0
        """Connected to the daemon, this one included."""

    def update(self, statuses: Iterable[DeviceStatus], clients: int) -> None:
        """Take a status of all devices; one that is not in it any more is forgotten."""
        before, self.devices = self.devices, {}
        for status in statuses:
            device = before.get(status.name)
            if device is None:
                device = DeviceHistory(status)
            device.status = status
            self.devices[status.name] = device
        self.clients = clients

    def add(self, sample: Sample) -> None:
        """Take a sample; one of a device that no status had yet is left out."""
        device = self.devices.get(sample.device)
        if device is not None:
            device.add(sample)


def norm(vector: Vector3 | None) -> float | None:
    """Length of a vector; None for none, or where it is not finite."""
    if vector is None:
        return None
    length = math.hypot(*vector)
    return length if math.isfinite(length) else None
