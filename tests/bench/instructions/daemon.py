"""The real daemon on a pseudo-terminal in simulated time. Each wake-up of its event loop finds one read of the port.

`_Feeder.poll` runs in place of the sleep of the event loop. It writes the device's bytes and reads the sockets of the
clients. The turns of the loop, including the ticks, are therefore the same as in normal operation.
"""

import asyncio
import grp
import os
import select
import socket
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import ceil
from operator import attrgetter
from typing import Final

import msgspec

from imud import config
from imud.attitude.gravity import WINDOW_NS
from imud.contracts.condition import Condition
from imud.daemon import QUIET_TICK_S, Daemon
from imud.device.device import Device
from imud.device.recent_counts import MINUTE_NS
from imud.device.watches import AGAIN_NS
from imud.formats.jsonrpc import encode_request, line_of
from imud.formats.slot import encode_slot
from imud.host.event_loop import ReaderSelector, SampleLoop
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.path import SamplePath
from tests.bench.instructions import virtual_time
from tests.bench.instructions.module import BAUD, HI91, SETTLE_READS, Module, Read

DRAIN_EVERY: Final = 16
"""Number of wake-ups between two reads of the clients. The socket buffers do not fill up in this time."""
START_MS: Final = 1000  # until the daemon has opened the port
CONNECT_MS: Final = 10  # until the clients are subscribed
WAITING_MOST: Final = 20  # maximum number of reads that wait in the port
ARRIVAL: Final = attrgetter("t_rx_ns")
BUFFER: Final = bytearray(1 << 20)
TICK_NS: Final = round(QUIET_TICK_S * NS_PER_S)
TICK_SAMPLES: Final = TICK_NS // NS_PER_MS  # samples of the device between two ticks
TICK_BYTES: Final = TICK_SAMPLES * len(HI91)
QUIET_PERIOD_TICKS: Final = (WINDOW_NS + AGAIN_NS) // TICK_NS  # from one check against gravity to the next
END_NS: Final = 1 << 62  # after each time of a measurement
SETTLE_TICKS: Final = 3 * MINUTE_NS // TICK_NS  # after the losses of the first minute and the end of their reason


class _Feeder:
    def __init__(self, master: int, slave: int) -> None:
        self.loop: asyncio.AbstractEventLoop | None = None
        self._reads: Sequence[Read] = ()
        self._at = 0  # index of the next read
        self._is_paused = False
        self.clients: list[socket.socket] = []
        self._master = master
        self._readable = select.poll()
        self._readable.register(slave, select.POLLIN)
        self._epoll = select.epoll()
        self.close = self._epoll.close
        self.wakes = 0

    def register(self, fd: int, eventmask: int) -> None:
        self._epoll.register(fd, eventmask)
        self._is_paused = False

    def unregister(self, fd: int) -> None:
        self._epoll.unregister(fd)
        self._is_paused = True  # of all descriptors, the daemon adds and removes only the port again and again

    def poll(self, timeout: float | None, maxevents: int) -> list[tuple[int, int]]:
        # the loop would sleep now: deliver the next read
        if timeout is None or timeout > 0:
            if self._at == len(self._reads):
                assert self.loop is not None
                self.loop.stop()
            elif self._is_paused and timeout is not None:
                self._sleep(virtual_time.now_ns() + ceil(timeout * NS_PER_S))
            else:
                data, t_rx_ns = self._reads[self._at]
                self._at += 1
                self._feed(data, t_rx_ns)
        return self._epoll.poll(0, maxevents)

    def _sleep(self, end_ns: int) -> None:
        """Let the reads until a time wait in the port."""
        begin, most = self._at, min(self._at + WAITING_MOST, len(self._reads))
        self._at = end = bisect_right(self._reads, end_ns, begin, most, key=ARRIVAL)
        if end > begin:
            self._feed(b"".join([read.data for read in self._reads[begin:end]]), end_ns)
        virtual_time.set_now(end_ns)

    def _feed(self, data: bytes, t_rx_ns: int) -> None:
        virtual_time.set_now(t_rx_ns)
        os.write(self._master, data)
        self._readable.poll()  # wait until a kernel thread has moved the bytes to the slave
        self.wakes += 1
        if not self.wakes % DRAIN_EVERY:
            self.drain()

    def deliver(self, reads: Sequence[Read]) -> None:
        """Deliver these reads, then stop the loop."""
        self._reads, self._at = reads, 0

    def drain(self) -> None:
        for client in self.clients:
            client.recv_into(BUFFER)


class VirtualDaemon:
    """A daemon with one device and its clients, in the caller's thread."""

    def __init__(self, directory: str, latency_ms: int = 0, outputs: Mapping[str, object] | None = None) -> None:
        """The clients and shared memory request a latency. `outputs`: sections of more outputs."""
        self._latency_ms = latency_ms
        self._master, slave = os.openpty()
        self._socket_path = f"{directory}/s"
        self._module = Module()
        self._feeder = _Feeder(self._master, slave)
        self._loop = SampleLoop(ReaderSelector(self._feeder))
        self._feeder.loop = self._loop
        self._daemon = Daemon(_settings(directory, os.ttyname(slave), latency_ms, outputs or {}))
        self._running = self._loop.create_task(self._daemon.run())
        self._pass_time(START_MS)
        self.process(self._module.first_minute())

    def connect(self, clients: int, encoding: str) -> None:
        watch = line_of(encode_request("watch", {"encoding": encoding, "latency_ms": self._latency_ms}, 1))
        for _ in range(clients):
            client = socket.socket(socket.AF_UNIX)
            client.connect(self._socket_path)
            client.sendall(watch)
            client.setblocking(False)
            self._feeder.clients.append(client)
        self._pass_time(CONNECT_MS)
        self._feeder.drain()
        self._feeder.wakes = 0
        self.process(self._module.reads(SETTLE_READS))

    def prepare(self, count: int, frames: int) -> list[Read]:
        return self._module.reads(count, frames)

    def quiet_ticks(self, count: int) -> list[Callable[[], None]]:
        """Return ticks of a quiet state: all samples arrive in time, and the device is at rest. The last minute had no
        loss, so no reason holds."""
        self.process(self.prepare(1, 1))
        newest, begin_ns = self._path.newest, virtual_time.now_ns()
        assert newest is not None
        host = self._daemon._host
        host._held_ns, host._due_ns = begin_ns, END_NS  # the reads of the device measure the clock, not the tick
        ticks: list[Callable[[], None]] = []
        for number in range(1, SETTLE_TICKS + count + 1):
            later_ns, later = number * TICK_NS, number * TICK_SAMPLES
            sample = msgspec.structs.replace(
                newest, seq=newest.seq + later, t_ns=newest.t_ns + later_ns, t_rx_ns=newest.t_rx_ns + later_ns
            )
            slot = encode_slot(sample, self._device.device_id)
            ticks.append(partial(self._tick, self._path, self._device.ledger, begin_ns + later_ns, slot))
        for tick in ticks[:SETTLE_TICKS]:
            tick()
        assert self._device.condition is Condition.OK
        return ticks[SETTLE_TICKS:]

    def _tick(self, path: SamplePath, ledger: Ledger, now_ns: int, newest: bytes) -> None:
        """Tick right after the last of TICK_SAMPLES samples. These samples changed the ledger."""
        path._newest, path.last_sample_ns, path.last_data_ns = newest, now_ns, now_ns
        ledger.bytes_in += TICK_BYTES
        ledger.bytes_in_good_frames += TICK_BYTES
        ledger.frames_good += TICK_SAMPLES
        ledger.frames_in_samples += TICK_SAMPLES
        ledger.samples += TICK_SAMPLES
        virtual_time.set_now(now_ns)
        self._daemon.on_alarm()

    @property
    def _device(self) -> Device:
        return self._daemon._devices["d0"]

    @property
    def _path(self) -> SamplePath:
        path = self._device._transport.path
        assert path is not None
        return path

    def process(self, reads: Sequence[Read]) -> None:
        self._feeder.deliver(reads)
        self._loop.run_forever()
        # the daemon ended: raise its exception
        if self._running.done():
            self._running.result()

    def _pass_time(self, duration_ms: int) -> None:
        for _ in range(duration_ms):
            virtual_time.set_now(virtual_time.now_ns() + NS_PER_MS)
            self.process(())
        self._module.skip(duration_ms)


def _settings(directory: str, port: str, latency_ms: int, outputs: Mapping[str, object]) -> config.Config:
    tree = {
        **outputs, "log_level": "error", "state_dir": directory,
        "socket": {"path": f"{directory}/s", "group": own_group()},
        "shm": {"directory": directory, "group": own_group(), "latency_ms": latency_ms}, "metrics": {"port": 0},
        "devices": {"d0": {"driver": "hipnuc-uart", "identify": False, "uart": {"port": port, "baud": BAUD}}},
    }  # fmt: skip
    return config.parse(msgspec.json.encode(tree), "measurement")


def own_group() -> str:
    """Return a group to which this process may assign files without root."""
    return grp.getgrgid(os.getegid()).gr_name
