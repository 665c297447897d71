"""HiPNUC CH0x0/CH10x/HI14 on RS-485: one block of registers per sample. Manual "IMU配置手冊" V1.5.9, chapter 4.

    50 03 00 34 00 1A crc  →  50 03 34 | accel 3 | gyro 3 | mag 3 | roll pitch yaw i32 | °C | Pa i32 | quaternion 4 |
                                         inclinometer 2 | uptime ms u32 | crc      otherwise i16, high byte first

The block in the manual ends at 0x4B; newer firmware adds UPTIME. If a device rejects the longer block with an exception
or does not reply, imud reads the 24 registers of the manual. The exception "illegal data address" is final until
another device is connected. Other exceptions and missing replies can have other causes. They count only before the
first reply to the longer block, and imud tries the longer block again after the next identification.

Newer firmware has HEAVE to SWAY_HZ at 0x4E to 0x53. Products without heave lack them or send zeros (assumption). imud
reads them every ten seconds, and extends the block to 0x53 after the first value that is not zero.

Two scales depend on the device. imud decides them by the values and keeps them:
- Quaternion: the scale that gives unit length.
- Inclinometer: two axes (±180°, ±90°, 180/32768 degrees per count) or one axis (0 … 360°, 360/32768). Y is reserved in
  single-axis products. A Y other than zero or a negative X means two axes. A Y of zero at a pitched device means one
  axis (assumption: the reserved register reads zero). Before the decision, and while both are zero (a product without
  inclinometer), the value is None.

Assumptions from the manual's example: a magnetic field of zero, and a temperature and pressure that are both zero, mean
that the product lacks the sensor. `pressure_of` decides which pressures are valid.
"""

import struct
from collections.abc import Sequence
from math import atan2, cos, radians, sin
from typing import Annotated, ClassVar, Final, Literal

from msgspec import Meta

from imud.contracts.codec import BadFrame, BadReason, Poll, PolledEvent, Vanished
from imud.contracts.script import Transfer
from imud.drivers.hipnuc.common import (
    ACCEL_M_S2_PER_LSB,
    EULER_RAD_PER_LSB,
    FIELD_FILLERS,
    GYRO_RAD_S_PER_LSB,
    MAG_T_PER_LSB,
    PRESSURE_PA_PER_LSB,
    QUAT_PER_LSB,
    TEMPERATURE_C_PER_LSB,
    counts_of,
    field_of,
    pressure_of,
    vector_of,
)
from imud.drivers.hipnuc.modbus.registers import (
    BLOCK_FIRST,
    BLOCK_REGISTERS,
    BY_NAME,
    HEAVE_HZ_PER_LSB,
    HEAVE_M_PER_LSB,
    HEAVE_REGISTERS,
    INCLI_DUAL_RAD_PER_LSB,
    INCLI_SINGLE_RAD_PER_LSB,
    LONG_BLOCK_REGISTERS,
    QUAT_OLD_PER_LSB,
    SHORT_BLOCK_REGISTERS,
    read_registers,
)
from imud.drivers.polled_frames import Measured, PolledFrameDecoder, absence
from imud.drivers.state import COUNT, DAEMON, FLAG, NUMBER, OPTIONS
from imud.drivers.value_limits import possible_angles, possible_quaternion, possible_temperature_c
from imud.formats.modbus import (
    CRC_BYTES,
    ILLEGAL_ADDRESS,
    READ_HOLDING,
    READ_OVERHEAD_BYTES,
    exception_text,
    is_exception,
    is_whole,
)
from imud.formats.state import Data, Field, Integer, Maybe, New, OneOf, StateTable
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Pair, Quaternion, Vector3
from imud.model.units import NS_PER_S

# accel, gyro, mag, roll pitch yaw, temperature, pressure, quaternion wxyz, inclinometer: registers 0x34 … 0x4B
BLOCK: Final = struct.Struct(">3h3h3h3ihi4h2h")
UPTIME: Final = struct.Struct(">I")  # registers 0x4C … 0x4D, ms
HEAVE: Final = struct.Struct(">3h3H")  # registers 0x4E … 0x53: heave, surge, sway, their frequencies
DATA_AT: Final = 3
HEAVE_AT: Final = DATA_AT + BLOCK.size + UPTIME.size
# Time between two reads of the serial number, ns: another device can replace the device without a gap
CHECK_NS: Final = 10 * NS_PER_S
# Number of missing replies in a row before imud tries the shorter block. After three, the device counts as missing.
SILENT_MAX: Final = 2
PITCHED_RAD: Final = radians(1.0)  # minimum pitch for a decision: a dual-axis inclinometer then shows 182 counts

READ_BLOCK: Final = read_registers(BLOCK_FIRST, BLOCK_REGISTERS)
READ_LONG_BLOCK: Final = read_registers(BLOCK_FIRST, LONG_BLOCK_REGISTERS)
READ_SHORT_BLOCK: Final = read_registers(BLOCK_FIRST, SHORT_BLOCK_REGISTERS)
READ_SERIAL: Final = read_registers(BY_NAME["SN"].address, BY_NAME["SN"].count)
READ_HEAVE: Final = read_registers(BY_NAME["HEAVE"].address, HEAVE_REGISTERS)
READ_STATUS: Final = read_registers(BY_NAME["MAIN_STATUS"].address, BY_NAME["MAIN_STATUS"].count)
# Time between two reads of MAIN_STATUS, which is not in the block: maximum age of `status` of a sample, ns
STATUS_NS: Final = NS_PER_S
RESERVED_STATUS: Final = 1 << 13  # lowest reserved bit of MAIN_STATUS: with it, the register has filler bytes
SERIAL_BYTES_MAX: Final = 64  # maximum length of the serial number in a recorded state, bytes
_SAMPLE, _SERIAL, _STATUS, _HEAVE = 0, 1, 2, 3
_SHORT, _USUAL, _LONG = READ_SHORT_BLOCK, READ_BLOCK, READ_LONG_BLOCK


class HipnucModbusOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a device on RS-485."""

    inclinometer: Literal["auto", "single", "dual"] = "auto"
    """Axes of an inclinometer product: `single` has X from 0 to 360°, `dual` X ±180° and Y ±90°; `auto` decides by the
    values, after a tilt of more than 1°."""
    update_hz: Annotated[float, Meta(ge=0, le=10000)] = 0.0
    """Update rate of the device registers, per second, for the time stamp error; 0 if it is not known."""


def update_ns(settings: HipnucModbusOptions) -> int:
    """Return the maximum time between two updates of the registers, ns; 0 if it is not known."""
    return int(NS_PER_S / settings.update_hz) if settings.update_hz else 0


class HipnucModbusCodec:
    """Decoder of blocks of registers. Synchronization: one thread.

    `reset` keeps the known set of registers. It forgets scales and serial number.
    """

    STATE: ClassVar = StateTable(
        (
            Field(1, "_block", OneOf(_SHORT, _USUAL, _LONG)),
            Field(2, "_sure", FLAG),
            Field(3, "_just_shortened", FLAG),
            Field(4, "_answered", FLAG),
            Field(5, "_silent", COUNT),
            Field(6, "_stale_before", COUNT),
            Field(7, "_book", New(PolledFrameDecoder.STATE, lambda codec: codec.new_book())),
            Field(8, "_quat_scale", NUMBER),
            Field(9, "_incli_scale", NUMBER),
            Field(10, "_serial", Data(SERIAL_BYTES_MAX)),
            Field(11, "_status", Maybe(Integer(0, RESERVED_STATUS - 1))),
        ),
        {"ledger": DAEMON, "_fixed_incli": OPTIONS, "polls": "computed from `_block`"},
        lambda codec: codec.use_block(),
    )

    def __init__(self, ledger: Ledger, settings: HipnucModbusOptions) -> None:
        self.ledger = ledger
        self._fixed_incli = _INCLI[settings.inclinometer]
        self._stale_before = 0
        self._just_shortened = False
        self._book = PolledFrameDecoder(ledger, READ_BLOCK.read_bytes)
        self._read_block(_USUAL)
        self.reset()

    @property
    def stale(self) -> int:
        """Number of blocks with the same bytes as the previous block."""
        return self._stale_before + self._book.stale

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Decode one reply. Never raises an exception."""
        if poll == _SERIAL:
            return self._decode_serial(data)
        if poll == _STATUS:
            return self._decode_status(data)
        if poll == _HEAVE:
            return self._decode_heave(data)
        self._silent = 0
        if is_exception(data):
            return self._decode_exception(data)
        return self._book.decode(data, self._bad, self._measure)

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        """Use the shorter block after SILENT_MAX missing replies, if the longer block never had a reply."""
        if poll != _SAMPLE or self._block is _SHORT or self._answered:
            return ()
        self._silent += 1
        return self._shorten(sure=False, why="no reply") if self._silent >= SILENT_MAX else ()

    def reset(self) -> None:
        """Forget scales and serial number, because another device may be connected."""
        if self._block is _SHORT and not self._sure and not self._just_shortened:
            self._read_block(_USUAL)
        self._just_shortened = False
        self._silent = 0
        self._book.reset()
        self._quat_scale = 0.0
        self._incli_scale = self._fixed_incli
        self._serial = b""
        self._status: int | None = None

    def _decode_exception(self, data: bytes) -> Sequence[PolledEvent]:
        missing = data[2] == ILLEGAL_ADDRESS
        if self._block is not _SHORT and (missing or not self._answered):
            self._book.add_reply(data, good=True)
            return self._shorten(sure=missing, why=exception_text(data[2]))
        self.ledger.bytes_in += len(data)
        self.ledger.bytes_in_bad_frames += len(data)
        self.ledger.frames_bad_content += 1
        return (BadFrame(BadReason.CONTENT, data),)

    def _shorten(self, *, sure: bool, why: str) -> Sequence[PolledEvent]:
        if self._block is _LONG:
            self._read_block(_USUAL)
            return (Vanished(f"{why} for a read of the registers up to 0x53; imud reads up to 0x4D, without heave"),)
        self._read_block(_SHORT, sure=sure)
        self._just_shortened = True
        return (Vanished(f"{why} for a read of the registers up to 0x4D; imud reads up to 0x4B, without device time"),)

    def _read_block(self, block: Transfer, *, sure: bool = False) -> None:
        """Read this block in all following polls. `sure`: the device reported that it has no other block."""
        self._block, self._sure = block, sure
        self._just_shortened = self._answered = False
        self._silent = 0
        self.use_block()
        self._stale_before = self.stale
        self._book = self.new_book()

    def use_block(self) -> None:
        """Compute the polls of the present block."""
        self.polls: Sequence[Poll] = _polls(self._block)

    def new_book(self) -> PolledFrameDecoder:
        """Return a decoder of the present block."""
        return PolledFrameDecoder(self.ledger, self._block.read_bytes)

    def _decode_serial(self, data: bytes) -> Sequence[PolledEvent]:
        whole = len(data) == READ_SERIAL.read_bytes and is_whole(data) and not absence(data)
        self._book.add_reply(data, good=whole or is_exception(data))
        if not whole:  # damaged, or the firmware does not support this read
            return ()
        serial, before = data[DATA_AT:-CRC_BYTES], self._serial
        self._serial = serial
        if not before or serial == before:
            return ()
        self._read_block(_USUAL)
        return (Vanished(f"another device: serial number {serial.hex().upper()}, was {before.hex().upper()}"),)

    def _decode_status(self, data: bytes) -> Sequence[PolledEvent]:
        whole = len(data) == READ_STATUS.read_bytes and is_whole(data) and data[1] == READ_HOLDING
        self._book.add_reply(data, good=whole or is_exception(data))
        if whole:
            status = int.from_bytes(data[DATA_AT:-CRC_BYTES], "big")
            self._status = status if status < RESERVED_STATUS else None
        return ()

    def _decode_heave(self, data: bytes) -> Sequence[PolledEvent]:
        whole = len(data) == READ_HEAVE.read_bytes and is_whole(data) and data[1] == READ_HOLDING
        self._book.add_reply(data, good=whole or is_exception(data))
        values = data[DATA_AT:-CRC_BYTES]
        if not whole or values in (bytes(len(values)), b"\xff" * len(values)):
            return ()
        self._read_block(_LONG)
        return (Vanished("the device measures heave; imud reads up to 0x53"),)

    def _bad(self, data: bytes) -> BadReason | None:
        if not is_whole(data):
            return BadReason.CRC
        good = data[1] == READ_HOLDING and data[2] == len(data) - READ_OVERHEAD_BYTES
        return None if good else BadReason.CONTENT

    def _measure(self, data: bytes) -> Measured:
        (
            ax, ay, az, gx, gy, gz, mx, my, mz, roll, pitch, yaw, celsius, pressure, qw, qx, qy, qz, ix, iy,
        ) = BLOCK.unpack_from(data, DATA_AT)  # fmt: skip
        has_time, has_heave = self._block is not _SHORT, self._block is _LONG
        self._answered = True
        a, w, angle = ACCEL_M_S2_PER_LSB, GYRO_RAD_S_PER_LSB, EULER_RAD_PER_LSB
        euler = possible_angles((roll * angle, pitch * angle, yaw * angle))
        temperature = possible_temperature_c(celsius * TEMPERATURE_C_PER_LSB)
        return Measurement(
            len(data), 0, UPTIME.unpack_from(data, DATA_AT + BLOCK.size)[0] if has_time else None,
            vector_of(ax, ay, az, a), vector_of(gx, gy, gz, w), field_of(mx, my, mz),
            self._quaternion(qw, qx, qy, qz), euler, None if celsius == pressure in (0, -1) else temperature,
            pressure_of(pressure * PRESSURE_PA_PER_LSB), self._inclination(ix, iy, euler), self._status,
            heave_m=HEAVE.unpack_from(data, HEAVE_AT)[0] * HEAVE_M_PER_LSB if has_heave else None,
        ), euler is not None and temperature is not None  # fmt: skip

    def _quaternion(self, w: int, x: int, y: int, z: int) -> Quaternion | None:
        if not self._quat_scale:
            scales = (QUAT_OLD_PER_LSB, QUAT_PER_LSB)
            self._quat_scale = next((k for k in scales if possible_quaternion(w * k, x * k, y * k, z * k)), 0.0)
        k = self._quat_scale
        return possible_quaternion(w * k, x * k, y * k, z * k)

    def _inclination(self, x: int, y: int, euler_rad: Vector3 | None) -> Pair | None:
        if not self._incli_scale:
            if x == y and x in FIELD_FILLERS:
                return None
            if y or x < 0:
                self._incli_scale = INCLI_DUAL_RAD_PER_LSB
            elif euler_rad is not None and abs(_dual_y_rad(euler_rad[0], euler_rad[1])) > PITCHED_RAD:
                self._incli_scale = INCLI_SINGLE_RAD_PER_LSB
            else:
                return None
        k = self._incli_scale
        return x * k, y * k


_INCLI: Final = {"auto": 0.0, "single": INCLI_SINGLE_RAD_PER_LSB, "dual": INCLI_DUAL_RAD_PER_LSB}


def _dual_y_rad(roll_rad: float, pitch_rad: float) -> float:
    """Return the Y axis of a dual-axis inclinometer in this attitude: atan2(gy, gz) of the vertical in sensor axes."""
    return atan2(sin(pitch_rad), cos(pitch_rad) * cos(roll_rad))


def _polls(block: Transfer) -> Sequence[Poll]:
    # firmware without UPTIME has no MAIN_STATUS and no HEAVE either
    polls = (Poll(block), Poll(READ_SERIAL, CHECK_NS), Poll(READ_STATUS, STATUS_NS), Poll(READ_HEAVE, CHECK_NS))
    return polls[: {_SHORT: _STATUS, _USUAL: _HEAVE + 1, _LONG: _HEAVE}[block]]


# --- encoder for simulated devices ------------------------------------------------------------------------------


def pack_block(
    *,
    accel_m_s2: Vector3,
    gyro_rad_s: Vector3,
    mag_t: Vector3,
    euler_rad: Vector3,
    quat_wxyz: Quaternion,
    temperature_c: float,
    pressure_pa: float,
    uptime_ms: int | None,
    incli_counts: tuple[int, int] = (0, 0),
    quat_per_lsb: float = QUAT_PER_LSB,
    heave_m: Vector3 | None = None,
    heave_hz: Vector3 = (0.0, 0.0, 0.0),
) -> bytes:
    """Return registers 0x34 … 0x4D from SI values, clipped to their range; up to 0x4B without `uptime_ms`.

    With `heave_m` (heave, surge, sway) and `heave_hz` (their frequencies), return the registers up to 0x53.
    """
    data = BLOCK.pack(
        *(counts_of(a / ACCEL_M_S2_PER_LSB, 16) for a in accel_m_s2),
        *(counts_of(w / GYRO_RAD_S_PER_LSB, 16) for w in gyro_rad_s),
        *(counts_of(b / MAG_T_PER_LSB, 16) for b in mag_t),
        *(counts_of(angle / EULER_RAD_PER_LSB, 32) for angle in euler_rad),
        counts_of(temperature_c / TEMPERATURE_C_PER_LSB, 16),
        counts_of(pressure_pa / PRESSURE_PA_PER_LSB, 32),
        *(counts_of(q / quat_per_lsb, 16) for q in quat_wxyz),
        *incli_counts,
    )
    if uptime_ms is not None:
        data += UPTIME.pack(uptime_ms % 2**32)
    if heave_m is None:
        return data
    frequencies = (min(max(round(hz / HEAVE_HZ_PER_LSB), 0), 0xFFFF) for hz in heave_hz)
    return data + HEAVE.pack(*(counts_of(value / HEAVE_M_PER_LSB, 16) for value in heave_m), *frequencies)
