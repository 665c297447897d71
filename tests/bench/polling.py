"""SPI burst reads at 1 kHz through the path of the daemon: jitter, missed deadlines, CPU time per sample.

Bus thread, link, codec, clock and batch are real; only the ioctl is simulated. The simulated ioctl copies a burst from
memory. It uses `time.sleep` for the duration of the transfer at 2 MHz, and other threads run in this time, like during
the real ioctl. With a data-ready line, the edges arrive through a pipe. The delay then includes the path through the
kernel and the event loop to the bus thread.
"""

import asyncio
import ctypes
import errno
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import imud.links.spi as spi_link
from imud.config.model import DeviceConfig
from imud.contracts.lines import DeviceLines, LineFactory, ReadyOptions
from imud.contracts.link import LinkType
from imud.device.factory import DeviceFactory
from imud.drivers.imu61x import spi
from imud.drivers.imu61x.spi import PIPELINE_BYTES
from imud.host.clock import HostClock
from imud.links.spi import SpiLink, SpiOptions
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.ports.pins import MemoryOutput
from tests.bench.ready_line import PipeInput
from tests.bench.rows import Row, at_most
from tests.support.device_rig import DeviceOutput

RATE_HZ = 1000.0
BURST_BYTES = 32  # a standard burst: 16 words
WIRE_S = BURST_BYTES * 8 / 2e6
"""Duration of a standard burst at 2 MHz, s."""
PREPARED = 512  # number of prepared bursts


class Stub:
    def __init__(self, wire_s: float) -> None:
        self._device = Imu61xRegisters(time.monotonic_ns)
        self._wire_s = wire_s
        self._bursts = [self._burst(n) for n in range(PREPARED)]
        self._next = 0

    def _burst(self, number: int) -> bytes:
        x = 0.001 * number
        return bytes(PIPELINE_BYTES) + spi.encode_standard(accel_m_s2=(x, -x, 9.8), gyro_rad_s=(x, 0.0, -x))

    def ioctl(self, _fd: int, request: int, argument: bytes) -> int:
        if request == spi_link.WR_BITS_PER_WORD and argument[0] > 8:
            raise OSError(errno.EINVAL, "8-bit words only, as on a Raspberry Pi")
        # a WR_… request: nothing to transfer
        if len(argument) < spi_link.ROW.size:
            return 0
        rows = list(spi_link.ROW.iter_unpack(argument))
        if self._wire_s:
            time.sleep(self._wire_s)
        # a burst: copy the next prepared burst without simulating the registers
        if rows[0][2] == BURST_BYTES:
            self._next = (self._next + 1) % PREPARED
            ctypes.memmove(rows[0][1], self._bursts[self._next], BURST_BYTES)
            return 0
        sent = [ctypes.string_at(row[0], row[2]) for row in rows]
        for row, answer in zip(rows, self._device.spi(sent), strict=True):
            ctypes.memmove(row[1], answer, len(answer))
        return 0

    def make(self, settings: SpiOptions) -> SpiLink:
        return SpiLink(settings, ioctl=self.ioctl, open_node=lambda _path, _flags: 0, close_node=lambda _fd: None)


async def _measured(port: Path, seconds: float, busy_ms: float, *, by_edges: bool) -> Sequence[float]:
    """Measure with `busy_ms` of work in the event loop every 20 ms.

    Return mean and maximum delay (µs), share of late reads, missed deadlines, polls, and CPU time per sample (µs).
    """
    output = DeviceOutput()
    samples = output.samples
    settings = SpiOptions(port=str(port), rate_hz=RATE_HZ, speed_hz=2_000_000, mode=0)
    lines = DeviceLines(data_ready=ReadyOptions(line="Y")) if by_edges else None
    config = DeviceConfig("imu", "imu61x-spi", None, True, "spi", settings, lines=lines)
    maker = LineFactory(lambda *_: PipeInput(round(1e9 / RATE_HZ)), lambda *_: MemoryOutput())
    factory = DeviceFactory(output, HostClock(), lines=maker)
    runner = factory.make(config, 0)
    task = asyncio.create_task(runner.run())
    # a quarter of a second until the clock and the thread run
    while len(samples) < RATE_HZ / 4:
        await asyncio.sleep(0.01)
        assert not task.done(), task
    before, begun, cpu_s, polling = runner.status().polling, len(samples), time.process_time(), None
    end_s = time.monotonic() + seconds
    used_s = 0.0
    while time.monotonic() < end_s:
        await asyncio.sleep(0.02)
        used_s += _busy(busy_ms)
    polling, cpu_s = runner.status().polling, time.process_time() - cpu_s - used_s
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    factory.close()
    assert before is not None
    assert polling is not None
    polls = polling.polls - before.polls
    mean_ns = (polling.late_mean_ns * polling.polls - before.late_mean_ns * before.polls) / polls
    late, missed = polling.late - before.late, polling.missed - before.missed
    return mean_ns / 1e3, polling.late_worst_ns / 1e3, late / polls, missed, polls, cpu_s * 1e6 / (len(samples) - begun)


def _busy(milliseconds: float) -> float:
    begin = time.thread_time()
    while time.thread_time() - begin < milliseconds / 1e3:
        pass
    return time.thread_time() - begin


def rows(*, quick: bool = False) -> list[Row]:
    seconds = 3.0 if quick else 20.0
    found: list[Row] = []
    for name, wire_s, busy_ms, by_edges in (
        ("", WIRE_S, 0.0, False),
        (", ioctl without duration", 0.0, 0.0, False),
        (", loop busy 10 %", WIRE_S, 2.0, False),
        (", data-ready edges", WIRE_S, 0.0, True),
        (", data-ready edges, loop busy 10 %", WIRE_S, 2.0, True),
    ):
        stub = Stub(wire_s)
        row, spi_link.LINK = spi_link.LINK, LinkType("spi", SpiOptions, make_polled=stub.make)
        try:
            with TemporaryDirectory() as folder:
                port = Path(folder) / "spidev0.0"
                port.touch()
                mean_us, worst_us, late, missed, polls, cpu_us = asyncio.run(
                    _measured(port, seconds, busy_ms, by_edges=by_edges)
                )
        finally:
            spi_link.LINK = row
        title = f"SPI burst, 1 kHz{name}"
        found += [
            Row(f"{title}: from {'edge' if by_edges else 'deadline'} to read, mean", mean_us, "us"),
            Row(f"{title}: worst", worst_us, "us"),
            Row(f"{title}: reads later than 1/4 of a period", late * 100, "%"),
            Row(f"{title}: edges without a read, of {polls:.0f}", missed, "")
            if busy_ms and by_edges  # the work takes 2 ms: one read handles two edges
            else at_most(f"{title}: deadlines missed of {polls:.0f}", missed, "", 0.001 * polls),
            Row(f"{title}: CPU per sample", cpu_us, "us"),
        ]
    return found
