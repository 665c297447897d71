"""The far ends of all links in one process. One thread serves sending ports, other threads serve polled buses.

device   link                                        driver           truth
serial   pseudo-terminal, SOUT on gpio-sim           hipnuc-uart      every sample by device time
uart     16550A pair                                 imu61x-uart      every sample by device time
vcan     virtual CAN                                 imu61x-can       every sample by a number in its values
can      SJA1000 pair                                imu61x-can       every sample by a number in its values
modbus   pseudo-terminal                             hipnuc-modbus    the deadlines, and the replies
i2c      i2c-dev                                     imu61x-i2c       also damaged and rejected transfers
spi      spidev, 8-bit words                         imu61x-spi       the same as i2c
"""

import errno
import os
import select
import termios
import threading
import tty
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from time import monotonic_ns
from types import TracebackType
from typing import Final, Self

from imud.sim import SIMULATORS
from imud.sim.ports.arrival import BARE_UART
from imud.sim.ports.can_port import CanPort
from imud.sim.ports.faults import FaultRates, Faults
from imud.sim.ports.pins import PinFaultRates, PinFaults, PullFile, SimulatedLines
from imud.sim.ports.pty import Adapter, PtyNode, SimulatedPort, set_baud
from imud.sim.sensor import Pin, SimulatorOptions, StreamModule
from tests.lab.bus import Bus, i2c_bus, spi_bus
from tests.lab.can_interface import CanInterface, controller_pair, virtual_can
from tests.lab.chaos.polls import LoggedRegisters, PollLog, block_replies
from tests.lab.chaos.truth import LoggedModule, TruthLog, by_device_time, decoded, numbered_can, time_key
from tests.lab.gpio_chip import GpioChip, simulated_chip
from tests.lab.imu61x_bus import on_i2c, on_spi
from tests.lab.serial_port import uart_pair
from tests.lab.wire import I2cTransfer, SpiTransfer

RATE_HZ: Final = 10.0  # rate of the sending devices
BAUD: Final = 115200
PERIOD_NS: Final = round(1e9 / RATE_HZ)
MODBUS_HZ: Final = 5.0  # rate of the Modbus device
SETTLE_S: Final = 0.012  # time for an edge of gpio-sim, see imu_process.py
LOOK_S: Final = 0.02
I2C_BURST: Final = b"\x12"
Port = SimulatedPort | CanPort


class UartNode(PtyNode):
    """The far UART of the pair in place of a pseudo-terminal. It cannot be unplugged."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self._fd)
        self._baud = BAUD

    def plug(self, baud: int) -> None:
        self._baud = baud
        set_baud(self._fd, baud)

    def unplug(self) -> None:
        if self._fd >= 0:
            termios.tcflush(self._fd, termios.TCIOFLUSH)
            os.close(self._fd)
            self._fd = -1

    def fileno(self) -> int:
        return self._fd

    @property
    def is_open(self) -> bool:
        return True

    @property
    def baud(self) -> int:
        return self._baud

    def read(self) -> bytes:
        try:
            return os.read(self._fd, 4096)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0


class PortThread:
    """Moves the bytes of the sending devices. Synchronization: hold `changing` during each access to a port."""

    def __init__(self) -> None:
        self.changing = threading.Lock()
        self.slowest_ns = 0
        """Longest time between two steps, ns. A burst can be late by this time."""
        self._ports: list[tuple[Port, SimulatedLines | None]] = []
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="ports")

    def add(self, port: Port, lines: SimulatedLines | None = None) -> None:
        self._ports.append((port, lines))

    def start(self) -> None:
        self._thread.start()

    def check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for port, _ in self._ports:
            port.close()
        self.check()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                with self.changing:
                    wait_s = self._step()
                    watched = [port.node.fileno() for port, _ in self._ports if port.node.is_open]
                with suppress(OSError, ValueError):  # a device was unplugged: its descriptor is closed
                    select.select(watched, [], [], wait_s)
        except BaseException as error:  # noqa: BLE001 - the main thread raises it
            self._failure = error

    def _step(self) -> float:
        now_ns = monotonic_ns()
        next_ns = now_ns + round(LOOK_S * 1e9)
        for port, lines in self._ports:
            if lines is not None:
                lines.step(now_ns)
                next_ns = min(next_ns, lines.next_ns(now_ns))
            port.step(now_ns, True)
            next_ns = min(next_ns, port.next_ns(now_ns))
        return max(next_ns - monotonic_ns(), 0) / 1e9


class FarSide:
    def __init__(self, folder: Path, seed: int) -> None:
        self._stack = ExitStack()
        self._seed = seed
        self.folder = folder
        self.truth: dict[str, TruthLog] = {}
        self.noise = {name: Faults(seed, FaultRates()) for name in ("serial", "uart")}
        self.pin_noise = PinFaults(seed, PinFaultRates())
        self.thread = PortThread()
        self.streams: dict[str, SimulatedPort] = {}
        self.modules: dict[str, LoggedModule] = {}
        self.cans: dict[str, CanPort] = {}
        self.registers = {name: LoggedRegisters(PERIOD_NS) for name in ("i2c", "spi")}
        self.polls = {name: registers.log for name, registers in self.registers.items()}

    def __enter__(self) -> Self:
        enter = self._stack.enter_context
        try:
            self.vcan: CanInterface = enter(virtual_can("vcan0"))
            self.can, self.can_far = enter(controller_pair())
            self.chip: GpioChip = enter(simulated_chip(("SOUT",)))
            self.uart, far_uart = uart_pair()
            self._add_stream("serial", "hipnuc-uart", PtyNode(self.folder / "serial"), sout=True)
            self._add_stream("uart", "imu61x-uart", UartNode(far_uart))
            self._add_stream("modbus", "hipnuc-modbus", PtyNode(self.folder / "modbus"))
            self._add_can("vcan", self.vcan, 101)
            self._add_can("can", self.can_far, 201)
            self._add_polled(enter(i2c_bus(0)), enter(spi_bus(0)))
            self.thread.start()
            self._stack.callback(self.thread.close)
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stack.close()

    def devices(self) -> Mapping[str, Mapping[str, object]]:
        uart: dict[str, object] = {"port": str(self.uart), "baud": BAUD}
        return {
            "serial": {
                "driver": "hipnuc-uart",
                "uart": {"port": str(self.folder / "serial"), "baud": BAUD},
                "lines": {"sout": {"line": "SOUT"}},
            },
            "uart": {"driver": "imu61x-uart", "uart": uart},
            "vcan": {"driver": "imu61x-can", "socketcan": {"interface": "vcan0"}, "options": {"base_id": 101}},
            "can": {"driver": "imu61x-can", "socketcan": {"interface": "can0"}, "options": {"base_id": 201}},
            "modbus": {
                "driver": "hipnuc-modbus",
                "rs485": {"line": str(self.folder / "modbus"), "rate_hz": MODBUS_HZ, "reply_ms": 200},
            },
            "i2c": {"driver": "imu61x-i2c", "i2c": {"bus": 0, "address": 0x18, "rate_hz": RATE_HZ}},
            "spi": {"driver": "imu61x-spi", "spi": {"port": "/dev/spidev0.0", "rate_hz": RATE_HZ}},
        }

    def _add_stream(self, name: str, driver: str, node: PtyNode, *, sout: bool = False) -> None:
        now_ns = monotonic_ns()
        options = SimulatorOptions(rate_hz=RATE_HZ, baud=BAUD, boot_ms=0, noise="none", skew_ppm=0.0, seed=self._seed)
        module: StreamModule = SIMULATORS[driver].make(options, now_ns)
        lines = None
        if sout:
            files = {Pin.SOUT: PullFile(self.chip.pull("SOUT"), SETTLE_S)}
            lines = SimulatedLines(module, files, self.pin_noise)
            self._stack.callback(lines.close)
        if name in self.noise:
            self.truth[name] = TruthLog(time_key, PERIOD_NS // 3)
            module = self.modules[name] = LoggedModule(module, by_device_time(self.truth[name], PERIOD_NS), now_ns)
        else:
            self.polls[name] = PollLog(round(1e9 / MODBUS_HZ))
            module = self.modules[name] = LoggedModule(module, block_replies(self.polls[name]), now_ns)
        port = SimulatedPort(module, node, Adapter(BARE_UART, now_ns), self.noise.get(name))
        self.streams[name] = port
        self.thread.add(port, lines)

    def _add_can(self, name: str, interface: CanInterface, base_id: int) -> None:
        log = self.truth[name] = TruthLog(decoded, 0)
        module = numbered_can(monotonic_ns, RATE_HZ, base_id, log)
        self.cans[name] = CanPort(module, interface.name)
        self.thread.add(self.cans[name])

    def _add_polled(self, i2c: Bus[I2cTransfer], spi: Bus[SpiTransfer]) -> None:
        at_i2c, at_spi = self.registers["i2c"], self.registers["spi"]
        i2c.attach(0x18, at_i2c.logged(on_i2c(at_i2c.device), _is_i2c_burst))
        spi.attach(0, at_spi.logged(on_spi(at_spi.device), _is_spi_burst))

    # --- what can be done to them ------------------------------------------------------------------------------------

    def unplug(self, name: str, seconds: float) -> None:
        with self.thread.changing:
            self.modules[name].power_off(monotonic_ns())
            self.streams[name].unplug(monotonic_ns(), round(seconds * 1e9))

    def pull_data(self, name: str) -> None:
        with self.thread.changing:
            self.streams[name].node.unplug()

    def plug_data(self, name: str) -> None:
        with self.thread.changing:
            self.streams[name].node.plug(self.modules[name].baud)

    def reboot(self, name: str) -> None:
        """Restart a device. Its port continues to exist."""
        module = self.modules.get(name) or self.cans[name].module
        with self.thread.changing:
            module.reboot(monotonic_ns())

    def set_noise(self, name: str, rates: FaultRates) -> None:
        with self.thread.changing:
            self.noise[name].rates = rates

    def set_pin_noise(self, rates: PinFaultRates) -> None:
        with self.thread.changing:
            self.pin_noise.rates = rates

    def set_registers(self, name: str, **values: object) -> None:
        for key, value in values.items():
            setattr(self.registers[name].device.faults, key, value)


STUCK: Final = {"error": errno.ETIMEDOUT}
"""SDA or a data line has a constant level: every transfer times out."""


def _is_i2c_burst(transfer: I2cTransfer) -> bool:
    return transfer.segments[0].data == I2C_BURST


def _is_spi_burst(transfer: SpiTransfer) -> bool:
    return len(transfer.segments[0].mosi) == 32 and transfer.segments[0].mosi[:1] in (b"\x80", b"\x0e")
