"""Duration of detection in simulated time, at every baud rate and at random phases.

The search knows neither the driver nor the baud rate, so it tries all families. The device sends at 100 Hz, or at the
maximum rate of the serial port at 9600 baud. The simulation models each bit, so a wrong baud rate delivers realistic
garbage. `quick` uses fewer phases.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from statistics import quantiles

from imud.contracts.driver import StreamDriver
from imud.device.stream_search import Search, StreamFound
from imud.drivers.hipnuc.uart.codec import encode_hi91
from imud.drivers.hipnuc.uart.driver import DRIVER as HIPNUC
from imud.drivers.imu61x.uart.codec import Status, encode_status
from imud.drivers.imu61x.uart.commands import ask_status
from imud.drivers.imu61x.uart.driver import DRIVER as IMU61X
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.bench.rows import Row, at_most
from tests.support.uart_wire import FakeDevice, run_search

COLD_S = 2.0  # goal without a remembered driver
REMEMBERED_S = 0.3  # goal with the remembered driver and baud rate
# latency timers of the adapters: without an adapter, and an FT232 by default
HOLDS_MS = (0, 16)


def random_hi91(random: Random) -> bytes:
    def three(scale: float) -> tuple[float, float, float]:
        return (random.gauss(0, scale), random.gauss(0, scale), random.gauss(0, scale))

    return encode_hi91(
        system_time_ms=random.randrange(1 << 32), accel_m_s2=three(9.8), gyro_rad_s=three(0.01), mag_t=three(5e-5),
        euler_rad=three(1.0), quat_wxyz=(1.0, *three(0.1)), temperature_c=25.0, pressure_pa=random.gauss(101_325, 10),
    )  # fmt: skip


@dataclass(frozen=True)
class Family:
    """A driver, the stream of its devices with factory settings, and their reply to the identity request."""

    driver: StreamDriver
    make_frame: Callable[[Random], bytes]
    query: bytes
    reply: bytes


FAMILIES = (
    Family(HIPNUC, random_hi91, b"LOG VERSION\r\n", b"PNAME=HI14R3\r\nAPP_VER=156\r\nOK\r\n"),
    Family(
        IMU61X, IMU61X.example_frame, ask_status().payload,
        encode_status(Status(10203, 2, 614, (1, 2, 3), 0, 0, 0, 0, 0, 0, 0, bytes(32))),
    ),
)  # fmt: skip
DRIVERS = [family.driver for family in FAMILIES]


def measure(family: Family, baud: int, hold_ms: int, phases: int, *, remembered: bool) -> tuple[list[float], int]:
    """Return the times until detection, s, and the number of searches with a wrong result or without a result."""
    driver = family.driver
    random = Random(f"{baud} {hold_ms} {remembered}")
    # an adapter without a timer is polled every 1 ms
    poll_ns = max(hold_ms, 1) * NS_PER_MS
    far = FakeDevice(driver, baud, 100, poll_ns=poll_ns, random=random, make_frame=family.make_frame)
    times_s, wrong = [], 0
    for _ in range(phases):
        # the start of the search relative to the device's frames is random
        far.phase_ns = random.randrange(NS_PER_S)
        memory = (driver.name, baud) if remembered else None
        search = Search(DRIVERS, remembered=memory, may_ask=True, hold_ns=hold_ms * NS_PER_MS)
        found, took_ns, _ = run_search(search, far, start_ns=10 * NS_PER_S + random.randrange(NS_PER_S))
        times_s.append(took_ns / NS_PER_S)
        wrong += not isinstance(found, StreamFound) or (found.driver, found.baud) != (driver, baud)
    return times_s, wrong


def measure_rare(family: Family, rate_hz: float, phases: int) -> tuple[list[float], int]:
    """Return the detection times at `rate_hz` and random baud rates, s, and the number of failures.

    If `rate_hz` is 0, the device only replies to requests.
    """
    driver, random = family.driver, Random(f"{rate_hz}")
    times_s, wrong = [], 0
    for _ in range(phases):
        baud = random.choice(driver.baud_rates)
        far = FakeDevice(
            driver, baud, rate_hz, random.randrange(NS_PER_S), random=random, make_frame=family.make_frame,
            query=family.query, reply=family.reply,
        )  # fmt: skip
        found, took_ns, _ = run_search(Search(DRIVERS, may_ask=True), far, start_ns=10 * NS_PER_S)
        times_s.append(took_ns / NS_PER_S)
        wrong += not isinstance(found, StreamFound) or (found.driver, found.baud) != (driver, baud)
    return times_s, wrong


def rows(*, quick: bool = False) -> Iterator[Row]:
    phases = 100 if quick else 1000
    failed = 0
    for family in FAMILIES:
        for remembered, limit_s in ((False, COLD_S), (True, REMEMBERED_S)):
            for hold_ms in HOLDS_MS:
                how = f"{family.driver.name} {'remembered' if remembered else 'cold'}, {hold_ms} ms adapter"
                everything: list[float] = []
                for baud in sorted(family.driver.baud_rates):
                    times_s, wrong = measure(family, baud, hold_ms, phases, remembered=remembered)
                    failed += wrong
                    everything += times_s
                    yield at_most(f"detect {how}, {baud} baud, p95", quantiles(times_s, n=20)[-1], "s", limit_s)
                yield Row(f"detect {how}, all rates, p50", quantiles(everything, n=2)[0], "s")
                yield at_most(f"detect {how}, all rates, p95", quantiles(everything, n=20)[-1], "s", limit_s)
                yield at_most(f"detect {how}, all rates, max", max(everything), "s", limit_s)
        for name, rate_hz in (("10 Hz", 10), ("1 Hz", 1), ("silent, on request", 0)):
            times_s, wrong = measure_rare(family, rate_hz, phases // 5)
            failed += wrong
            yield Row(f"detect {family.driver.name} cold, {name}, p50", quantiles(times_s, n=2)[0], "s")
            yield Row(f"detect {family.driver.name} cold, {name}, p95", quantiles(times_s, n=20)[-1], "s")
    yield at_most("detect: searches without a result or with a wrong result", failed, "", 0)
