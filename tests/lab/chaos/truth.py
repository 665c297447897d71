"""Measurements of simulated devices, in order, and the search for received samples in them.

A device that sends without requests numbers its samples here, also lost samples. The test recognises samples by the
device time, or by their acceleration if they contain no time (`encoded`).
"""

import threading
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from imud.drivers.imu61x.can import encode_set
from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_MS
from imud.sim.can_module import BITRATE, PeriodicCanModule
from imud.sim.physics import Truth
from imud.sim.sensor import Burst, SensorHardware, StreamModule

BASE: Final = 512
"""Base of the number in an acceleration: x contains the lower part, y the upper part."""
STEP_M_S2: Final = 0.01  # acceleration per count of the number


class Measured(NamedTuple):
    sample_ns: int
    """Time of the measurement, CLOCK_MONOTONIC, ns."""
    key: int
    """Device time since power-on, ns, or number of the sample (modulo BASE²)."""


class TruthLog:
    """All samples that a device measured, by number from 0. Synchronization: one thread adds, another thread reads."""

    def __init__(self, key_of: Callable[[Sample], int], tolerance: int) -> None:
        self._measured: list[Measured] = []
        self._lock = threading.Lock()
        self._key_of = key_of
        self._tolerance = tolerance

    def add(self, sample_ns: int, key: int) -> None:
        with self._lock:
            self._measured.append(Measured(sample_ns, key))

    def __len__(self) -> int:
        return len(self._measured)

    def numbers_of(self, samples: Sequence[Sample]) -> list[int | None]:
        with self._lock:
            measured = list(self._measured)
        found: list[int | None] = []
        begin = 0
        for sample in samples:
            number = self._find(measured, begin, sample)
            found.append(number)
            if number is not None:
                begin = number + 1
        return found

    def _find(self, measured: Sequence[Measured], begin: int, sample: Sample) -> int | None:
        """Return the newest sample with the key before the arrival. The device time starts again at a restart."""
        key = self._key_of(sample)
        for number in range(bisect_right(measured, sample.t_rx_ns, key=_instant) - 1, begin - 1, -1):
            if abs(measured[number].key - key) <= self._tolerance:
                return number
        return None


def _instant(measured: Measured) -> int:
    return measured.sample_ns


def time_key(sample: Sample) -> int:
    assert sample.t_dev_ns is not None
    return sample.t_dev_ns


def encoded(number: int) -> Vector3:
    return (number % BASE * STEP_M_S2, number // BASE % BASE * STEP_M_S2, 9.80665)


def decoded(sample: Sample) -> int:
    assert sample.accel_m_s2 is not None
    x, y, _ = sample.accel_m_s2
    return round(x / STEP_M_S2) + BASE * round(y / STEP_M_S2)


class LoggedModule:
    """A device on a byte stream (`StreamModule`). The log contains its bursts in the order of sending."""

    def __init__(self, module: StreamModule, log: Callable[[Burst, int], None], now_ns: int) -> None:
        self._module, self._log, self._power_ns, self._is_on = module, log, now_ns, True
        self.epoch_ns = module.epoch_ns

    @property
    def baud(self) -> int:
        return self._module.baud

    def receive(self, data: bytes, now_ns: int) -> None:
        self._module.receive(data, now_ns)

    def advance(self, now_ns: int) -> list[Burst]:
        bursts = self._module.advance(now_ns)
        if not self._is_on:
            return []
        for burst in bursts:
            self._log(burst, self._power_ns)
        return bursts

    def next_ns(self) -> int | None:
        return self._module.next_ns()

    def counters(self) -> dict[str, int]:
        return self._module.counters()

    def mark(self, now_ns: int) -> None:
        self._module.mark(now_ns)

    def power_off(self, now_ns: int) -> None:
        self.advance(now_ns)
        self._is_on = False

    def reboot(self, now_ns: int) -> None:
        self.advance(now_ns)
        self._module.reboot(now_ns)
        self._power_ns, self._is_on = now_ns, True


def by_device_time(log: TruthLog, period_ns: int) -> Callable[[Burst, int], None]:
    """Return a function that logs the samples in bursts by their device time.

    While this process is stalled, a device drops frames that do not fit into its transmitter. It measured these samples
    too: the log contains them with the next sample.
    """
    newest_key, newest_power_ns = 0, -1

    def add(burst: Burst, power_ns: int) -> None:
        nonlocal newest_key, newest_power_ns
        if burst.sample_ns is None:
            return
        key = burst.sample_ns - power_ns if burst.device_ms is None else burst.device_ms * NS_PER_MS
        dropped = round((key - newest_key) / period_ns) - 1 if power_ns == newest_power_ns else 0
        for back in range(dropped, -1, -1):
            log.add(burst.sample_ns - back * period_ns, key - back * period_ns)
        newest_key, newest_power_ns = key, power_ns

    return add


def numbered_can(clock_ns: Callable[[], int], rate_hz: float, base_id: int, log: TruthLog) -> PeriodicCanModule:
    """Return an IMU61x on CAN with the sample number in its accelerations. `clock_ns` is CLOCK_MONOTONIC."""

    def encode(index: int, reading: Truth) -> Sequence[tuple[int, bytes]]:
        number = len(log)
        log.add(clock_ns(), number % BASE**2)
        return encode_set(
            index=index, accel_m_s2=encoded(number), gyro_rad_s=reading.gyro_rad_s, euler_rad=(0.0, 0.0, 0.0),
            temperature_c=reading.temperature_c, base_id=base_id,
        )  # fmt: skip

    return PeriodicCanModule(clock_ns(), SensorHardware(boot_ms=0, skew_ppm=0.0), rate_hz, BITRATE, encode)
