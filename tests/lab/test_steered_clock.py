"""Time stamps while a real kernel steers CLOCK_MONOTONIC: by frequency (500 ppm) and by the length of its tick (10 %).

The device samples at equal steps of CLOCK_MONOTONIC_RAW. The test interpolates the truth in CLOCK_MONOTONIC between
readings of both clocks around each sample, without code of imud.
"""

import asyncio
import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from time import CLOCK_MONOTONIC_RAW, clock_gettime_ns, monotonic_ns

import pytest

from imud.config.model import DeviceConfig
from imud.device.factory import DeviceFactory
from imud.drivers.hipnuc.uart.codec import HipnucOptions, encode_hi91
from imud.host.clock import HostClock
from imud.links.uart import UartOptions
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns
from imud.utc.system_clock import Timex
from tests.lab.serial_port import PseudoTerminal
from tests.support.device_rig import DeviceOutput

ADJ_FREQUENCY, ADJ_TICK = 0x2, 0x4000
PERIOD_NS = 20 * NS_PER_MS
WIRE_NS = 82 * uart_byte_ns(115_200)
"""Wire time of a frame, ns. A pseudo-terminal has no wire time."""
STEPS = ((6.0, 0, 10_000), (5.0, 500, 10_000), (5.0, -500, 10_000), (3.0, 0, 11_000), (3.0, 0, 9_000), (4.0, 0, 10_000))
"""Steps of (time in s, rate error in ppm, length of a tick in µs). The last steps change the tick by ±10 %."""


def steer(ppm: float, tick_us: int) -> None:
    timex = Timex(modes=ADJ_FREQUENCY | ADJ_TICK, freq=round(ppm * 65536), tick=tick_us)
    if ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex)) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex")


@contextmanager
def steering() -> Iterator[None]:
    try:
        yield
    finally:
        steer(0, 10_000)


def raw_ns() -> int:
    return clock_gettime_ns(CLOCK_MONOTONIC_RAW)


def tight_pair() -> tuple[int, int]:
    """Return CLOCK_MONOTONIC_RAW and CLOCK_MONOTONIC at one instant: the closest pair of some readings."""
    best = None
    for _ in range(5):
        before_ns, raw, after_ns = monotonic_ns(), raw_ns(), monotonic_ns()
        if best is None or after_ns - before_ns < best[0]:
            best = after_ns - before_ns, raw, (before_ns + after_ns) // 2
    assert best is not None
    return best[1], best[2]


class Device:
    def __init__(self, pty: PseudoTerminal) -> None:
        self._pty = pty
        self._begin_ns = raw_ns() - 1000 * PERIOD_NS
        self._number = 1000
        self.pairs: list[tuple[int, int]] = [tight_pair()]

    def step(self) -> None:
        number = (raw_ns() - self._begin_ns - WIRE_NS) // PERIOD_NS
        if number <= self._number:
            return
        self._number = number  # a busy host may miss a reading
        self.pairs.append(tight_pair())
        frame = encode_hi91(
            system_time_ms=self._number * PERIOD_NS // NS_PER_MS, accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0),
            mag_t=(0, 0, 0), euler_rad=(0, 0, 0), quat_wxyz=(1, 0, 0, 0), temperature_c=20, pressure_pa=101_325,
        )  # fmt: skip
        self._pty.write(frame)

    def truth_ns(self, t_dev_ns: int) -> int:
        """Return CLOCK_MONOTONIC at the measurement with this device time, ns."""
        raw = self._begin_ns + t_dev_ns
        for (raw_0, monotonic_0), (raw_1, monotonic_1) in pairwise(self.pairs):
            if raw_0 <= raw < raw_1:
                return monotonic_0 + (raw - raw_0) * (monotonic_1 - monotonic_0) // (raw_1 - raw_0)
        raise AssertionError(f"no reading around {raw}")


@pytest.mark.thorough
async def test_stamps_stay_right_while_the_kernel_steers(pty: PseudoTerminal) -> None:
    output, host = DeviceOutput(), HostClock()
    samples, factory = output.samples, DeviceFactory(output, host)
    settings = UartOptions(port=str(pty.path), baud=115_200)
    runner = factory.make(DeviceConfig("bow", "hipnuc-uart", HipnucOptions(), False, "uart", settings), 1)
    module = Device(pty)
    rates: list[float] = []
    ends = [monotonic_ns()]
    with steering():
        task = asyncio.create_task(runner.run())
        for seconds, ppm, tick_us in STEPS:
            steer(ppm, tick_us)
            end_ns = raw_ns() + int(seconds * NS_PER_S)
            while raw_ns() < end_ns:
                module.step()
                await asyncio.sleep(0.001)
            rates.append(host.steady.rate)
            ends.append(monotonic_ns())
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        runner.close()
        factory.close()
        module.pairs.append(tight_pair())
    expected = [ppm * 1e-6 + tick_us / 10_000 - 1 for _, ppm, tick_us in STEPS]
    assert rates == pytest.approx(expected, abs=20e-6), (rates, expected)
    dated = [(s, module.truth_ns(s.t_dev_ns)) for s in samples if s.t_dev_ns is not None]
    assert len(dated) > 0.8 * sum(seconds for seconds, *_ in STEPS) * NS_PER_S / PERIOD_NS
    medians = []
    for begin_ns, end_ns in pairwise(ends):
        offs = sorted(s.t_ns - truth_ns for s, truth_ns in dated if begin_ns + NS_PER_S < truth_ns < end_ns)
        medians.append(offs[len(offs) // 2])
    print(f"medians {medians} ns, rates {[round(rate * 1e6, 1) for rate in rates]} ppm")
    assert max(medians) - min(medians) < 500_000, medians  # with the steered clock alone, 500 ppm cause 2.5 ms in 5 s
    assert all(a.t_ns < b.t_ns for a, b in pairwise(samples))
    assert all(s.t_ns <= s.t_rx_ns for s in samples)
    utc = [s.utc_ns - s.t_ns for s in samples]
    assert max(utc) - min(utc) < 100_000
