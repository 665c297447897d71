"""A HiPNUC device on a CAN bus with CANopen. Manual "IMU配置手冊" V1.5.9, chapter 5; CiA 301.

The simulator contains no I/O and reads no clock. Its timers count milliseconds of its own crystal, which runs
`skew_ppm` fast. The device measures all due values of one instant together and sends them back to back `processing_ns`
later, TPDO1 first. After power-on it sends its boot-up message and becomes operational (section 5.1). The heartbeat
(0x1017) is off by default.

Section 5.4 describes no reads of objects. Assumption: settings can be read, but 0x2000 and 0x20A5 cannot. TPDO
parameters, signs, zero and heartbeat apply immediately; node number and bit rate apply after a restart. A restart loses
unsaved settings. A factory reset clears the flash and has no effect before the restart. `NodeVariant` contains other
behavior that the manuals allow.
"""

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Final, Literal, NamedTuple

from imud.attitude.rotation import euler312_from_quat
from imud.drivers.hipnuc.canopen import cia301
from imud.drivers.hipnuc.canopen import commands as objects
from imud.drivers.hipnuc.canopen.cia301 import (
    ABORT,
    HEARTBEAT,
    NMT,
    NODE_DEFAULT,
    NODE_MAX,
    READ,
    READ_SIZES,
    SDO_BYTES,
    SDO_REPLY,
    SDO_REQUEST,
    SYNC,
    TPDO_FUNCTIONS,
    WRITE,
    WRITTEN,
    NmtCommand,
    NmtState,
    abort_frame,
)
from imud.drivers.hipnuc.canopen.codec import encode_tpdos
from imud.drivers.hipnuc.canopen.commands import (
    BIT_RATES,
    IDENTITY_SUBS,
    TPDO_OBJECTS,
    TPDO_TIMER,
    TPDO_TYPE,
    Transmission,
)
from imud.drivers.hipnuc.canopen.firmware import ENTER_LOADER, PROGRAM
from imud.model.sample import Pair
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.can_module import BITRATE, CanSimulator, FrameWire, SentFrame
from imud.sim.hipnuc.boot_loader import Application, Flash, SdoLoader
from imud.sim.physics import Truth
from imud.sim.sensor import SensorHardware, SimulatorOptions, sensor_of

NO_SUCH_OBJECT: Final = 0x0602_0000
NO_SUCH_SUB_INDEX: Final = 0x0609_0011
WRITE_ONLY: Final = 0x0601_0001
READ_ONLY: Final = 0x0601_0002
BAD_LENGTH: Final = 0x0607_0010
BAD_VALUE: Final = 0x0609_0030
BAD_COMMAND: Final = 0x0504_0001

DEVICE_TYPE: Final = 0
NAME: Final = b"HI14"
# Identity values, invented: the manual contains none.
IDENTITY_VALUES: Final = {1: 0x0000_03E8, 2: 0x0000_0E14, 3: 0x0000_009C, 4: 0x1708_0042}
REVISION: Final = 3  # sub-index of the version of the firmware
PERIODS_MS: Final = (0, *range(5, 1001))
_BIT_RATE_OF: Final = {code: bit_s for bit_s, code in BIT_RATES.items()}
_COMMANDS: Final = {size: command for command, size in reversed(READ_SIZES.items())}


class Control(Enum):
    """Side effects that a write has on the device in addition to a new setting."""

    NONE = auto()
    ZERO = auto()
    CANCEL_ZERO = auto()
    RESTART = auto()


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeVariant:
    """Behavior that differs between devices or that the manuals do not define."""

    reads: Literal["answered", "ignored", "aborted"] = "answered"  # reply to SDO uploads
    # True: a new node number applies immediately. False: after save and restart, as in the manual.
    number_at_once: bool = False
    confirms_from: Literal["old", "new"] = "old"  # node number of the confirmation if a new number applies immediately
    sends_boot_up: bool = True
    confirms_restart: bool = True
    flash_ms: int = 0  # time of a save until its confirmation, ms
    refuses: frozenset[int] = frozenset()  # objects whose write the device aborts
    ignores: frozenset[int] = frozenset()  # objects whose write the device confirms without an effect


# A variant for each undefined behavior. Drivers support all of them.
NODE_VARIANTS: Final[Mapping[str, NodeVariant]] = {
    "manual": NodeVariant(),
    "ignores reads": NodeVariant(reads="ignored"),
    "aborts reads": NodeVariant(reads="aborted"),
    "number at once": NodeVariant(number_at_once=True),
    "number at once, confirmed from there": NodeVariant(number_at_once=True, confirms_from="new"),
    "number at once, ignores reads": NodeVariant(number_at_once=True, confirms_from="new", reads="ignored"),
    "no boot-up message": NodeVariant(sends_boot_up=False),
    "restarts without a reply": NodeVariant(sends_boot_up=False, confirms_restart=False),
    "slow flash": NodeVariant(flash_ms=1900),
}


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """Settings that can be saved."""

    node: int = NODE_DEFAULT
    bit_rate: int = 500_000  # bit rate, bit/s; 0: frames take no time
    periods_ms: Mapping[int, int] = field(default_factory=lambda: {1: 10, 2: 10, 3: 10, 4: 10, 6: 50, 7: 10})
    types: Mapping[int, int] = field(default_factory=lambda: dict.fromkeys(TPDO_FUNCTIONS, 0xFF))
    invert_x: int = 0
    invert_y: int = 0
    heartbeat_ms: int = 0

    def signed(self, tilt: Pair, zero: Pair) -> Pair:
        """Return the angles of the inclinometer in the form that the device sends."""
        x, y = tilt[0] - zero[0], tilt[1] - zero[1]
        return (-x if self.invert_x else x, -y if self.invert_y else y)


class _Entry(NamedTuple):
    size: int
    read: Callable[[NodeSettings], int] | None
    values: Container[int] = ()  # accepted values; empty if the object is read-only
    write: Callable[[NodeSettings, int], NodeSettings] | None = None


class ObjectDictionary:
    """Active settings, settings in flash, and the SDO server."""

    def __init__(self, factory: NodeSettings, variant: NodeVariant | None = None) -> None:
        self.settings = self.saved = factory
        self.revision = IDENTITY_VALUES[REVISION]  # version of the firmware
        self.writes_to_flash = 0
        self._factory = factory
        self._variant = variant or NodeVariant()

    def restore(self) -> None:
        """Restore the saved settings at the start of the device."""
        self.settings = self.saved

    def serve(self, data: bytes) -> tuple[bytes, Control]:
        """Process an SDO request of eight bytes. Return the data of the reply (empty: none) and the side effect."""
        index, sub = int.from_bytes(data[1:3], "little"), data[3]
        entry = _ENTRIES.get((index, sub))
        if entry is None:
            known = any(other == index for other, _ in _ENTRIES)
            return abort_frame(index, sub, NO_SUCH_SUB_INDEX if known else NO_SUCH_OBJECT), Control.NONE
        if data[0] == READ:
            return self._read(data, entry), Control.NONE
        if data[0] in WRITE.values() and index in self._variant.refuses:
            return _abort(data, BAD_VALUE), Control.NONE
        if data[0] in WRITE.values():
            return self._write(data, entry)
        return abort_frame(index, sub, BAD_COMMAND), Control.NONE

    def _read(self, data: bytes, entry: _Entry) -> bytes:
        if self._variant.reads == "ignored":
            return b""
        if entry.read is None or self._variant.reads == "aborted":
            return _abort(data, WRITE_ONLY)
        value = entry.read(self.settings).to_bytes(entry.size, "little")
        if data[1:4] == objects.IDENTITY.to_bytes(2, "little") + bytes([REVISION]):
            value = self.revision.to_bytes(entry.size, "little")
        return bytes([_COMMANDS[entry.size]]) + data[1:4] + value.ljust(4, b"\0")

    def _write(self, data: bytes, entry: _Entry) -> tuple[bytes, Control]:
        if not entry.values:
            return _abort(data, READ_ONLY), Control.NONE
        if data[0] != WRITE[entry.size]:
            return _abort(data, BAD_LENGTH), Control.NONE
        value = int.from_bytes(data[4 : 4 + entry.size], "little")
        if value not in entry.values:
            return _abort(data, BAD_VALUE), Control.NONE
        if entry.write is not None and int.from_bytes(data[1:3], "little") not in self._variant.ignores:
            self.settings = entry.write(self.settings, value)
        control = self._control(int.from_bytes(data[1:3], "little"), value)
        return bytes([WRITTEN]) + data[1:4] + bytes(4), control

    def _control(self, index: int, value: int) -> Control:
        if index == objects.INCLI_ZERO:
            return Control.ZERO if value == objects.InclinometerZero.SET.value else Control.CANCEL_ZERO
        if index == objects.CONTROL:
            if value == objects.RESTART:
                return Control.RESTART
            self.saved = self.settings if value == objects.SAVE else self._factory
            self.writes_to_flash += 1
        return Control.NONE


def _abort(data: bytes, code: int) -> bytes:
    return bytes([ABORT]) + data[1:4] + code.to_bytes(4, "little")


def _with(mapping: Mapping[int, int], key: int, value: int) -> dict[int, int]:
    return {**mapping, key: value}


def _tpdo_entries(number: int, index: int) -> dict[tuple[int, int], _Entry]:
    def set_type(settings: NodeSettings, value: int) -> NodeSettings:
        return replace(settings, types=_with(settings.types, number, value))

    def set_period(settings: NodeSettings, value: int) -> NodeSettings:
        return replace(settings, periods_ms=_with(settings.periods_ms, number, value))

    return {
        (index, 0): _Entry(1, lambda _: TPDO_TIMER),
        (index, 1): _Entry(4, lambda s: TPDO_FUNCTIONS[number] + s.node),
        (index, TPDO_TYPE): _Entry(1, lambda s: s.types[number], (1, 0xFE, 0xFF), set_type),
        (index, TPDO_TIMER): _Entry(2, lambda s: s.periods_ms[number], PERIODS_MS, set_period),
    }


def _entries() -> dict[tuple[int, int], _Entry]:
    entries = {
        (cia301.DEVICE_TYPE, 0): _Entry(4, lambda _: DEVICE_TYPE),
        (objects.DEVICE_NAME, 0): _Entry(4, lambda _: int.from_bytes(NAME, "little")),
        (objects.IDENTITY, 0): _Entry(1, lambda _: len(IDENTITY_SUBS)),
        (objects.HEARTBEAT_TIME, 0): _Entry(
            2, lambda s: s.heartbeat_ms, range(1 << 16), lambda s, value: replace(s, heartbeat_ms=value)
        ),
        (objects.CONTROL, 0): _Entry(4, None, (objects.SAVE, objects.FACTORY_RESET, objects.RESTART)),
        (objects.INCLI_ZERO, 0): _Entry(4, None, tuple(zero.value for zero in objects.InclinometerZero)),
        (objects.NODE_ID, 0): _Entry(
            4, lambda s: s.node, range(1, NODE_MAX + 1), lambda s, value: replace(s, node=value)
        ),
        (objects.BIT_RATE, 0): _Entry(
            4,
            lambda s: BIT_RATES.get(s.bit_rate, 2),
            _BIT_RATE_OF,
            lambda s, value: replace(s, bit_rate=_BIT_RATE_OF[value]),
        ),
        (objects.INCLI_SIGN_X, 0): _Entry(4, lambda s: s.invert_x, (0, 1), lambda s, value: replace(s, invert_x=value)),
        (objects.INCLI_SIGN_Y, 0): _Entry(4, lambda s: s.invert_y, (0, 1), lambda s, value: replace(s, invert_y=value)),
    }
    for sub, value in IDENTITY_VALUES.items():
        entries[objects.IDENTITY, sub] = _Entry(4, lambda _, value=value: value)  # type: ignore[misc]  # a default binds it
    for number, index in TPDO_OBJECTS.items():
        entries |= _tpdo_entries(number, index)
    return entries


_ENTRIES: Final = _entries()


RATE_MIN_HZ, RATE_MAX_HZ = 1, 200
TICKS_PER_S: Final = 1000
# TPDOs that the device sends at the rate of the options. The pressure has a rate of at most 20 Hz (section 5.2).
TPDOS_DEFAULT: Final = (1, 2, 3, 4, 7)
PRESSURE_PERIOD_MS: Final = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class HipnucCanopenHardware(SensorHardware):
    """Hardware and factory settings of a device."""

    factory: NodeSettings = field(default_factory=NodeSettings)
    variant: NodeVariant = field(default_factory=NodeVariant)


class HipnucCanopenModule:
    """A simulated device. Its power is on from the start."""

    def __init__(self, now_ns: int, hardware: HipnucCanopenHardware | None = None) -> None:
        self.hardware = hardware or HipnucCanopenHardware()
        self.epoch_ns = now_ns
        self.samples_sent = self.frames_sent = 0
        self.objects = ObjectDictionary(self.hardware.factory, self.hardware.variant)
        self._leaving = FrameWire(0, now_ns)
        self.memory = Flash(Application(NAME.decode(), self.objects.revision))
        self.loader: SdoLoader | None = None  # active boot loader; None while the application runs
        self._power_on(now_ns)

    @property
    def node(self) -> int:
        return self._node

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        if extended or now_ns < self._begin_ns:
            return
        self._run(now_ns)
        if self.loader is not None:
            if can_id == SDO_REQUEST + self._node and len(data) == SDO_BYTES:
                self._serve(data, now_ns)
        elif can_id == NMT and len(data) == 2 and data[1] in (0, self._node):
            self._manage(data[0], now_ns)
        elif can_id == SYNC and self._state is NmtState.OPERATIONAL:
            self._measure(now_ns, [number for number in TPDO_FUNCTIONS if self._is_synchronous(number)])
        elif can_id == SDO_REQUEST + self._node and len(data) == SDO_BYTES and self._state is not NmtState.STOPPED:
            self._serve(data, now_ns)

    def mark(self, now_ns: int) -> None:
        """Do nothing: the device has no sync input on this port."""

    def reboot(self, now_ns: int) -> None:
        self._leaving = FrameWire(0, now_ns)
        self._power_on(now_ns)

    def advance(self, now_ns: int) -> list[SentFrame]:
        self._run(now_ns)
        return [*self._leaving.sent(now_ns), *self._wire.sent(now_ns)]

    def next_ns(self) -> int | None:
        waiting, tick = self._leaving.next_ns() or self._wire.next_ns(), self._next_tick()
        if waiting is not None or tick is None:
            return waiting
        return self._tick_ns(tick) + self.hardware.processing_ns + self._wire.frame_ns

    def counters(self) -> dict[str, int]:
        return {"samples_sent": self.samples_sent, "frames_sent": self.frames_sent}

    # --- time ----------------------------------------------------------------------------------------------------

    def _power_on(self, now_ns: int) -> None:
        self.objects.restore()
        settings, application = self.objects.settings, self.memory.application(NAME.decode())
        if application is not None:
            self.objects.revision = application.version
        self._node = settings.node
        self._begin_ns = now_ns + self.hardware.boot_ms * NS_PER_MS
        self._tick = 1
        self.loader = SdoLoader(self.memory) if application is None else None
        self._state = NmtState.PRE_OPERATIONAL if self.loader else NmtState.OPERATIONAL
        self._incli_zero: Pair = (0.0, 0.0)
        self._wire = FrameWire(settings.bit_rate, self._begin_ns)
        if self.hardware.variant.sends_boot_up and self.loader is None:
            self._send(self._begin_ns, HEARTBEAT + self._node, bytes([NmtState.BOOT_UP.value]))

    def _tick_ns(self, tick: int) -> int:
        return self._begin_ns + round(tick * NS_PER_MS / (1 + self.hardware.skew_ppm * 1e-6))

    def _run(self, now_ns: int) -> None:
        """Send all TPDOs whose timer has ended."""
        while (tick := self._next_tick()) is not None and (t_ns := self._tick_ns(tick)) <= now_ns:
            heartbeat_ms = self.objects.settings.heartbeat_ms
            if heartbeat_ms and tick % heartbeat_ms == 0:
                self._send(t_ns, HEARTBEAT + self._node, bytes([self._state.value]))
            self._measure(t_ns, [number for number, period_ms in self._timers() if tick % period_ms == 0])
            self._tick = tick + 1

    def _timers(self) -> list[tuple[int, int]]:
        """Return the TPDOs with a timer, each with its period, ms."""
        if self._state is not NmtState.OPERATIONAL:
            return []
        periods = self.objects.settings.periods_ms.items()
        return [(n, period_ms) for n, period_ms in sorted(periods) if period_ms and not self._is_synchronous(n)]

    def _next_tick(self) -> int | None:
        """Return the end of the next timer, ticks; None if no timer runs."""
        periods_ms = [period_ms for _, period_ms in self._timers()]
        periods_ms += [self.objects.settings.heartbeat_ms] if self.objects.settings.heartbeat_ms else []
        return min((-(-self._tick // period_ms) * period_ms for period_ms in periods_ms), default=None)

    def _is_synchronous(self, number: int) -> bool:
        return self.objects.settings.types[number] == Transmission.SYNC.value

    # --- output --------------------------------------------------------------------------------------------------

    def _send(self, ready_ns: int, can_id: int, data: bytes, sample_ns: int | None = None) -> None:
        self.frames_sent += 1
        self._wire.send(ready_ns, can_id, False, data, sample_ns)

    def _measure(self, sample_ns: int, numbers: list[int]) -> None:
        """Measure now and send these TPDOs."""
        if not numbers:
            return
        self.samples_sent += 1
        reading = self._reading(sample_ns)
        settings = self.objects.settings
        frames = encode_tpdos(
            accel_m_s2=reading.accel_m_s2,
            gyro_rad_s=reading.gyro_rad_s,
            euler_rad=euler312_from_quat(reading.quat_wxyz),
            quat_wxyz=reading.quat_wxyz,
            pressure_pa=reading.pressure_pa,
            incli_rad=settings.signed(self._tilt(reading), self._incli_zero),
        )
        for number in numbers:
            can_id = TPDO_FUNCTIONS[number] + self._node
            self._send(sample_ns + self.hardware.processing_ns, can_id, frames[number], sample_ns)

    def _reading(self, t_ns: int) -> Truth:
        return self.hardware.reading((t_ns - self.epoch_ns) / NS_PER_S)

    def _tilt(self, reading: Truth) -> Pair:
        """Return X and Y of the inclinometer. Assumption: pitch and roll; the manual does not define them."""
        roll, pitch, _ = euler312_from_quat(reading.quat_wxyz)
        return (pitch, roll)

    # --- requests ------------------------------------------------------------------------------------------------

    def _serve(self, data: bytes, now_ns: int) -> None:
        if data[1:4] == PROGRAM.to_bytes(2, "little") + bytes([ENTER_LOADER]) and self.loader is None:
            self.loader, self._state = SdoLoader(self.memory), NmtState.PRE_OPERATIONAL
        if self.loader is not None:
            if reply := self.loader.serve(data):
                self._send(now_ns + self.hardware.processing_ns, SDO_REPLY + self._node, reply)
            if self.loader.wants_reset:
                self._leaving = self._wire  # the device still sends the reply
                self._power_on(now_ns)
            return
        variant, before, saved = self.hardware.variant, self._node, self.objects.writes_to_flash
        reply, control = self.objects.serve(data)
        if variant.number_at_once:
            self._node = self.objects.settings.node
        if control is Control.RESTART and not variant.confirms_restart:
            reply = b""
        source = before if variant.confirms_from == "old" else self._node
        wait_ns = variant.flash_ms * NS_PER_MS if self.objects.writes_to_flash > saved else 0
        if reply:
            self._send(now_ns + self.hardware.processing_ns + wait_ns, SDO_REPLY + source, reply)
        if control is Control.ZERO:
            self._incli_zero = self._tilt(self._reading(now_ns))
        elif control is Control.CANCEL_ZERO:
            self._incli_zero = (0.0, 0.0)
        elif control is Control.RESTART:
            self._leaving = self._wire  # the device still sends the reply
            self._power_on(now_ns)

    def _manage(self, code: int, now_ns: int) -> None:
        states = {
            NmtCommand.START.value: NmtState.OPERATIONAL,
            NmtCommand.STOP.value: NmtState.STOPPED,
            NmtCommand.PRE_OPERATIONAL.value: NmtState.PRE_OPERATIONAL,
        }
        if code in states:
            self._state = states[code]
        elif code in (NmtCommand.RESET_NODE.value, NmtCommand.RESET_COMMUNICATION.value):
            self._power_on(now_ns)


def make(options: SimulatorOptions, now_ns: int) -> HipnucCanopenModule:
    """Return a device for the options. Raises ValueError for an unsupported option."""
    period_ms = TICKS_PER_S / options.rate_hz if options.rate_hz else 0
    if not RATE_MIN_HZ <= options.rate_hz <= RATE_MAX_HZ or period_ms % 1:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected a period of 5 … 1000 whole milliseconds")
    if options.message:
        raise ValueError(f"message {options.message!r}: expected no name, because a TPDO is enabled by its rate")
    if not 0 <= options.node <= NODE_MAX:
        raise ValueError(f"node {options.node}: expected 1 … {NODE_MAX}")
    pressure_ms = max(PRESSURE_PERIOD_MS // int(period_ms), 1) * int(period_ms)
    factory = NodeSettings(
        node=options.node or NODE_DEFAULT,
        bit_rate=options.bitrate(BITRATE),
        periods_ms={**dict.fromkeys(TPDOS_DEFAULT, int(period_ms)), 6: pressure_ms},
    )
    hardware = HipnucCanopenHardware(
        factory=factory,
        **sensor_of(options),
        variant=options.chosen(NODE_VARIANTS),
    )
    return HipnucCanopenModule(now_ns, hardware)


SIMULATOR = CanSimulator("hipnuc-canopen", "HiPNUC CH0x0, CH10x, HI14 on a CAN bus (CANopen)", make)
