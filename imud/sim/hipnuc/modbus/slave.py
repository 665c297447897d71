"""A HiPNUC module on RS-485 (Modbus RTU) by itself: registers, commands, settings saved or not. No wire, no clock.

IMU configuration manual V1.5.9, chapter 4. Assumed: firmware from 1.6.9 on has MAIN_STATUS, UPTIME and a quaternion of
0.0001 per count, older has not. The attitude is the truth; mounting and levelling are confirmed and change nothing.
"""

from dataclasses import dataclass, field, replace
from math import atan2, cos, degrees, sin
from random import Random
from typing import Final

from imud.devices.hipnuc.common.registers import (
    BAUD_RATES,
    BLOCK_FIRST,
    BY_NAME,
    FACTORY_BAUD,
    IDENTITY_FIRST,
    QUAT_NEW_PER_LSB,
    QUAT_OLD_PER_LSB,
)
from imud.devices.hipnuc.modbus.codec import pack_block, pack_identity
from imud.devices.hipnuc.modbus.frames import (
    BY_CHANCE,
    BY_SERIAL,
    CUSTOM,
    FACTORY_ID,
    RANDOMISE_IDS,
    READ,
    SET_ID_BY_SERIAL,
    registers_reply,
)
from imud.devices.hipnuc.modbus.session import FACTORY_RESET, RESTART, SAVE
from imud.formats.modbus import EXCEPTION_BIT, ILLEGAL_ADDRESS, READ_HOLDING, REGISTERS_MAX, WRITE_SINGLE
from imud.sim.physics.motion import Motion, Truth, swing
from imud.sim.physics.noise import Noise
from imud.units import NS_PER_MS, NS_PER_S

NEW_FIRMWARE: Final = 169
ILLEGAL_FUNCTION, ILLEGAL_VALUE = 1, 3
SETTINGS_FIRST: Final = BY_NAME["UART1_BAUD"].address
STATUS_AT: Final = BY_NAME["MAIN_STATUS"].address


@dataclass(frozen=True, slots=True)
class SlaveSettings:
    """What CTRL saves."""

    slave: int = FACTORY_ID
    baud: int = FACTORY_BAUD
    heading_mode: int = 0


@dataclass(slots=True)
class Slave:
    """One module. What has to do with its health may be changed at any time."""

    serial: bytes
    settings: SlaveSettings = field(default_factory=SlaveSettings)
    product: str = "HI14R2N-485-000"
    firmware: int = NEW_FIRMWARE
    loader: int = 107
    motion: Motion = field(default_factory=swing)
    noise: Noise | None = None
    skew_ppm: float = 20.0
    inclinometer: str = ""
    """`single`, `dual`, or empty for a product without."""
    processing_ns: int = 300_000
    """Time from the end of a request to the beginning of its reply (assumed)."""
    dead: bool = False
    bad_crc: int = 0
    """So many replies to come have a wrong CRC."""
    mute: int = 0
    """So many requests to come are not answered."""
    answered: int = 0
    flash: SlaveSettings = field(init=False)
    since_ns: int = field(init=False, default=0)
    """When it was switched on (CLOCK_MONOTONIC)."""

    def __post_init__(self) -> None:
        self.flash = self.settings

    def restart(self, now_ns: int) -> None:
        """What was not saved is gone."""
        self.settings, self.since_ns = self.flash, now_ns

    def uptime_ms(self, now_ns: int) -> int:
        """Of its own crystal."""
        return int((now_ns - self.since_ns) * (1 + self.skew_ppm * 1e-6)) // NS_PER_MS

    def obey(self, request: bytes, now_ns: int, epoch_ns: int, random: Random) -> bytes:
        """Do what function and data say; the reply without address and CRC."""
        match request[0]:
            case function if function == READ_HOLDING and len(request) == READ.size:
                _, first, count = READ.unpack(request)
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
        """The registers, or nothing where one of them is not there."""
        new = self.firmware >= NEW_FIRMWARE
        settings = self.settings
        words = [BAUD_RATES.index(settings.baud), settings.slave, settings.heading_mode, 0, 0, 0x0800, 0, 0]
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
        truth = self.motion.at(t_s)
        accel, gyro, mag, euler, quat, celsius, pascal = self.noise.add(truth, t_s) if self.noise else truth
        return pack_block(
            accel_m_s2=accel, gyro_rad_s=gyro, mag_t=mag, euler_rad=euler, quat_wxyz=quat, temperature_c=celsius,
            pressure_pa=pascal, incli_counts=incli_counts(truth, self.inclinometer),
            uptime_ms=self.uptime_ms(now_ns) if new else None,
            quat_per_lsb=QUAT_NEW_PER_LSB if new else QUAT_OLD_PER_LSB,
        )  # fmt: skip

    def _write(self, register: int, value: int, now_ns: int) -> int:
        """0, or the code of an exception."""
        known = [one for one in BY_NAME.values() if one.address == register and "W" in one.access]
        if not known:
            return ILLEGAL_ADDRESS
        if value not in known[0].values:
            return ILLEGAL_VALUE
        match known[0].name:
            case "CTRL" if value == SAVE:
                self.flash = self.settings
            case "CTRL" if value == FACTORY_RESET:
                self.flash = SlaveSettings()
                self.restart(now_ns)
            case "CTRL" if value == RESTART:
                self.restart(now_ns)
            case "UART1_BAUD":
                self.settings = replace(self.settings, baud=BAUD_RATES[value])
            case "MD_ID":
                self.settings = replace(self.settings, slave=value)
            case "HEADING_MODE":
                self.settings = replace(self.settings, heading_mode=value)
        return 0

    def _custom(self, request: bytes, random: Random) -> None:
        if len(request) == BY_SERIAL.size and request[1:3] == SET_ID_BY_SERIAL.to_bytes(2, "big"):
            *_, serial, slave = BY_SERIAL.unpack(request)
            if serial == self.serial:
                self.settings = replace(self.settings, slave=slave)
        elif len(request) == BY_CHANCE.size and request[1:3] == RANDOMISE_IDS.to_bytes(2, "big"):
            *_, low, high, _ = BY_CHANCE.unpack(request)
            self.settings = replace(self.settings, slave=random.randint(low, high))


def incli_counts(truth: Truth, kind: str) -> tuple[int, int]:
    """INCLI_X and INCLI_Y of a product of that kind: the angles of the vertical as the manual's example has them."""
    if not kind:
        return 0, 0
    roll, pitch, _ = truth.euler_rad
    x_deg = degrees(roll)
    if kind == "single":
        return round(x_deg % 360 / 360 * 32768) % 32768, 0
    y_deg = degrees(atan2(sin(pitch), cos(pitch) * cos(roll)))
    return round(x_deg / 180 * 32768), round(y_deg / 180 * 32768)
