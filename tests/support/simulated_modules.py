"""Simulated devices in simulated time without a link. Tests pass bytes and frames with calls, and run scripts.

`HipnucUartBench`, `HipnucLine`, `CanopenBench` and `Imu61xBench` contain a device and the host's end of its link.
Single transfers read registers on I2C and SPI.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from math import radians
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import pytest

from imud.contracts.codec import CanCodec, CodecEvent, StreamCodec, message_of
from imud.contracts.command import Target
from imud.contracts.driver import CanDriver
from imud.contracts.script import Outcome, Reply, ReplyFrame, Request, RequestScript, Transfer
from imud.contracts.setting import Written, combined
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.canopen.driver import DRIVER as CANOPEN_DRIVER
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from imud.drivers.hipnuc.j1939.driver import DRIVER as J1939_DRIVER
from imud.drivers.hipnuc.uart.codec import HipnucCodec, HipnucOptions
from imud.drivers.hipnuc.uart.driver import DRIVER as HIPNUC_UART
from imud.drivers.imu61x.uart.codec import Imu61xCodec
from imud.formats.can import EXTENDED_FLAG, RAW_FRAME, CanFilter
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_US
from imud.sim.can_module import CanModule, SentFrame
from imud.sim.hipnuc.canopen import HipnucCanopenHardware, HipnucCanopenModule, NodeSettings, NodeVariant
from imud.sim.hipnuc.j1939 import HipnucJ1939Module, J1939Hardware, J1939Settings, J1939Variant
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import Behaviour, HipnucHardware, ModuleSettings, Output
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.imu61x.uart import VARIANTS, Imu61xBehaviour, Imu61xHardware, Imu61xModule, Imu61xSettings
from imud.sim.physics import Still
from imud.sim.ports.uart_wire import heard
from imud.sim.sensor import Burst
from tests.support.old_spellings import script_of
from tests.support.script_runners import offline_runner

T = TypeVar("T")

BEGIN_NS = 1_234_567_890_123
UART_STEP_MS = 2  # time step of UART benches
AT_REST = Still(radians(2), radians(-3), radians(40))


def run_script(script: RequestScript[T], ask: Callable[[Request], Outcome]) -> T:
    try:
        request = next(script)
        while True:
            request = script.send(ask(request))
    except StopIteration as end:
        value: T = end.value
        return value


class SerialModule(Protocol):
    @property
    def baud(self) -> int: ...

    def advance(self, now_ns: int) -> list[Burst]: ...

    def receive(self, data: bytes, now_ns: int) -> None: ...


M = TypeVar("M", bound=SerialModule)


class SerialLine(Generic[M]):
    def __init__(self, module: M, codec: StreamCodec, ledger: Ledger) -> None:
        self.now_ns = BEGIN_NS
        self.module = module
        self.baud = module.baud
        self.connected = True  # whether the host's transmit line is connected to the device
        self.ledger = ledger
        self.codec = codec
        self.session = offline_runner(ledger)
        self.asked: list[str] = []

    def wait(self, duration_ms: float) -> list[CodecEvent]:
        """Let time pass. Return the events of the received bytes."""
        events: list[CodecEvent] = []
        end_ns = self.now_ns + round(duration_ms * NS_PER_MS)
        while self.now_ns < end_ns:
            self.now_ns = min(self.now_ns + UART_STEP_MS * NS_PER_MS, end_ns)
            baud = self.module.baud
            for burst in self.module.advance(self.now_ns):
                events += self.codec.feed(heard(burst.data, baud, self.baud))
        assert self.ledger.closes()
        return events

    def send(self, data: bytes) -> None:
        if self.connected and data:
            self.module.receive(heard(data, self.baud, self.module.baud), self.now_ns)

    def ask(self, request: Request) -> Outcome:
        if request.baud:
            self.baud = request.baud
        if request.payload:
            self.asked.append(request.name)
        self.send(self.session.start(request, self.now_ns))
        if request.silent:
            return Reply(())
        while True:
            events = self.wait(UART_STEP_MS)
            messages = [message for event in events if (message := message_of(event)) is not None]
            outcomes: list[Outcome | None] = [self.session.on_message(message, self.now_ns) for message in messages]
            outcomes += [self.session.on_sample(event) for event in events if isinstance(event, Measurement)]
            for outcome in (*outcomes, self.session.on_time(self.now_ns)):
                if outcome is not None:
                    return outcome

    def run(self, script: RequestScript[T]) -> T:
        return run_script(script, self.ask)


# --- HiPNUC on UART ---------------------------------------------------------------------------------------------------

HIPNUC_STILL = HipnucHardware(motion=AT_REST, skew_ppm=0)
FAST = ModuleSettings(baud=921_600, hi91=Output(1))


class Hi91(NamedTuple):
    """HI91 with the values on the wire, in the units of the manual."""

    word_1_2: int
    temperature_c: int
    pressure_pa: float
    system_time_ms: int
    accel_g: tuple[float, ...]
    gyro_deg_s: tuple[float, ...]
    mag_ut: tuple[float, ...]
    euler_deg: tuple[float, ...]
    quat_wxyz: tuple[float, ...]


def unpack_hi91(data: bytes) -> Hi91:
    """Unpack a frame by offsets of manual 3.3.1, without the codec."""
    assert (data[:4], data[6]) == (b"\x5a\xa5\x4c\x00", 0x91)
    _, word, temperature, pressure, time, *rest = struct.unpack("<BHbfI16f", data[6:])
    parts = [tuple(rest[i:j]) for i, j in ((0, 3), (3, 6), (6, 9), (9, 12), (12, 16))]
    return Hi91(word, temperature, pressure, time, *parts)


class HipnucUartBench:
    def __init__(self, settings: ModuleSettings | None = None, hardware: HipnucHardware | None = None) -> None:
        self.now_ns = BEGIN_NS
        self.module = HipnucModule(BEGIN_NS, settings, hardware)
        self.wait(self.module.hardware.boot_ms)

    def wait(self, duration_ms: float) -> list[Burst]:
        """Let time pass. Return the bursts that the device has sent."""
        self.now_ns += round(duration_ms * NS_PER_MS)
        return self.module.advance(self.now_ns)

    def frames(self, duration_ms: float) -> list[Hi91]:
        return [unpack_hi91(burst.data) for burst in self.wait(duration_ms) if burst.sample_ns is not None]

    def ask(self, command: str, duration_ms: float = 30.0) -> list[str]:
        self.module.receive(command.encode() + b"\r\n", self.now_ns)
        return self.text(duration_ms)

    def text(self, duration_ms: float) -> list[str]:
        """Let time pass. Return the received lines of text."""
        text = b"".join(burst.data for burst in self.wait(duration_ms) if burst.sample_ns is None)
        assert not text or text.endswith(b"\r\n")
        return text.decode("ascii").split("\r\n")[:-1]

    def reboot(self) -> None:
        self.module.reboot(self.now_ns)
        self.wait(self.module.hardware.boot_ms)


def hardware_of(behaviour: Behaviour, **hardware: Any) -> HipnucHardware:
    return replace(HIPNUC_STILL, behaviour=behaviour, **hardware)


class HipnucLine(SerialLine[HipnucModule]):
    def __init__(self, settings: ModuleSettings | None = None, hardware: HipnucHardware = HIPNUC_STILL) -> None:
        ledger = Ledger()
        super().__init__(HipnucModule(BEGIN_NS, settings, hardware), HipnucCodec(ledger, HipnucOptions()), ledger)
        self.wait(hardware.boot_ms)

    def act(self, name: str, *, fixed_baud: int = 0, **arguments: Any) -> Any:
        return self.run(script_of(HIPNUC_UART, Target(None, self.baud, fixed_baud), name, arguments))


# --- HiPNUC on CANopen ------------------------------------------------------------------------------------------------

CAN_STEP_NS = 250 * NS_PER_US  # time step of CAN benches
QUIET = NodeSettings(periods_ms=dict.fromkeys((1, 2, 3, 4, 6, 7), 0))


def unpack(payload: bytes) -> tuple[int, bytes]:
    can_id, size, data = RAW_FRAME.unpack(payload)
    assert can_id < EXTENDED_FLAG
    return can_id, data[:size]


class CanBench:
    """A device on a CAN bus, other devices on the same bus, a codec that receives its frames, and a script runner."""

    def __init__(self, driver: CanDriver, module: CanModule, settings: Any, others: Sequence[CanModule] = ()) -> None:
        self.now_ns = BEGIN_NS
        self.driver = driver
        self.bus: tuple[CanModule, ...] = (module, *others)
        self.settings = settings  # Settings of the driver. Scripts change them when they follow the device.
        self.codec: CanCodec = driver.make_codec(Ledger(), settings)
        self.session = offline_runner(self.codec.ledger)
        self.sent: list[tuple[int, bytes]] = []
        self.heard: list[tuple[int, bytes]] = []
        self.measured: list[Measurement] = []
        self._also: tuple[CanFilter, ...] = ()

    def target(self, bit_rate: int = 500_000, others_bit_s: float = 0.0) -> Target:
        return Target(self.settings, bit_rate, other_bits_per_s=others_bit_s)

    def run(self, duration_ns: int) -> Outcome | None:
        end_ns = self.now_ns + duration_ns
        while self.now_ns < end_ns:
            next_ns = (end_ns, self.session.deadline_ns, *(module.next_ns() for module in self.bus))
            rest_ns = min(t_ns for t_ns in next_ns if t_ns is not None) - self.now_ns
            self.now_ns += max(-(-rest_ns // CAN_STEP_NS), 1) * CAN_STEP_NS
            frames, *beside = [module.advance(self.now_ns) for module in self.bus]
            self.heard += [(frame.can_id, frame.data) for frame in frames]
            for frame in [*frames, *(frame for sent in beside for frame in sent)]:
                if (outcome := self._hear(frame)) is not None:
                    return outcome
            silence = self.session.on_time(self.now_ns)
            if silence is not None:
                return silence
        return None

    def _hear(self, frame: SentFrame) -> Outcome | None:
        for event in self.codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.due_ns):
            if isinstance(event, Measurement):
                self.measured.append(event)
            message = message_of(event)
            outcome = self.session.on_message(message, self.now_ns) if message is not None else None
            if outcome is not None:
                return outcome
        if any(wanted.matches(frame.can_id, frame.extended) for wanted in self._also):
            return self.session.on_message(ReplyFrame(frame.can_id, frame.data), self.now_ns)
        return None

    def send(self, can_id: int, data: bytes, *, extended: bool = False) -> None:
        self.sent.append((can_id, data))
        for module in self.bus:
            module.receive(can_id, extended, data, self.now_ns)

    def run_script(self, script: RequestScript[T]) -> T:
        return run_script(script, self._ask)

    def act(self, name: str, **given: object) -> object:
        result: object = self.run_script(script_of(self.driver, self.target(), name, given))
        return result

    def present(self) -> dict[str, Any]:
        assert self.driver.device_settings is not None
        return dict(combined(self.run_script(self.driver.device_settings.read(self.target(), None))).values)

    def set_for_good(self, name: str, value: object) -> Written:
        """Write a setting like the driver, save it and restart the device."""
        settings = self.driver.device_settings
        assert settings is not None
        write, save, restart = settings.table[name].write, settings.save, settings.restart
        assert write is not None
        assert save is not None
        assert restart is not None
        written: Written = self.run_script(write(self.target(), value))
        self.run_script(save(self.target()))
        self.run_script(restart(self.target()))
        return written

    def _ask(self, request: Request) -> Outcome:
        if request.settings is not None:
            self.settings = request.settings
            self.codec = self.driver.make_codec(self.codec.ledger, self.settings)
        self._also = request.also
        payload = self.session.start(request, self.now_ns)
        if payload:
            can_id, size, data = RAW_FRAME.unpack(payload)
            self.send(can_id & ~EXTENDED_FLAG, data[:size], extended=bool(can_id & EXTENDED_FLAG))
        if request.silent:
            return Reply(())
        outcome = self.run(request.timeout_ns + 2 * CAN_STEP_NS)
        assert outcome is not None
        return outcome


class CanopenBench(CanBench):
    def __init__(
        self, factory: NodeSettings | None = None, boot_ms: int = 0, variant: NodeVariant | None = None,
        others: tuple[int, ...] = (),
    ) -> None:  # fmt: skip
        made = NodeVariant() if variant is None else variant
        hardware = HipnucCanopenHardware(factory=factory or QUIET, boot_ms=boot_ms, skew_ppm=0, variant=made)
        self.module = HipnucCanopenModule(BEGIN_NS, hardware)
        self.others = [
            HipnucCanopenModule(BEGIN_NS, HipnucCanopenHardware(factory=NodeSettings(node=node), boot_ms=0))
            for node in others
        ]
        settings = HipnucCanopenOptions(node=self.module.node)
        super().__init__(CANOPEN_DRIVER, self.module, settings, self.others)


class J1939Bench(CanBench):
    def __init__(
        self, settings: J1939Settings | None = None, boot_ms: int = 0, variant: J1939Variant | None = None,
        others: tuple[int, ...] = (),
    ) -> None:  # fmt: skip
        hardware = J1939Hardware(boot_ms=boot_ms, skew_ppm=0, variant=variant or J1939Variant())
        flash = settings or J1939Settings()
        self.module = HipnucJ1939Module(BEGIN_NS, flash, hardware)
        beside = [HipnucJ1939Module(BEGIN_NS, J1939Settings(address=one), J1939Hardware(boot_ms=0)) for one in others]
        super().__init__(J1939_DRIVER, self.module, HipnucJ1939Options(address=flash.address), beside)


# --- IMU61x -----------------------------------------------------------------------------------------------------------

IMU61X_STILL = Imu61xHardware(motion=AT_REST, skew_ppm=0)


class Imu61xBench(SerialLine[Imu61xModule]):
    def __init__(self, settings: Imu61xSettings | None = None, hardware: Imu61xHardware = IMU61X_STILL) -> None:
        ledger = Ledger()
        super().__init__(Imu61xModule(BEGIN_NS, settings, hardware), Imu61xCodec(ledger), ledger)
        self.wait(hardware.boot_ms)

    def streams(self) -> bool:
        """Return whether samples arrive at the maximum rate of the link, at the latest after 800 ms of silence."""
        self.samples(800)
        return len(self.samples(100)) >= 5

    def samples(self, duration_ms: float) -> list[Measurement]:
        return [event for event in self.wait(duration_ms) if isinstance(event, Measurement)]

    def restart(self) -> None:
        self.module.reboot(self.now_ns)
        self.wait(self.module.hardware.boot_ms + 1)


def imu61x_hardware(**more: object) -> Imu61xHardware:
    names = {field.name for field in fields(Imu61xBehaviour)}
    behaviour = {name: value for name, value in more.items() if name in names}
    hardware = {name: value for name, value in more.items() if name not in names}
    if behaviour:
        hardware["behaviour"] = replace(IMU61X_STILL.behaviour, **behaviour)  # type: ignore[arg-type]  # names of fields
    return replace(IMU61X_STILL, **hardware)  # type: ignore[arg-type]  # the same


def imu61x_bench(settings: Imu61xSettings | None = None, **more: object) -> Imu61xBench:
    return Imu61xBench(settings, imu61x_hardware(**more))


every_variant = pytest.mark.parametrize("variant", VARIANTS)
"""Runs a test with the name of each variant that the manual does not define."""


def variant_bench(variant: str, settings: Imu61xSettings | None = None, **more: object) -> Imu61xBench:
    return imu61x_bench(settings, behaviour=VARIANTS[variant], **more)


def done(variant: str) -> int:
    """Return the result for success. The configuration must specify it for a variant."""
    return VARIANTS[variant].result_done


def over_i2c(device: Imu61xRegisters, transfer: Transfer) -> bytes:
    return device.i2c([*transfer.sends, transfer.read_bytes] if transfer.read_bytes else [*transfer.sends])


def over_spi(device: Imu61xRegisters, transfer: Transfer) -> bytes:
    return b"".join(device.spi(transfer.sends, 0))
