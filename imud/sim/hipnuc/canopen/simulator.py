"""A HiPNUC module on a CAN bus with CANopen. Manual "IMU配置手冊" V1.5.9, chapter 5; CiA 301 for what it leaves open.

Without I/O and without a clock of its own. Its timers count milliseconds of its own crystal, which runs `skew_ppm`
fast; what is due at one instant is measured then and sent back to back `processing_ns` later, TPDO1 first. After
power-on it says its boot-up message and is operational by itself (section 5.1). A heartbeat (0x1017) is off as
delivered. Objects, access and what applies when: `hipnuc_canopen_objects`.
"""

from dataclasses import dataclass, field
from typing import Final

from imud.attitude import euler312_from_quat
from imud.devices.hipnuc.canopen.cob_ids import (
    HEARTBEAT,
    NMT,
    NODE_DEFAULT,
    NODE_MAX,
    SDO_REPLY,
    SDO_REQUEST,
    SYNC,
    TPDO_FUNCTIONS,
    NmtCommand,
    NmtState,
)
from imud.devices.hipnuc.canopen.codec import encode_tpdos
from imud.devices.hipnuc.canopen.sdo import SDO_BYTES
from imud.devices.hipnuc.canopen.session import Transmission
from imud.sample import Pair
from imud.sim.can_module import BITRATE, CanSimulator, FrameWire, SentFrame
from imud.sim.hipnuc.canopen.objects import Control, NodeSettings, ObjectDictionary
from imud.sim.physics.motion import MOTIONS, Motion, Truth, swing
from imud.sim.physics.noise import Noise
from imud.sim.simulator import SimulatorOptions
from imud.units import NS_PER_MS, NS_PER_S

RATE_MIN_HZ, RATE_MAX_HZ = 1, 200
TICKS_PER_S: Final = 1000
TPDOS_DEFAULT: Final = (1, 2, 3, 4, 7)
"""Sent at the rate of the options; the pressure comes at 20 Hz (section 5.2) or slower."""
PRESSURE_PERIOD_MS: Final = 50


@dataclass(frozen=True, slots=True)
class HipnucCanopenHardware:
    """What a module is made of and how it was set when it left the factory."""

    factory: NodeSettings = field(default_factory=NodeSettings)
    motion: Motion = field(default_factory=swing)
    noise: Noise | None = None
    skew_ppm: float = 20.0
    boot_ms: int = 500
    processing_ns: int = 125_000


class HipnucCanopenModule:
    """One module, powered on when it is made."""

    def __init__(self, now_ns: int, hardware: HipnucCanopenHardware | None = None) -> None:
        self.hardware = hardware or HipnucCanopenHardware()
        self.epoch_ns = now_ns
        self.samples_sent = self.frames_sent = 0
        self.objects = ObjectDictionary(self.hardware.factory)
        self._leaving = FrameWire(0, now_ns)
        self._power_on(now_ns)

    @property
    def node(self) -> int:
        """The number it answers to."""
        return self._node

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Take a frame that somebody else sent."""
        if extended or now_ns < self._begin_ns:
            return
        self._run(now_ns)
        if can_id == NMT and len(data) == 2 and data[1] in (0, self._node):
            self._manage(data[0], now_ns)
        elif can_id == SYNC and self._state is NmtState.OPERATIONAL:
            self._measure(now_ns, [number for number in TPDO_FUNCTIONS if self._is_synchronous(number)])
        elif can_id == SDO_REQUEST + self._node and len(data) == SDO_BYTES and self._state is not NmtState.STOPPED:
            self._serve(data, now_ns)

    def mark(self, now_ns: int) -> None:
        """It has no sync input on this port."""

    def reboot(self, now_ns: int) -> None:
        """Power was lost and came back: what was not saved is gone."""
        self._leaving = FrameWire(0, now_ns)
        self._power_on(now_ns)

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return what has crossed the wire since the last call, in order."""
        self._run(now_ns)
        return [*self._leaving.sent(now_ns), *self._wire.sent(now_ns)]

    def next_ns(self) -> int | None:
        """When `advance` will have something next."""
        waiting, tick = self._leaving.next_ns() or self._wire.next_ns(), self._next_tick()
        if waiting is not None or tick is None:
            return waiting
        return self._tick_ns(tick) + self.hardware.processing_ns + self._wire.frame_ns

    def counters(self) -> dict[str, int]:
        """Instants of measurement and frames sent."""
        return {"samples_sent": self.samples_sent, "frames_sent": self.frames_sent}

    # --- time ----------------------------------------------------------------------------------------------------

    def _power_on(self, now_ns: int) -> None:
        self.objects.restore()
        settings = self.objects.settings
        self._node = settings.node
        self._begin_ns = now_ns + self.hardware.boot_ms * NS_PER_MS
        self._tick = 1
        self._state = NmtState.OPERATIONAL
        self._incli_zero: Pair = (0.0, 0.0)
        self._wire = FrameWire(settings.bit_rate, self._begin_ns)
        self._send(self._begin_ns, HEARTBEAT + self._node, bytes([NmtState.BOOT_UP.value]))

    def _tick_ns(self, tick: int) -> int:
        return self._begin_ns + round(tick * NS_PER_MS / (1 + self.hardware.skew_ppm * 1e-6))

    def _run(self, now_ns: int) -> None:
        """Send what the timers made due by now."""
        while (tick := self._next_tick()) is not None and (t_ns := self._tick_ns(tick)) <= now_ns:
            heartbeat_ms = self.objects.settings.heartbeat_ms
            if heartbeat_ms and tick % heartbeat_ms == 0:
                self._send(t_ns, HEARTBEAT + self._node, bytes([self._state.value]))
            self._measure(t_ns, [number for number, period_ms in self._timers() if tick % period_ms == 0])
            self._tick = tick + 1

    def _timers(self) -> list[tuple[int, int]]:
        """TPDOs that a timer sends now, with its period in ms."""
        if self._state is not NmtState.OPERATIONAL:
            return []
        periods = self.objects.settings.periods_ms.items()
        return [(n, period_ms) for n, period_ms in sorted(periods) if period_ms and not self._is_synchronous(n)]

    def _next_tick(self) -> int | None:
        """When the next timer ends, in ticks; None if none runs."""
        periods_ms = [period_ms for _, period_ms in self._timers()]
        periods_ms += [self.objects.settings.heartbeat_ms] if self.objects.settings.heartbeat_ms else []
        return min((-(-self._tick // period_ms) * period_ms for period_ms in periods_ms), default=None)

    def _is_synchronous(self, number: int) -> bool:
        return self.objects.settings.types[number] == Transmission.SYNC.value

    # --- what it says --------------------------------------------------------------------------------------------

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
        t_s = (t_ns - self.epoch_ns) / NS_PER_S
        truth = self.hardware.motion.at(t_s)
        return self.hardware.noise.add(truth, t_s) if self.hardware.noise else truth

    def _tilt(self, reading: Truth) -> Pair:
        """X and Y of the inclinometer: taken to be pitch and roll, which the manual leaves open."""
        roll, pitch, _ = euler312_from_quat(reading.quat_wxyz)
        return (pitch, roll)

    # --- what it is told -----------------------------------------------------------------------------------------

    def _serve(self, data: bytes, now_ns: int) -> None:
        reply, control = self.objects.serve(data)
        self._send(now_ns + self.hardware.processing_ns, SDO_REPLY + self._node, reply)
        if control is Control.ZERO:
            self._incli_zero = self._tilt(self._reading(now_ns))
        elif control is Control.CANCEL_ZERO:
            self._incli_zero = (0.0, 0.0)
        elif control is Control.RESTART:
            self._leaving = self._wire  # the reply still goes out
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
    """A module from the common options. Raises ValueError naming the option that it cannot have."""
    period_ms = TICKS_PER_S / options.rate_hz if options.rate_hz else 0
    if not RATE_MIN_HZ <= options.rate_hz <= RATE_MAX_HZ or period_ms % 1:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected a period of 5 … 1000 whole milliseconds")
    if options.message:
        raise ValueError(f"message {options.message!r}: expected none, a TPDO is switched on by its rate")
    if not 0 <= options.node <= NODE_MAX:
        raise ValueError(f"node {options.node}: expected 1 … {NODE_MAX}")
    if options.motion not in MOTIONS:
        raise ValueError(f"motion {options.motion!r}: expected {' or '.join(MOTIONS)}")
    pressure_ms = max(PRESSURE_PERIOD_MS // int(period_ms), 1) * int(period_ms)
    factory = NodeSettings(
        node=options.node or NODE_DEFAULT,
        bit_rate=options.bitrate(BITRATE),
        periods_ms={**dict.fromkeys(TPDOS_DEFAULT, int(period_ms)), 6: pressure_ms},
    )
    hardware = HipnucCanopenHardware(
        factory=factory,
        motion=MOTIONS[options.motion](options.gravity_m_s2),
        noise=Noise(options.seed) if options.noise == "real" else None,
        skew_ppm=options.skew_ppm,
        boot_ms=options.boot_ms,
        processing_ns=options.processing_ns,
    )
    return HipnucCanopenModule(now_ns, hardware)


SIMULATOR = CanSimulator("hipnuc-canopen", "HiPNUC CH0x0, CH10x, HI14 on a CAN bus (CANopen)", make)
