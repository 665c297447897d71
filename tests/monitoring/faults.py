"""A daemon on simulated devices. Each device has a fault that can be switched on and off.

    Feeder ──frames, 20 Hz──▶ Wire (pty) ──▶ Daemon in a thread ──▶ metrics
    a simulated device, a device on RS-485, lines and PPS in memory ──▶ the same daemon ──▶ mosquitto, a recording

ImudGapsUnknown, ImudBusErrors, ImudBusOff and ImudLedgerOpen need hardware or a bug of imud. For these alerts, the test
changes the status that the daemon shows. All other faults really happen.
"""

import asyncio
import logging
import os
import resource
import shutil
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, Final
from unittest import mock

import msgspec

from imud import config
from imud.client.connection import Client
from imud.config.model import Config
from imud.contracts.status import DeviceStatus, KernelCounters
from imud.daemon import Daemon
from imud.drivers.hipnuc.uart.codec import encode_hi91
from imud.host import event_loop
from imud.host.log import LogWriter
from imud.model.errors import LinkError
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.recorder.writer import RecordQueue
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import ModuleSettings, Output
from imud.sim.ports.pins import MemoryLines
from tests.fleet.mosquitto import running_broker
from tests.support.daemon_process import wait_until, write_config
from tests.support.pty_port import BAUD, plugged, slave, wired
from tests.test_daemon import Cable

PERIOD_MS: Final = 50  # 20 Hz
LIMIT_S: Final = 120.0
WIRES: Final = ("quiet", "gone", "flapping", "lossy", "noisy", "hot", "late", "jumping", "tilted", "lines", "mute")
WIRE_FAULTS: Final = ("silent", "lose_every", "flip_every", "temperature_c", "hold", "jump_ms", "behind_ms", "up_m_s2")
FLAP_S: Final = 0.8
PutRecord = Callable[[RecordQueue[object], bytes], None]
DISK_BYTES: Final = 16_384
"""Maximum size of a file of this process, bytes. Further writes fail, like on a full disk."""


class Wire(Cable):
    """A device that sends HI91 at 20 Hz, with faults. Synchronization: the feeder's thread."""

    plugged = True
    silent = False
    lose_every = flip_every = 0
    """Interval of lost or damaged frames, frames; 0 for no fault."""
    temperature_c = 20
    hold = 1
    """Number of frames that the wire holds before it delivers them."""
    jump_ms = 0
    """Time after which the device time starts again, ms; 0 for never."""
    behind_ms = 0
    """Offset of the device time into the past, ms."""
    up_m_s2 = 9.8

    def __init__(self, name: Path) -> None:
        super().__init__(name)
        self._held = b""
        self._count = 0

    def step(self, ms: int) -> None:
        self._count += 1
        if self.silent or (self.lose_every and self._count % self.lose_every == 0):
            return
        frame = bytearray(self._frame(ms % self.jump_ms if self.jump_ms else ms - self.behind_ms))
        if self.flip_every and self._count % self.flip_every == 0:
            frame[40] ^= 1
        self._held += frame
        if self._count % self.hold == 0:
            self._flush()

    def _flush(self) -> None:
        held, self._held = self._held, b""
        if self.plugged:
            os.set_blocking(self.master, False)
            with suppress(BlockingIOError):  # no program reads now
                os.write(self.master, held)

    def _frame(self, ms: int) -> bytes:
        wave = 0.3 * (1 if self._count % 4 < 2 else -1)
        return encode_hi91(
            system_time_ms=ms, accel_m_s2=(wave, 0.0, self.up_m_s2), gyro_rad_s=(0.0, 0.0, 0.0), mag_t=(0.0, 0.0, 0.0),
            euler_rad=(0.0, 0.0, 0.5), quat_wxyz=(0.9689, 0.0, 0.0, 0.2474), temperature_c=self.temperature_c,
            pressure_pa=1e5,
        )  # fmt: skip

    def swap(self) -> None:
        if self.plugged:
            self.plugged = False
            self.unplug()
        else:
            self.plug()
            self.plugged = True


def unpaid(status: DeviceStatus) -> DeviceStatus:
    return msgspec.structs.replace(status, ledger={**status.ledger, "bytes_in": status.ledger["bytes_in"] + 1})


def kernel_errors(name: str) -> Callable[[DeviceStatus], DeviceStatus]:
    looks = count(3, 3)
    return lambda status: msgspec.structs.replace(status, kernel=KernelCounters(**{name: next(looks)}))


def gaps_of_unknown_size() -> Callable[[DeviceStatus], DeviceStatus]:
    looks = count(1)
    return lambda status: msgspec.structs.replace(status, ledger={**status.ledger, "lost_unknown": next(looks)})


class AlteredDaemon(Daemon):
    """A daemon with changed statuses of some devices. Synchronization: like Daemon; one assignment sets `altered`."""

    def __init__(self, settings: Config, **more: Any) -> None:
        self.altered: Mapping[str, Callable[[DeviceStatus], DeviceStatus]] = {}
        super().__init__(settings, **more)

    def each_status(self) -> Iterator[DeviceStatus]:
        altered = self.altered
        for one in super().each_status():
            yield altered[one.name](one) if one.name in altered else one


class Site:
    """The daemon, its devices and their faults. Synchronization: the test's thread."""

    def __init__(self, folder: Path, port: int, beside: Sequence[Wire] = ()) -> None:
        self.folder = folder
        self.port = port
        self._beside = beside
        """Wires of another daemon, which this site also feeds."""
        self.memory = MemoryLines(time.monotonic_ns)
        self.faulty = False
        self.queue_is_full = False
        """Whether the queue of the recorder is full, as with a disk that was too slow for minutes."""
        self._stack = ExitStack()
        self._clients: list[Client] = []
        self._pps = True
        self._looping: asyncio.AbstractEventLoop | None = None

    def start(self) -> None:
        stack, folder = self._stack, self.folder
        (folder / "shm").mkdir()
        self.wires = {}
        for name in WIRES:
            (folder / name).mkdir()
            self.wires[name] = Wire(folder / name / "port")
            stack.callback(self._unplug, self.wires[name])
        (folder / "module").mkdir()
        (folder / "boom").mkdir()
        module = HipnucModule(time.monotonic_ns(), ModuleSettings(hi91=Output(PERIOD_MS)))
        self._module = stack.enter_context(plugged(folder / "module/port", module))
        self._slave = slave(80)
        self._line, _ = stack.enter_context(wired(folder / "boom", self._slave))
        self._broker = stack.enter_context(running_broker(folder / "broker"))
        stack.enter_context(mock.patch.object(RecordQueue, "put", self._put_or_drop(RecordQueue.put)))
        settings = config.load(self._write(faulty=False))
        self.daemon = AlteredDaemon(settings, file=folder / "imud.yaml", state_dir=folder, lines=self.memory.maker)
        self._thread = threading.Thread(target=event_loop.run, args=(self._serve(),), name="daemon")
        self._thread.start()
        stack.callback(self._stop)
        wait_until((folder / "imud.sock").exists, "the daemon's socket", LIMIT_S)
        self._ended = threading.Event()
        self._feeder = threading.Thread(target=self._feed, name="feeder")
        self._feeder.start()
        stack.callback(self._feeder.join)
        stack.callback(self._ended.set)
        self._log = stack.enter_context(_log_without_reader())

    def close(self) -> None:
        """Stop all parts. The log of a failed test can then be written again."""
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        self._stack.close()

    def scrape_s(self) -> float:
        """Return the longest of three scrape times while all devices run, s."""
        wait_until(lambda: self._running() == len(WIRES) + 2, "all devices in the state running", LIMIT_S)

        def once() -> float:
            begin = time.monotonic()
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/metrics", timeout=LIMIT_S) as answer:
                answer.read()
            return time.monotonic() - begin

        return max(once() for _ in range(3))

    # --- faults ----------------------------------------------------------------------------------------------------

    def break_everything(self) -> None:
        wires = self.wires
        wires["gone"].silent = True
        wires["lossy"].lose_every = 5
        wires["noisy"].flip_every = 10
        wires["hot"].temperature_c = 90
        wires["late"].hold, wires["late"].behind_ms = 12, 5000  # the fit of the clock starts again, with late frames
        wires["jumping"].jump_ms = 2 * PERIOD_MS
        wires["tilted"].up_m_s2 = -9.8
        self._pps = False
        self.in_loop(self._break_lines)
        self.daemon.altered = {
            "quiet": kernel_errors("framing"), "mute": kernel_errors("bus_off"), "tilted": unpaid,
            "lossy": gaps_of_unknown_size(),
        }  # fmt: skip
        self._write(faulty=True)
        self.in_loop(self.daemon.reload)
        for number in range(100):
            self._log.emit(logging.makeLogRecord({"msg": f"message {number}", "levelno": logging.INFO}))
        client = Client(self.folder / "imud.sock")
        client.watch(encoding="json")  # a client that never reads
        self._clients.append(client)
        # first the limit: without it, a tick could create the moved directory and its rings again
        resource.setrlimit(resource.RLIMIT_FSIZE, (DISK_BYTES, resource.RLIM_INFINITY))
        shutil.move(self.folder / "shm", self.folder / "away")
        self._broker.stop()
        self.faulty = True

    def mend_everything(self) -> None:
        self.faulty = False
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        self._broker.start()
        shutil.move(self.folder / "away", self.folder / "shm")
        for client in self._clients:
            client.close()
        self.daemon.altered = {}
        logging.getLogger().removeHandler(self._log)  # the log drops no more messages
        self._slave.dead = False
        self.memory.inputs["late sout"].open_error = None
        for wire in self.wires.values():
            for name in WIRE_FAULTS:
                setattr(wire, name, getattr(Wire, name))
        self._pps = True
        self._write(faulty=False)
        self.in_loop(self.daemon.reload)
        self.in_loop(lambda: self.memory.inputs["lines alarm"].edge(time.monotonic_ns(), False))

    def _break_lines(self) -> None:
        inputs, now_ns = self.memory.inputs, time.monotonic_ns()
        inputs["lines alarm"].edge(now_ns, True)
        inputs["lines sout"].lose(7)
        sout = inputs["late sout"]
        sout.open_error = LinkError("the test took the chip away")
        sout.vanish(sout.open_error)

    def _put_or_drop(self, put: PutRecord) -> PutRecord:
        def put_or_drop(queue: RecordQueue[object], record: bytes) -> None:
            if self.queue_is_full:
                queue.dropped += 1
            else:
                put(queue, record)

        return put_or_drop

    def block_loop(self, seconds: float) -> None:
        self.in_loop(lambda: time.sleep(seconds))

    def in_loop(self, call: Callable[[], object]) -> None:
        assert self._looping is not None
        self._looping.call_soon_threadsafe(call)

    # --- life ------------------------------------------------------------------------------------------------------

    async def _serve(self) -> None:
        self._looping = asyncio.get_running_loop()
        await self.daemon.run()

    def _stop(self) -> None:
        self.in_loop(self.daemon.stop)
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive()

    def _running(self) -> int:
        with Client(self.folder / "imud.sock", timeout_s=LIMIT_S) as client:
            return sum(one["state"] == "running" for one in client.status()["devices"])

    @staticmethod
    def _unplug(wire: Wire) -> None:
        if wire.plugged:
            wire.swap()

    def _feed(self) -> None:
        begin, sent, pulses, flapped = time.monotonic(), 0, 0, 0.0
        while not self._ended.wait(0.005):
            age = time.monotonic() - begin
            for number in range(sent, int(age * 1000) // PERIOD_MS):
                for wire in (*self.wires.values(), *self._beside):
                    wire.step(1000 + number * PERIOD_MS)
                sent = number + 1
            if int(age) > pulses:
                pulses = int(age)
                self._pulse(round((begin + pulses) * NS_PER_S))
            if (self.faulty or not self.wires["flapping"].plugged) and age > flapped + FLAP_S:
                flapped = age
                self.wires["flapping"].swap()
            if self.faulty:
                self._slave.dead = int(10 * age) % 10 == 0

    def _pulse(self, t_ns: int) -> None:
        if self._pps:
            self.in_loop(lambda: self.memory.inputs["lines pps"].pulse(t_ns, 100 * NS_PER_MS))

    def _write(self, *, faulty: bool) -> Path:
        """Write the configuration. The faulty configuration declares other settings than the devices have, and a
        missing source."""

        def uart(name: str, **more: Any) -> dict[str, Any]:
            port = str(self.folder / name / "port")
            return {"driver": "hipnuc-uart", "identify": False, "uart": {"port": port, "baud": 115200}, **more}

        def line(number: int) -> dict[str, Any]:
            return {"line": number, "chip": "gpiochip0"}

        devices = {name: uart(name) for name in WIRES}
        devices["lines"]["lines"] = {"sout": line(1), "pps": line(2), "alarm": line(3)}
        devices["late"]["lines"] = {"sout": line(4)}
        devices["module"] = uart("module", settings={"mode": "9-axis" if faulty else "6-axis"}, on_difference="report")
        devices["module"]["identify"] = True
        devices["boom"] = {
            "driver": "hipnuc-modbus",
            "rs485": {"line": str(self._line), "baud": BAUD, "address": 80, "reply_ms": 100, "rate_hz": 20},
        }  # fmt: skip
        if faulty:
            devices["mute"] |= {"identify": True, "settings": {"mode": "9-axis"}}
            # the repaired configuration differs, so that the device starts again and its restarts of the last hour end
            devices["jumping"]["condition"] = {"restarts": 60}
            devices["quiet"]["rmc"] = {"source": "gpsd", "tcp_port": 9}
        recorder = {"enabled": True, "directory": str(self.folder / "recordings")}
        mqtt = {
            "enabled": True, "brokers": [f"mqtt://127.0.0.1:{self._broker.port}"], "gateway": "site",
            "spool_directory": str(self.folder / "spool"), "retry_max_s": 1, "devices": {"*": {"whole": "slots"}},
        }  # fmt: skip
        return write_config(
            self.folder, devices, log_level="info", metrics={"port": self.port}, recorder=recorder, mqtt=mqtt,
            shm={"directory": str(self.folder / "shm")},
            socket={"path": str(self.folder / "imud.sock"), "queue_samples": 16},
        )  # fmt: skip


@contextmanager
def _log_without_reader() -> Iterator[LogWriter]:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    log = LogWriter(writer, messages_max=10)
    logging.getLogger().addHandler(log)
    try:
        yield log
    finally:
        logging.getLogger().removeHandler(log)
        log.close()
        os.close(reader)
        os.close(writer)


@contextmanager
def site(folder: Path, port: int, beside: Sequence[Wire] = ()) -> Iterator[Site]:
    """Run the site. `port` is the port of its metrics."""
    one = Site(folder, port, beside)
    try:
        one.start()
        yield one
    finally:
        one.close()
