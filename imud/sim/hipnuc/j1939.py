"""A HiPNUC device on SAE J1939: IMU configuration manual V1.5.9, chapter 6.

The simulator contains no I/O and reads no clock. The device samples at whole milliseconds of its own crystal, which
runs `skew_ppm` fast. Messages that are due in the same millisecond belong to one instant. They leave back to back,
lowest PGN first, `processing_ns` later. The device processes requests on PGN EF00 of any sender immediately and replies
to 0x55. It does not reply to a restart, nor to a request for one message, because the message is the reply. After
power-on and after a request (PGN EA00), it claims its address (J1939-81). Registers 0x70 to 0x78 are the Modbus
registers. `J1939Variant` contains behavior that the manuals do not define. Assumptions: no reply for an unknown
register; a value out of range is answered with the unchanged value; an interval applies from its next whole multiple;
the zero concerns the inclinometer only; the direction applies after the zero.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import atan2, cos, pi, radians, sin
from typing import Final, Literal

from imud.drivers.hipnuc import canfd
from imud.drivers.hipnuc.j1939 import codec, commands
from imud.drivers.hipnuc.j1939.codec import FACTORY_ADDRESS, encode
from imud.drivers.hipnuc.j1939.commands import LAYOUT, READ, WRITE
from imud.drivers.hipnuc.uart import ins
from imud.formats.can import FD_DATA_BYTES_MAX
from imud.formats.j1939 import CLAIMED, GLOBAL, REQUEST, J1939Id, join, split
from imud.model.sample import Position
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.can_module import BITRATE, CanSimulator, FrameWire, SentFrame
from imud.sim.hipnuc.ins import ins_values
from imud.sim.physics import Truth
from imud.sim.sensor import SensorHardware, SimulatorOptions, sensor_of

INTERVAL_MS: Final = 100  # default interval of each message, ms
REPLY_NS: Final = 200_000  # time from a request to its reply (assumed)
# PGNs that are on, by the name of a message; empty name: the default of the factory.
MESSAGES: Final = {
    "": (codec.ACCEL, codec.GYRO, codec.ROLL_PITCH, codec.HEADING),
    "all": (codec.UTC, *codec.MEASURED),
    "canfd": (codec.FAST,),
    "canfd_old": (codec.FAST_OLD,),
    "inclinometer": (codec.INCLINOMETER,),
}
SLOW: Final = (codec.TEMPERATURE, codec.UTC, codec.PLACE, codec.HEIGHT, codec.GNSS, codec.VELOCITY)
# Fields of FF5B: acceleration, angular rate, quaternion, time
FAST_BITS: Final = 1 << ins.ACCEL | 1 << ins.GYRO | 1 << ins.QUAT | 1 << ins.TIME
# Position and velocity of every device
PLACE: Final = Position(radians(48.1), radians(11.5), 520.0, 4, 17)
VELOCITY_M_S: Final = (1.5, -0.25, 0.0)
SLOW_MS: Final = 1000  # interval of the slow messages of `all`, ms
UTC_NS: Final = 1_735_689_600 * NS_PER_S  # UTC at the zero of the motion: 2025-01-01


@dataclass(frozen=True, slots=True, kw_only=True)
class J1939Variant:
    """Behavior that differs between devices or that the manuals do not define."""

    # Reads with a reply: all reads, reads with the value 1, or none.
    reads: Literal["answered", "value_one", "ignored"] = "answered"
    newer: bool = True  # whether the firmware has the PGNs of newer firmware, interval 0 and register 0x9D
    address_at_once: bool = False  # True: a new address applies immediately. False: after save and restart.
    # Source address of the confirmation if a new address applies immediately.
    confirms_from: Literal["old", "new"] = "old"
    claims_address: bool = True
    confirms_restart: bool = False
    confirms_once: bool = False
    reset_restarts: bool = False  # whether a factory reset restarts the device
    flash_ms: int = 0  # time of a save until its confirmation, ms
    refuses: frozenset[int] = frozenset()  # registers whose write the device refuses with a status
    ignores: frozenset[int] = frozenset()  # registers whose write the device confirms without an effect


# A variant for each undefined behavior. Drivers support all of them.
J1939_VARIANTS: Final[Mapping[str, J1939Variant]] = {
    "real": J1939Variant(),
    "confirms everything": J1939Variant(confirms_restart=True, confirms_once=True),
    "reads need the value 1": J1939Variant(reads="value_one"),
    "ignores reads": J1939Variant(reads="ignored"),
    "address at once": J1939Variant(address_at_once=True),
    "address at once, confirmed from there": J1939Variant(address_at_once=True, confirms_from="new"),
    "address at once, ignores reads": J1939Variant(address_at_once=True, confirms_from="new", reads="ignored"),
    "older firmware": J1939Variant(newer=False),
    "claims no address": J1939Variant(claims_address=False),
    "slow flash": J1939Variant(flash_ms=1900),
    "factory reset restarts": J1939Variant(reset_restarts=True),
}

REFUSED: Final = 1  # Status of a refusal. Assumption: the programs of the vendor accept only 0.
PRODUCT: Final = "HI14R2N-CAN-000"
FIRMWARE: Final = 169
# NAME of the device, invented: arbitrary address capable, an identity number.
NAME: Final = (1 << 63 | 0x2A_1708).to_bytes(8, "little")


@dataclass(frozen=True, slots=True)
class J1939Settings:
    """Settings in flash."""

    # Interval of each message that is on, ms.
    intervals_ms: Mapping[int, int] = field(default_factory=lambda: dict.fromkeys(MESSAGES[""], INTERVAL_MS))
    bitrate_code: int = commands.BITRATES.index(BITRATE)
    address: int = FACTORY_ADDRESS
    output: int = 1  # whether messages are sent periodically
    x_reversed: int = 0
    y_reversed: int = 0
    zero_rad: tuple[float, float] = (0.0, 0.0)  # physical angles that read as zero, rad


@dataclass(frozen=True, slots=True, kw_only=True)
class J1939Hardware(SensorHardware):
    """Hardware of a device."""

    bitrate: int | None = None  # bit rate of the bus, bit/s; 0: frames take no time; None: the rate of the settings
    has_utc: bool = True  # False: FF2F contains the uptime without a date, as without GNSS
    sends_heading_twice: bool = True  # True: the heading message appears twice, as in newer firmware
    variant: J1939Variant = field(default_factory=J1939Variant)


class HipnucJ1939Module:
    """A simulated device. Its power is on from the start."""

    def __init__(
        self, now_ns: int, settings: J1939Settings | None = None, hardware: J1939Hardware | None = None
    ) -> None:
        """`settings` are the settings in flash. A factory reset restores `J1939Settings()`."""
        self.flash = self.settings = settings or J1939Settings()
        self.hardware = hardware or J1939Hardware()
        self.epoch_ns = now_ns
        self.instants_sent = 0
        self.frames_sent = 0
        self.requests = self.writes_to_flash = 0
        self._leaving: list[SentFrame] = []  # frames that were queued at the request of a restart, with its reply
        self._ns_per_ms = NS_PER_MS / (1 + self.hardware.skew_ppm * 1e-6)
        self._power_on(now_ns)

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        parts = split(can_id)
        asks_claim = extended and parts.pgn == REQUEST and data[:3] == CLAIMED.to_bytes(3, "little")
        if asks_claim and parts.destination in (self._address, GLOBAL) and now_ns >= self._begin_ns:
            self._claim(now_ns)
        is_request = extended and parts.pgn == codec.CONFIGURE and parts.destination == self._address
        if is_request and len(data) == LAYOUT.size and now_ns >= self._begin_ns:
            self._sample(now_ns)
            register, command, _, value = LAYOUT.unpack(data)
            self._obey(register, command, value, now_ns)

    def mark(self, now_ns: int) -> None:
        """Do nothing: the device has no sync input on this port."""

    def reboot(self, now_ns: int) -> None:
        """Restart after a request or a power failure. The device loses unsaved settings."""
        self.settings = self.flash
        self._power_on(now_ns)

    def advance(self, now_ns: int) -> list[SentFrame]:
        self._sample(now_ns)
        left = [frame for frame in self._leaving if frame.due_ns <= now_ns]
        self._leaving = self._leaving[len(left) :]
        return left + self._wire.sent(now_ns)

    def next_ns(self) -> int | None:
        waiting = self._leaving[0].due_ns if self._leaving else self._wire.next_ns()
        if waiting is not None or not self._next_ms:
            return waiting
        device_ms = min(self._next_ms.values())
        first = min(pgn for pgn, next_ms in self._next_ms.items() if next_ms == device_ms)
        size = FD_DATA_BYTES_MAX if first in canfd.PGNS else codec.MESSAGE_BYTES
        return self._instant_ns(device_ms) + self.hardware.processing_ns + self._wire.frame_time_ns(True, size)

    def counters(self) -> dict[str, int]:
        return {"samples_sent": self.instants_sent, "frames_sent": self.frames_sent, "requests": self.requests}

    # --- messages ------------------------------------------------------------------------------------------------

    def _power_on(self, now_ns: int) -> None:
        hardware, settings = self.hardware, self.settings
        self._begin_ns = now_ns + hardware.boot_ms * NS_PER_MS
        self._address = settings.address
        bitrate = commands.BITRATES[settings.bitrate_code] if hardware.bitrate is None else hardware.bitrate
        self._wire = FrameWire(bitrate, self._begin_ns)
        self._next_ms = dict.fromkeys(settings.intervals_ms, 0)
        self._leaving = []
        self._fast_sent = 0  # number of CAN FD samples
        self._claim(self._begin_ns)

    def _claim(self, now_ns: int) -> None:
        if self.hardware.variant.claims_address:
            can_id = join(J1939Id(commands.REQUEST_PRIORITY, CLAIMED, self._address))
            self._wire.send(now_ns + REPLY_NS, can_id, True, NAME)
            self.frames_sent += 1

    def _instant_ns(self, device_ms: int) -> int:
        return self._begin_ns + round(device_ms * self._ns_per_ms)

    def _sample(self, now_ns: int) -> None:
        """Queue the messages of all instants up to now."""
        while self._next_ms:
            device_ms = min(self._next_ms.values())
            sample_ns = self._instant_ns(device_ms)
            if sample_ns > now_ns:
                return
            due = sorted(pgn for pgn, next_ms in self._next_ms.items() if next_ms == device_ms)
            reading = self._reading(sample_ns)
            self.instants_sent += 1
            for pgn in due:
                self._next_ms[pgn] += self.settings.intervals_ms[pgn]
                if self.settings.output:
                    self._send(pgn, reading, sample_ns)

    def _reading(self, sample_ns: int) -> Truth:
        return self.hardware.reading((sample_ns - self.epoch_ns) / NS_PER_S)

    def _send(self, pgn: int, reading: Truth, sample_ns: int) -> None:
        can_id, data = encode(pgn, self._packed(pgn, reading, sample_ns), self._address)
        self._wire.send(sample_ns + self.hardware.processing_ns, can_id, True, data, sample_ns)
        self.frames_sent += 1

    def _packed(self, pgn: int, reading: Truth, sample_ns: int) -> bytes:
        roll, pitch, yaw = reading.euler_rad
        rows: dict[int, Callable[[], bytes]] = {
            codec.ACCEL: lambda: codec.pack_accel(reading.accel_m_s2),
            codec.GYRO: lambda: codec.pack_gyro(reading.gyro_rad_s),
            codec.MAG: lambda: codec.pack_mag(reading.mag_t),
            codec.ROLL_PITCH: lambda: codec.pack_roll_pitch(roll, pitch),
            codec.HEADING: lambda: codec.pack_heading(yaw, twice=self.hardware.sends_heading_twice),
            codec.TEMPERATURE: lambda: codec.pack_temperature(reading.temperature_c),
            codec.QUATERNION: lambda: codec.pack_quaternion(reading.quat_wxyz),
            codec.INCLINOMETER: lambda: codec.pack_inclinometer(*self._inclination(reading)),
            codec.UTC: lambda: (
                codec.pack_utc(UTC_NS + sample_ns - self.epoch_ns)
                if self.hardware.has_utc
                else codec.pack_uptime(self._uptime_us(sample_ns) // 1000)
            ),
            codec.PLACE: lambda: codec.pack_place(PLACE),
            codec.HEIGHT: lambda: codec.pack_height(PLACE),
            codec.GNSS: lambda: codec.pack_gnss(PLACE),
            codec.VELOCITY: lambda: codec.pack_velocity(VELOCITY_M_S),
            codec.FAST_OLD: lambda: canfd.pack_old(ins_values(reading, 0), self._uptime_us(sample_ns) // 1000),
            codec.FAST: lambda: self._fast(reading, sample_ns),
        }
        return rows[pgn]()

    def _uptime_us(self, t_ns: int) -> int:
        """Return the time since power-on, µs of its own crystal."""
        return round((t_ns - self._begin_ns) / self._ns_per_ms * 1000)

    def _fast(self, reading: Truth, sample_ns: int) -> bytes:
        self._fast_sent += 1
        uptime_us = self._uptime_us(sample_ns)
        return canfd.pack_fast(ins_values(reading, 0), FAST_BITS, self._fast_sent - 1, time_us=uptime_us)

    def _inclination(self, reading: Truth) -> tuple[float, float]:
        """Return the angles of FF4A."""
        settings = self.settings
        (x, y), (zero_x, zero_y) = physical_inclination(reading), settings.zero_rad
        return _within_pi(x - zero_x) * (-1) ** settings.x_reversed, _within_pi(y - zero_y) * (
            -1
        ) ** settings.y_reversed

    # --- requests ------------------------------------------------------------------------------------------------

    def _obey(self, register: int, command: int, value: int, now_ns: int) -> None:
        self.requests += 1
        variant = self.hardware.variant
        is_heard = variant.reads == "answered" or (variant.reads == "value_one" and value == 1)
        if command == READ and is_heard and (present := self._present(register)) is not None:
            self._reply(register, command, present, now_ns)
        elif command == WRITE and register in variant.refuses:
            self._reply(register, command, value, now_ns, status=REFUSED)
        elif command == WRITE and register == commands.CONTROL:
            self._control(value, now_ns)
        elif command == WRITE and register == commands.ONCE and value in commands.INTERVALS:
            if variant.confirms_once:
                self._reply(register, command, value, now_ns)
            self._send(value, self._reading(now_ns), now_ns)
        elif command == WRITE and (register == commands.ZERO or self._present(register) is not None):
            self._write(register, value, now_ns)

    def _write(self, register: int, value: int, now_ns: int) -> None:
        """Write a register and confirm it. Change the address if a new address applies immediately."""
        variant, before = self.hardware.variant, self._address
        if register not in variant.ignores:
            self._set(register, value, now_ns)
        present = self._present(register)
        confirmed = value if present is None or register in variant.ignores else present
        if variant.address_at_once:
            self._address = self.settings.address
        source = before if variant.confirms_from == "old" else self._address
        self._reply(register, WRITE, confirmed, now_ns, source=source)

    def _present(self, register: int) -> int | None:
        """Return the value of a readable register; None for other registers."""
        settings = self.settings
        newer = {commands.OUTPUT, *(commands.INTERVALS[pgn] for pgn in codec.NEWER_PGNS)}
        if register in newer and not self.hardware.variant.newer:
            return None
        for pgn, interval_register in commands.INTERVALS.items():
            if register == interval_register:
                return settings.intervals_ms.get(pgn, 0)
        name = PRODUCT.encode().ljust(2 * len(commands.PRODUCT_NAME), b"\0")
        words = {register: 2 * place for place, register in enumerate(commands.PRODUCT_NAME)}
        if register in words:
            return int.from_bytes(name[words[register] :][:2], "big")
        return {
            commands.VERSION: FIRMWARE,
            commands.BITRATE: settings.bitrate_code,
            commands.ADDRESS: settings.address,
            commands.OUTPUT: settings.output,
            commands.X_SIGN: settings.x_reversed,
            commands.Y_SIGN: settings.y_reversed,
        }.get(register)

    def _set(self, register: int, value: int, now_ns: int) -> None:
        """Set a register if the value is in range."""
        settings = self.settings
        pgn = next((pgn for pgn, address in commands.INTERVALS.items() if address == register), None)
        if pgn is not None and value == commands.NEVER_MS and self.hardware.variant.newer:
            rest = {one: interval_ms for one, interval_ms in settings.intervals_ms.items() if one != pgn}
            self.settings = replace(settings, intervals_ms=rest)
            self._next_ms.pop(pgn, None)
        elif register == commands.OUTPUT and value in (0, 1):
            self.settings = replace(settings, output=value)
        elif pgn is not None and commands.INTERVAL_MIN_MS <= value <= commands.INTERVAL_MAX_MS:
            self.settings = replace(settings, intervals_ms={**settings.intervals_ms, pgn: value})
            device_ms = (now_ns - self._begin_ns) / self._ns_per_ms
            self._next_ms[pgn] = (int(device_ms) // value + 1) * value
        elif register == commands.BITRATE and value < len(commands.BITRATES):
            self.settings = replace(settings, bitrate_code=value)
        elif register == commands.ADDRESS and commands.MODULE_ADDRESS_MIN <= value <= commands.MODULE_ADDRESS_MAX:
            self.settings = replace(settings, address=value)
        elif register == commands.X_SIGN and value in (0, 1):
            self.settings = replace(settings, x_reversed=value)
        elif register == commands.Y_SIGN and value in (0, 1):
            self.settings = replace(settings, y_reversed=value)
        elif register == commands.ZERO and value == commands.Zero.HERE.value:
            self.settings = replace(settings, zero_rad=physical_inclination(self._reading(now_ns)))
        elif register == commands.ZERO and value == commands.Zero.CANCEL.value:
            self.settings = replace(settings, zero_rad=(0.0, 0.0))

    def _control(self, value: int, now_ns: int) -> None:
        variant = self.hardware.variant
        if value not in (commands.SAVE, commands.FACTORY, commands.RESTART):
            return
        if value != commands.RESTART or variant.confirms_restart:
            wait_ns = variant.flash_ms * NS_PER_MS if value == commands.SAVE else 0
            self._reply(commands.CONTROL, WRITE, value, now_ns + wait_ns)
        if value == commands.SAVE:
            self.flash = self.settings
            self.writes_to_flash += 1
        elif value == commands.FACTORY:
            self.flash = J1939Settings()
        if value == commands.RESTART or (value == commands.FACTORY and variant.reset_restarts):
            leaving = self._wire.sent(now_ns + NS_PER_S)
            self.reboot(now_ns)
            self._leaving = leaving

    def _reply(
        self, register: int, command: int, value: int, now_ns: int, *, status: int = 0, source: int | None = None
    ) -> None:
        sender = self._address if source is None else source
        can_id = join(J1939Id(codec.PRIORITY, codec.CONFIGURE, sender, codec.HOST_ADDRESS))
        self._wire.send(now_ns + REPLY_NS, can_id, True, LAYOUT.pack(register, command, status, value))
        self.frames_sent += 1


def physical_inclination(reading: Truth) -> tuple[float, float]:
    """Return the tilt about Y and X of the sensor, as a dual-axis inclinometer measures it."""
    roll, pitch, _ = reading.euler_rad
    up_x, up_y, up_z = -cos(pitch) * sin(roll), sin(pitch), cos(pitch) * cos(roll)
    return atan2(-up_x, up_z), atan2(up_y, up_z)


def _within_pi(angle: float) -> float:
    return (angle + pi) % (2 * pi) - pi


def make(options: SimulatorOptions, now_ns: int) -> HipnucJ1939Module:
    """Return a device for the options. Raises ValueError for an unsupported option."""
    interval_ms = round(1000 / options.rate_hz) if options.rate_hz > 0 else 0
    if not commands.INTERVAL_MIN_MS <= interval_ms <= commands.INTERVAL_MAX_MS:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected 1 … {1000 // commands.INTERVAL_MIN_MS}")
    if options.message not in MESSAGES:
        raise ValueError(f"message {options.message!r}: expected {' or '.join(filter(None, MESSAGES))}, or none")
    if options.node and not commands.MODULE_ADDRESS_MIN <= options.node <= commands.MODULE_ADDRESS_MAX:
        raise ValueError(f"node {options.node}: expected an address 1 … 128, or 0 for {FACTORY_ADDRESS}")
    pgns = MESSAGES[options.message]
    settings = J1939Settings(
        intervals_ms={pgn: SLOW_MS - SLOW_MS % interval_ms if pgn in SLOW else interval_ms for pgn in pgns},
        address=options.node or FACTORY_ADDRESS,
    )
    hardware = J1939Hardware(
        bitrate=options.bitrate(BITRATE),
        **sensor_of(options),
        variant=options.chosen(J1939_VARIANTS),
    )
    return HipnucJ1939Module(now_ns, settings, hardware)


def make_canfd(options: SimulatorOptions, now_ns: int) -> HipnucJ1939Module:
    """Return a device that sends CAN FD samples. Raises ValueError for an unsupported option."""
    return make(replace(options, message=options.message or "canfd"), now_ns)


SIMULATOR: Final = CanSimulator("hipnuc-j1939", "HiPNUC HI14 (CAN, SAE J1939)", make)
CANFD_SIMULATOR: Final = CanSimulator("hipnuc-canfd", "HiPNUC device with newer firmware (CAN FD)", make_canfd)
