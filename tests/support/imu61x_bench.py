"""A simulated IMU61x on a serial line in virtual time, at any baud rate; and one behind the transfers of I2C or SPI."""

from dataclasses import replace
from math import radians
from typing import TypeVar

from imud.contracts.codec import CodecEvent, message_of
from imud.contracts.polling import Transfer
from imud.contracts.session import Outcome, Reply, Request, RequestScript, Session
from imud.devices.imu61x.uart.codec import Imu61xCodec
from imud.ledger import Ledger
from imud.sample import Measurement
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.imu61x.settings import Imu61xSettings
from imud.sim.imu61x.uart import Imu61xHardware, Imu61xModule
from imud.sim.physics.motion import Still
from imud.sim.ports.uart_wire import heard
from imud.units import NS_PER_MS

T = TypeVar("T")
BEGIN_NS = 1_234_567_890_123
STILL = Imu61xHardware(motion=Still(radians(2), radians(-3), radians(40)), skew_ppm=0)
STEP_MS = 2
"""How often the host looks."""


class Imu61xBench:
    """A device that has booted, the time, and the host's end of the line."""

    def __init__(self, settings: Imu61xSettings | None = None, hardware: Imu61xHardware = STILL) -> None:
        self.now_ns = BEGIN_NS
        self.module = Imu61xModule(BEGIN_NS, settings, hardware)
        self.line_baud = self.module.baud
        self.connected = True
        """Whether the host's transmit line reaches the device."""
        self.ledger = Ledger()
        self.codec = Imu61xCodec(self.ledger)
        self.session = Session(self.ledger)
        self.asked: list[str] = []
        """Names of the requests sent, pauses left out."""
        self.wait(self.module.hardware.boot_ms)

    def wait(self, duration_ms: float) -> list[CodecEvent]:
        """Let time pass; return what the host heard."""
        events: list[CodecEvent] = []
        end_ns = self.now_ns + round(duration_ms * NS_PER_MS)
        while self.now_ns < end_ns:
            self.now_ns = min(self.now_ns + STEP_MS * NS_PER_MS, end_ns)
            baud = self.module.baud
            for burst in self.module.advance(self.now_ns):
                events += self.codec.feed(heard(burst.data, baud, self.line_baud))
        assert self.ledger.closes()
        return events

    def samples(self, duration_ms: float) -> list[Measurement]:
        """Let time pass; return the measurements."""
        return [event for event in self.wait(duration_ms) if isinstance(event, Measurement)]

    def send(self, data: bytes) -> None:
        """Send bytes at the line's rate."""
        if self.connected and data:
            self.module.receive(heard(data, self.line_baud, self.module.baud), self.now_ns)

    def ask(self, request: Request) -> Outcome:
        """One request to its outcome."""
        if request.baud:
            self.line_baud = request.baud
        if request.payload:
            self.asked.append(request.name)
        self.send(self.session.start(request, self.now_ns))
        if request.silent:
            return Reply(())
        while True:
            messages = [message for event in self.wait(STEP_MS) if (message := message_of(event)) is not None]
            outcomes = [self.session.on_message(message, self.now_ns) for message in messages]
            for outcome in (*outcomes, self.session.on_time(self.now_ns)):
                if outcome is not None:
                    return outcome

    def run(self, script: RequestScript[T]) -> T:
        """Run a request script to its end; return its value, raise what it raises."""
        try:
            request = next(script)
            while True:
                request = script.send(self.ask(request))
        except StopIteration as end:
            value: T = end.value
            return value

    def restart(self) -> None:
        """Switch off and on, and wait until it has booted."""
        self.module.reboot(self.now_ns)
        self.wait(self.module.hardware.boot_ms + 1)


def bench(settings: Imu61xSettings | None = None, **hardware: object) -> Imu61xBench:
    """A bench with a device at rest that differs in `hardware`."""
    return Imu61xBench(settings, replace(STILL, **hardware))  # type: ignore[arg-type]  # names of fields


def over_i2c(device: Imu61xRegisters, transfer: Transfer) -> bytes:
    """One transfer on I2C; returns what is read."""
    return device.i2c([*transfer.sends, transfer.read_bytes] if transfer.read_bytes else [*transfer.sends])


def over_spi(device: Imu61xRegisters, transfer: Transfer) -> bytes:
    """One transfer on SPI in mode 0; returns what is read."""
    return b"".join(device.spi(transfer.sends, 0))
