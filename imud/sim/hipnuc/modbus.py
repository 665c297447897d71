"""HiPNUC devices on one RS-485 bus behind a serial port. IMU configuration manual V1.5.9, chapter 4.

The simulator contains no I/O and reads no clock. It behaves as a real bus:

- Each byte takes its time on the wire, in both directions. A frame ends with a silence of 3.5 characters. A device
  replies `processing_ns` later. With `chunk_bytes`, a reply arrives in pieces of this size.
- Two devices with the same ID reply at the same time. The port receives the AND of both replies, as on a bus with open
  drivers.
- All devices process requests to address 0, and none replies. No device replies to a frame with a wrong CRC.
- A new ID applies immediately, a new baud rate after save and restart. A restart loses unsaved settings.
- `SlaveVariant` contains behavior that the manuals do not define.

Assumptions: firmware 1.6.9 and newer has MAIN_STATUS, UPTIME and a quaternion of 0.0001 per count. Firmware 1.7.0 and
newer has HEAVE to SWAY_HZ and IDs up to 247. The attitude is the truth. The device confirms mounting and levelling
without an effect.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from math import atan2, cos, degrees, sin, tau
from random import Random
from typing import Final, Literal

from imud.drivers.hipnuc.common import QUAT_PER_LSB
from imud.drivers.hipnuc.modbus.codec import pack_block
from imud.drivers.hipnuc.modbus.commands import FACTORY_RESET, RESTART, SAVE
from imud.drivers.hipnuc.modbus.registers import (
    BAUD_RATES,
    BLOCK_FIRST,
    BY_CHANCE,
    BY_NAME,
    BY_SERIAL,
    CUSTOM,
    FACTORY_BAUD,
    FACTORY_ID,
    IDENTITY_FIRST,
    MANUAL_ID_MAX,
    QUAT_OLD_PER_LSB,
    RANDOMISE_IDS,
    READ,
    SET_ID_BY_SERIAL,
    WRITE,
    pack_identity,
    registers_reply,
)
from imud.formats.modbus import (
    BROADCAST,
    CRC_BYTES,
    EXCEPTION_BIT,
    ILLEGAL_ADDRESS,
    READ_HOLDING,
    REGISTERS_MAX,
    SLAVES,
    WRITE_SINGLE,
    frame_gap_ns,
    framed,
    is_whole,
)
from imud.model.sample import Vector3
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns
from imud.sim.hipnuc.uart_settings import SelfCalibration
from imud.sim.physics import Motion, Noise, Truth, swing
from imud.sim.ports.uart_wire import heard
from imud.sim.sensor import Burst, Simulator, SimulatorOptions, motion_of, noise_of

NEW_FIRMWARE: Final = 169
NEWEST_FIRMWARE: Final = 170  # firmware with heave, and with IDs up to 247 (assumption)
ILLEGAL_FUNCTION, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 3, 4
WAVE_HZ: Final = (0.1, 0.15, 0.2)  # frequencies of heave, surge and sway, Hz
SETTINGS_FIRST: Final = BY_NAME["UART1_BAUD"].address
STATUS_AT: Final = BY_NAME["MAIN_STATUS"].address
SHORT_BLOCK_END: Final = BY_NAME["UPTIME"].address


@dataclass(frozen=True, slots=True)
class SlaveSettings:
    """Settings that the register CTRL saves."""

    slave: int = FACTORY_ID
    baud: int = FACTORY_BAUD
    heading_mode: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class SlaveVariant:
    """Behavior that differs between devices or that the manuals do not define."""

    # Reply of new firmware to a block that extends beyond 0x4B. Older firmware replies illegal_address or worse.
    long_block: Literal["answered", "illegal_address", "failure", "silent"] = "answered"
    address_at_once: bool = True  # True: a new ID applies immediately, as in the manual. False: after save and restart.
    # Address of the confirmation of a new ID that applies immediately.
    address_reply: Literal["old", "new", "none"] = "old"
    rate_at_once: bool = False
    saves: bool = True  # False: the device confirms a save without an effect, as newest firmware
    saves_at_once: bool = False  # whether the device saves each written setting itself
    flash_ms: int = 0  # time of a save until its confirmation, ms
    refuses: frozenset[str] = frozenset()  # names of registers whose write the device refuses with exception 3
    ignores: frozenset[str] = frozenset()  # names of registers whose write the device confirms without an effect
    confirms_restart: bool = True
    boot_ms: int = 0  # silence after a restart, ms


# A variant for each undefined behavior. Drivers support all of them.
SLAVE_VARIANTS: Final[Mapping[str, SlaveVariant]] = {
    "manual": SlaveVariant(),
    "no long block": SlaveVariant(long_block="illegal_address"),
    "failure for the long block": SlaveVariant(long_block="failure"),
    "silence for the long block": SlaveVariant(long_block="silent"),
    "address after restart": SlaveVariant(address_at_once=False),
    "confirms from the new address": SlaveVariant(address_reply="new"),
    "does not confirm an address": SlaveVariant(address_reply="none"),
    "rate at once": SlaveVariant(rate_at_once=True),
    "slow flash": SlaveVariant(flash_ms=1900),
    "restarts without a reply": SlaveVariant(confirms_restart=False, boot_ms=800),
    "slow to boot": SlaveVariant(boot_ms=1500),
}


@dataclass(slots=True)
class Slave:
    """A simulated device. Tests can change its faults at any time."""

    serial: bytes
    settings: SlaveSettings = field(default_factory=SlaveSettings)
    product: str = "HI14R2N-485-000"
    firmware: int = NEW_FIRMWARE
    loader: int = 107
    variant: SlaveVariant = field(default_factory=SlaveVariant)
    motion: Motion = field(default_factory=swing)
    noise: Noise | None = None
    skew_ppm: float = 20.0
    wave_m: float = 0.0  # amplitude of heave, surge and sway, m; 0 if the product has no heave
    inclinometer: str = ""  # `single`, `dual`, or empty if the product has no inclinometer
    processing_ns: int = 300_000  # time from the end of a request to the start of its reply, ns (assumption)
    dead: bool = False
    bad_crc: int = 0  # number of next replies with a wrong CRC
    mute: int = 0  # number of next requests without a reply
    answered: int = 0
    hard_iron_t: Vector3 = (0.0, 0.0, 0.0)  # magnetic field of parts that turn with the device, T
    magnetometer: SelfCalibration = field(init=False)
    flash: SlaveSettings = field(init=False)
    writes_to_flash: int = field(init=False, default=0)
    address: int = field(init=False)  # current address
    baud: int = field(init=False)  # current baud rate, bit/s
    since_ns: int = field(init=False, default=0)  # power-on time (CLOCK_MONOTONIC)
    ready_ns: int = field(init=False, default=0)  # time at which the device has started and accepts requests, ns

    def __post_init__(self) -> None:
        self.flash = self.settings
        self.address, self.baud = self.settings.slave, self.settings.baud
        self.magnetometer = SelfCalibration(self.hard_iron_t, (0.0, 0.0, 0.0))

    def restart(self, now_ns: int) -> None:
        self.settings, self.since_ns = self.flash, now_ns
        self.address, self.baud = self.settings.slave, self.settings.baud
        self.ready_ns = now_ns + self.variant.boot_ms * NS_PER_MS

    def delay_ns(self, request: bytes) -> int:
        saves = request == WRITE.pack(WRITE_SINGLE, BY_NAME["CTRL"].address, SAVE)
        return self.processing_ns + (self.variant.flash_ms * NS_PER_MS if saves else 0)

    def replies_from(self, request: bytes, before: int) -> int | None:
        """Return the address of the reply to a request, `before` is the earlier address; None for no reply."""
        if request[0] == WRITE_SINGLE and len(request) == WRITE.size:
            _, register, value = WRITE.unpack(request)
            if register == BY_NAME["CTRL"].address and value == RESTART and not self.variant.confirms_restart:
                return None
            if register == BY_NAME["MD_ID"].address and self.address != before:
                return {"old": before, "new": self.address, "none": None}[self.variant.address_reply]
        elif request[0] == READ_HOLDING and len(request) == READ.size and self.variant.long_block == "silent":
            _, first, count = READ.unpack(request)
            return None if first < SHORT_BLOCK_END < first + count <= IDENTITY_FIRST else before
        return before

    def uptime_ms(self, now_ns: int) -> int:
        """Return the time since power-on, ms of its own crystal."""
        return int((now_ns - self.since_ns) * (1 + self.skew_ppm * 1e-6)) // NS_PER_MS

    def obey(self, request: bytes, now_ns: int, epoch_ns: int, random: Random) -> bytes:
        """Process a request (function and data). Return the reply without address and CRC."""
        match request[0]:
            case function if function == READ_HOLDING and len(request) == READ.size:
                _, first, count = READ.unpack(request)
                if self.variant.long_block == "failure" and first < SHORT_BLOCK_END < first + count <= IDENTITY_FIRST:
                    return self._refusal(function, DEVICE_FAILURE)
                data = self._read(first, count, now_ns, epoch_ns)
                return registers_reply(data) if data else self._refusal(function, ILLEGAL_ADDRESS)
            case function if function == WRITE_SINGLE and len(request) == READ.size:
                _, register, value = READ.unpack(request)
                code = self._write(register, value, now_ns)
                return self._refusal(function, code) if code else request
            case function if function == CUSTOM:
                self._custom(request, random)
                return request
        return self._refusal(request[0], ILLEGAL_FUNCTION)

    def _refusal(self, function: int, code: int) -> bytes:
        return bytes([function | EXCEPTION_BIT, code])

    def _read(self, first: int, count: int, now_ns: int, epoch_ns: int) -> bytes:
        """Read registers. Return no bytes if one of them does not exist."""
        new = self.firmware >= NEW_FIRMWARE
        settings = self.settings
        state, percent = self.magnetometer.state, int(100 * self.magnetometer.progress)
        words = [BAUD_RATES.index(settings.baud), settings.slave, settings.heading_mode, 0, 0, 0x0800, state, percent]
        low = b"".join(word.to_bytes(2, "big") for word in words)
        areas = [
            (SETTINGS_FIRST, low if new else low[: 2 * (STATUS_AT - SETTINGS_FIRST)]),
            (IDENTITY_FIRST, pack_identity(self.product, self.firmware, self.loader, self.serial)),
        ]
        if BLOCK_FIRST <= first < IDENTITY_FIRST:
            areas.append((BLOCK_FIRST, self._block(now_ns, epoch_ns, new=new)))
        for start, data in areas:
            at = 2 * (first - start)
            if 1 <= count <= REGISTERS_MAX and at >= 0 and at + 2 * count <= len(data):
                return data[at : at + 2 * count]
        return b""

    def _block(self, now_ns: int, epoch_ns: int, *, new: bool) -> bytes:
        t_s = (now_ns - epoch_ns) / NS_PER_S
        has_time = new and self.variant.long_block == "answered"
        truth = self.motion.at(t_s)
        accel, gyro, mag, euler, quat, celsius, pascal, *_ = self.noise.add(truth, t_s) if self.noise else truth
        if self.settings.heading_mode:
            self.magnetometer.sample(now_ns, gyro)
        mag = self.magnetometer.measured(mag)
        return pack_block(
            accel_m_s2=accel, gyro_rad_s=gyro, mag_t=mag, euler_rad=euler, quat_wxyz=quat, temperature_c=celsius,
            pressure_pa=pascal, incli_counts=incli_counts(truth, self.inclinometer),
            uptime_ms=self.uptime_ms(now_ns) if has_time else None,
            **(self._heave(t_s) if has_time and self.firmware >= NEWEST_FIRMWARE else {}),
            quat_per_lsb=QUAT_PER_LSB if new else QUAT_OLD_PER_LSB,
        )  # fmt: skip

    def _write(self, register: int, value: int, now_ns: int) -> int:
        """Write a register. Return 0 or the code of an exception."""
        known = [one for one in BY_NAME.values() if one.address == register and "W" in one.access]
        if not known:
            return ILLEGAL_ADDRESS
        is_high = known[0].name == "MD_ID" and value > MANUAL_ID_MAX and self.firmware < NEWEST_FIRMWARE
        if value not in known[0].values or known[0].name in self.variant.refuses or is_high:
            return ILLEGAL_VALUE
        if known[0].name in self.variant.ignores:
            return 0
        match known[0].name:
            case "CTRL" if value == SAVE and self.variant.saves:
                self.flash = self.settings
                self.writes_to_flash += 1
            case "CTRL" if value == FACTORY_RESET:
                self.flash = SlaveSettings()
                self.restart(now_ns)
            case "CTRL" if value == RESTART:
                self.restart(now_ns)
            case "UART1_BAUD":
                self.settings = replace(self.settings, baud=BAUD_RATES[value])
                self.baud = self.settings.baud if self.variant.rate_at_once else self.baud
            case "MD_ID":
                self._number(value)
            case "HEADING_MODE":
                self.settings = replace(self.settings, heading_mode=value)
        if self.variant.saves_at_once and known[0].name != "CTRL":
            self.flash = self.settings
        return 0

    def _heave(self, t_s: float) -> dict[str, Vector3]:
        """Return heave, surge and sway, and their frequencies; zeros if the product has no heave."""
        x, y, z = (self.wave_m * sin(tau * hz * t_s) for hz in WAVE_HZ)
        return {"heave_m": (x, y, z), "heave_hz": WAVE_HZ if self.wave_m else (0.0, 0.0, 0.0)}

    def _custom(self, request: bytes, random: Random) -> None:
        if len(request) == BY_SERIAL.size and request[1:3] == SET_ID_BY_SERIAL.to_bytes(2, "big"):
            *_, serial, slave = BY_SERIAL.unpack(request)
            if serial == self.serial:
                self._number(slave)
        elif len(request) == BY_CHANCE.size and request[1:3] == RANDOMISE_IDS.to_bytes(2, "big"):
            *_, low, high, _ = BY_CHANCE.unpack(request)
            self._number(random.randint(low, high))

    def _number(self, address: int) -> None:
        self.settings = replace(self.settings, slave=address)
        if self.variant.address_at_once:
            self.address = address


def incli_counts(truth: Truth, kind: str) -> tuple[int, int]:
    """Return INCLI_X and INCLI_Y of a product of this kind, as in the example of the manual."""
    if not kind:
        return 0, 0
    roll, pitch, _ = truth.euler_rad
    x_deg = degrees(roll)
    if kind == "single":
        return round(x_deg % 360 / 360 * 32768) % 32768, 0
    y_deg = degrees(atan2(sin(pitch), cos(pitch) * cos(roll)))
    return round(x_deg / 180 * 32768), round(y_deg / 180 * 32768)


class ModbusLine:
    """The bus and its devices as a `StreamModule`. Its output is the input of the port of the host."""

    def __init__(
        self, now_ns: int, slaves: Sequence[Slave], *, echo: bool = False, chunk_bytes: int = 0, seed: int = 1
    ) -> None:
        """`echo`: the adapter of the host receives its own transmission. `chunk_bytes`: size of pieces; 0 for complete
        frames."""
        self.slaves = list(slaves)
        self.epoch_ns = now_ns
        self.echo, self.chunk_bytes = echo, chunk_bytes
        self.requests = self.damaged = 0
        self._baud = slaves[0].baud if slaves else FACTORY_BAUD
        self._random = Random(seed)
        self._heard = b""
        self._heard_ns = now_ns
        self._free_ns = now_ns
        self._waiting: list[Burst] = []
        for slave in self.slaves:
            slave.since_ns = now_ns

    @property
    def baud(self) -> int:
        """Baud rate of the first device. Devices with another rate receive and send invalid bytes."""
        return self._baud

    def receive(self, data: bytes, now_ns: int) -> None:
        self._finish(now_ns)
        begin_ns = max(now_ns, self._heard_ns)
        self._heard_ns = begin_ns + len(data) * uart_byte_ns(self.baud)
        self._heard += data
        if self.echo:
            self._send(data, begin_ns, None)

    def advance(self, now_ns: int) -> list[Burst]:
        self._finish(now_ns)
        through = [burst for burst in self._waiting if burst.due_ns <= now_ns]
        del self._waiting[: len(through)]
        return through

    def next_ns(self) -> int | None:
        times = [self._waiting[0].due_ns] if self._waiting else []
        if self._heard:
            times.append(self._heard_ns + frame_gap_ns(self.baud))
        return min(times, default=None)

    def counters(self) -> dict[str, int]:
        answered = sum(slave.answered for slave in self.slaves)
        return {"requests": self.requests, "damaged": self.damaged, "answered": answered}

    def mark(self, _now_ns: int) -> None:
        """Do nothing: the devices have no sync input."""

    def reboot(self, now_ns: int) -> None:
        self._waiting, self._heard, self._free_ns = [], b"", now_ns
        for slave in self.slaves:
            slave.restart(now_ns)
        self._agree()

    def _agree(self) -> None:
        if self.slaves:
            self._baud = self.slaves[0].baud

    def _finish(self, now_ns: int) -> None:
        """Process the frame if the silence on the bus was long enough."""
        end_ns = self._heard_ns + frame_gap_ns(self.baud)
        if self._heard and now_ns >= end_ns:
            frame, self._heard = self._heard, b""
            self._on_request(frame, end_ns)

    def _on_request(self, frame: bytes, now_ns: int) -> None:
        replies: list[tuple[int, bytes]] = []
        is_good = False
        for slave in self.slaves:
            request = heard(frame, self.baud, slave.baud)
            if not is_whole(request) or len(request) < 2 + CRC_BYTES:
                continue
            is_good = True
            if request[0] not in (BROADCAST, slave.address) or slave.dead or now_ns < slave.ready_ns:
                continue
            if slave.mute:
                slave.mute -= 1
                continue
            asked = request[1:-CRC_BYTES]
            begin_ns = now_ns + slave.delay_ns(asked)
            address, baud = slave.address, slave.baud
            reply = slave.obey(asked, begin_ns, self.epoch_ns, self._random)
            source = slave.replies_from(asked, address)
            if request[0] != BROADCAST and source is not None:
                replies.append((begin_ns, heard(self._spoilt(slave, framed(source, reply)), baud, self.baud)))
        self.requests += is_good
        self.damaged += not is_good
        if replies:
            begin_ns = max(begin_ns for begin_ns, _ in replies)
            self._send(_together(reply for _, reply in replies), begin_ns, begin_ns)
        self._agree()

    def _spoilt(self, slave: Slave, reply: bytes) -> bytes:
        slave.answered += 1
        if slave.bad_crc:
            slave.bad_crc -= 1
            return reply[:-1] + bytes([reply[-1] ^ 1])
        return reply

    def _send(self, data: bytes, ready_ns: int, sample_ns: int | None) -> None:
        byte_ns, begin_ns = uart_byte_ns(self.baud), max(ready_ns, self._free_ns)
        self._free_ns = begin_ns + len(data) * byte_ns
        step = self.chunk_bytes or len(data) or 1
        for at in range(0, len(data), step):
            end = min(at + step, len(data))
            last = end == len(data)
            self._waiting.append(Burst(begin_ns + end * byte_ns, data[at:end], sample_ns if last else None, 0))


def _together(replies: Iterable[bytes]) -> bytes:
    """Combine the replies of several devices that send at the same time."""
    whole = b""
    for reply in replies:
        whole = bytes(a & b for a, b in zip_longest(whole or reply, reply, fillvalue=0xFF))
    return whole


def slaves_at(addresses: Iterable[int], options: SimulatorOptions) -> list[Slave]:
    """Return devices with these addresses and consecutive serial numbers."""
    return [
        Slave(
            (0x047D_955F_8D2A_1700 + number).to_bytes(8, "big"),
            SlaveSettings(address, options.baud or FACTORY_BAUD),
            firmware=options.firmware or NEW_FIRMWARE,
            motion=motion_of(options),
            noise=noise_of(options, number),
            skew_ppm=options.skew_ppm,
            variant=options.chosen(SLAVE_VARIANTS),
        )
        for number, address in enumerate(addresses, 1)
    ]


def make(options: SimulatorOptions, now_ns: int) -> ModbusLine:
    """Return a bus for the options; `message` is a list of addresses, such as 1,2,3. Raises ValueError."""
    if options.baud and options.baud not in BAUD_RATES:
        raise ValueError(f"baud {options.baud}: expected one of {', '.join(map(str, BAUD_RATES))}")
    words = options.message.split(",") if options.message else [str(FACTORY_ID)]
    if not all(word.isdecimal() and int(word) in SLAVES for word in words):
        raise ValueError(f"message {options.message!r}: expected addresses of devices, for example 1,2,3")
    return ModbusLine(now_ns, slaves_at(map(int, words), options), seed=options.seed)


SIMULATOR = Simulator("hipnuc-modbus", "HiPNUC HI14R2N on an RS-485 bus (--message 1,2,3: their addresses)", make)
