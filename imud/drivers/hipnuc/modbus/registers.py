"""Modbus registers of HiPNUC devices: manual "IMU配置手冊" V1.5.9, section 4.2, and registers of newer firmware.

Values of two registers have the high word first. Differences from the table in the manual: the quaternion is signed;
its scale is 2⁻¹⁵ in older firmware and 0.0001 in newer firmware (the codec decides by the values). 0.011 of the
inclinometer is 360/32768 or 180/32768, by product. MAIN_STATUS, MAG_CALIBRATION, MAG_PROGRESS and UPTIME are registers
of newer firmware, as in the vendor's programs. The registers from HEAVE to SWAY_HZ and the IDs 129 … 247 are from the
vendor's documents of newer firmware.
"""

import struct
from dataclasses import dataclass
from enum import StrEnum
from math import tau
from typing import Final, Literal, get_args

from imud.contracts.script import Transfer
from imud.drivers.hipnuc.common import (
    ACCEL_M_S2_PER_LSB,
    EULER_RAD_PER_LSB,
    GYRO_RAD_S_PER_LSB,
    MAG_T_PER_LSB,
    PRESSURE_PA_PER_LSB,
    TEMPERATURE_C_PER_LSB,
)
from imud.formats.modbus import (
    CRC_BYTES,
    READ_HOLDING,
    READ_OVERHEAD_BYTES,
    REGISTERS_MAX,
    SLAVES,
    WRITE_SINGLE,
    exception_text,
    is_exception,
    is_whole,
)
from imud.model.errors import BadArgument, DeviceRefused


class Access(StrEnum):
    """Permitted accesses to a register."""

    READ = "R"
    WRITE = "W"
    BOTH = "R/W"


@dataclass(frozen=True, slots=True)
class Register:
    """Value in the registers: address, width, and scale to SI."""

    name: str
    address: int
    kind: str  # u16, i16, u32, i32, or text
    count: int  # number of registers
    access: Access
    meaning: str
    scale: float = 1.0  # SI value of one count; 1 for a plain number, or if the codec decides the scale
    unit: str = ""  # SI unit; empty for a plain number
    values: tuple[int, ...] | range = ()  # writable values; empty without a limit


QUAT_OLD_PER_LSB: Final = 2.0**-15
INCLI_SINGLE_RAD_PER_LSB: Final = tau / 32768
INCLI_DUAL_RAD_PER_LSB: Final = tau / 2 / 32768

BaudRate = Literal[4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600, 256000]
# Baud rates by their code in UART1_BAUD (section 4.3.2). Code 9 is from the vendor's programs, not from the manual.
BAUD_RATES: Final[tuple[BaudRate, ...]] = get_args(BaudRate)
FACTORY_BAUD: Final[BaudRate] = 115200
ID_MAX: Final = SLAVES.stop - 1  # maximum ID of register MD_ID in newer firmware
MANUAL_ID_MAX: Final = 128  # maximum ID of register MD_ID in the manual; higher IDs require the serial number
HEAVE_M_PER_LSB: Final = 0.01
HEAVE_HZ_PER_LSB: Final = 0.01

_R, _W, _RW = Access.READ, Access.WRITE, Access.BOTH

# in the order of their addresses
REGISTERS: Final = (
    Register("CTRL", 0x00, "u16", 1, _W, "0 saves all settings, 1 restores the factory settings, 0xFF restarts",
             values=(0x0000, 0x0001, 0x00FF)),
    Register("UART1_BAUD", 0x04, "u16", 1, _RW, "baud rate by code, after a restart", values=range(len(BAUD_RATES))),
    Register("MD_ID", 0x05, "u16", 1, _RW, "address on the bus, effective immediately", values=range(1, ID_MAX + 1)),
    Register("HEADING_MODE", 0x06, "u16", 1, _RW, "0 six axes, heading from power-on; 1 nine axes", values=(0, 1)),
    Register("MAIN_STATUS", 0x09, "u16", 1, _R, "status bits, as in HI91"),
    Register("MAG_CALIBRATION", 0x0A, "u16", 1, _R, "state of the magnetic calibration"),
    Register("MAG_PROGRESS", 0x0B, "u16", 1, _R, "progress of the magnetic calibration in percent"),
    Register("ACCX", 0x34, "i16", 1, _R, "acceleration X", ACCEL_M_S2_PER_LSB, "m/s²"),
    Register("ACCY", 0x35, "i16", 1, _R, "acceleration Y", ACCEL_M_S2_PER_LSB, "m/s²"),
    Register("ACCZ", 0x36, "i16", 1, _R, "acceleration Z", ACCEL_M_S2_PER_LSB, "m/s²"),
    Register("GYRX", 0x37, "i16", 1, _R, "angular rate X", GYRO_RAD_S_PER_LSB, "rad/s"),
    Register("GYRY", 0x38, "i16", 1, _R, "angular rate Y", GYRO_RAD_S_PER_LSB, "rad/s"),
    Register("GYRZ", 0x39, "i16", 1, _R, "angular rate Z", GYRO_RAD_S_PER_LSB, "rad/s"),
    Register("MAGX", 0x3A, "i16", 1, _R, "magnetic field X", MAG_T_PER_LSB, "T"),
    Register("MAGY", 0x3B, "i16", 1, _R, "magnetic field Y", MAG_T_PER_LSB, "T"),
    Register("MAGZ", 0x3C, "i16", 1, _R, "magnetic field Z", MAG_T_PER_LSB, "T"),
    Register("ROLL", 0x3D, "i32", 2, _R, "roll", EULER_RAD_PER_LSB, "rad"),
    Register("PITCH", 0x3F, "i32", 2, _R, "pitch", EULER_RAD_PER_LSB, "rad"),
    Register("YAW", 0x41, "i32", 2, _R, "yaw, counter-clockwise", EULER_RAD_PER_LSB, "rad"),
    Register("TEMP", 0x43, "i16", 1, _R, "temperature", TEMPERATURE_C_PER_LSB, "°C"),
    Register("PRS", 0x44, "i32", 2, _R, "air pressure", PRESSURE_PA_PER_LSB, "Pa"),
    Register("Q0", 0x46, "i16", 1, _R, "quaternion W, scale by firmware"),
    Register("Q1", 0x47, "i16", 1, _R, "quaternion X"),
    Register("Q2", 0x48, "i16", 1, _R, "quaternion Y"),
    Register("Q3", 0x49, "i16", 1, _R, "quaternion Z"),
    Register("INCLI_X", 0x4A, "i16", 1, _R, "inclinometer X, ±180° or 0 … 360°, scale by product", unit="rad"),
    Register("INCLI_Y", 0x4B, "i16", 1, _R, "inclinometer Y, ±90°; reserved in single-axis products", unit="rad"),
    Register("UPTIME", 0x4C, "u32", 2, _R, "time since power-on", 0.001, "s"),
    Register("HEAVE", 0x4E, "i16", 1, _R, "heave", HEAVE_M_PER_LSB, "m"),
    Register("SURGE", 0x4F, "i16", 1, _R, "surge", HEAVE_M_PER_LSB, "m"),
    Register("SWAY", 0x50, "i16", 1, _R, "sway", HEAVE_M_PER_LSB, "m"),
    Register("HEAVE_HZ", 0x51, "u16", 1, _R, "frequency of the heave", HEAVE_HZ_PER_LSB, "Hz"),
    Register("SURGE_HZ", 0x52, "u16", 1, _R, "frequency of the surge", HEAVE_HZ_PER_LSB, "Hz"),
    Register("SWAY_HZ", 0x53, "u16", 1, _R, "frequency of the sway", HEAVE_HZ_PER_LSB, "Hz"),
    Register("PNAME", 0x70, "text", 8, _R, "product, ASCII"),
    Register("SW_VERSION", 0x78, "u16", 1, _R, "firmware, 152 for 1.5.2"),
    Register("BL_VERSION", 0x79, "u16", 1, _R, "boot loader"),
    Register("SN", 0x7F, "text", 4, _R, "serial number, eight bytes"),
    Register("SET_LV", 0xA5, "u16", 1, _W, "2 level here, 3 only when nearly level, 5 cancels", values=(2, 3, 5)),
    Register("URFR", 0xA6, "u16", 1, _W, "mounting: 0 level, 1 Y down, 2 Y up, 3 X up, 4 X down", values=range(5)),
)  # fmt: skip

BY_NAME: Final = {register.name: register for register in REGISTERS}

BLOCK_FIRST: Final = BY_NAME["ACCX"].address
HEAVE_REGISTERS: Final = 6  # HEAVE … SWAY_HZ
# 0x34 … 0x53: the block of products with heave
LONG_BLOCK_REGISTERS: Final = BY_NAME["HEAVE"].address + HEAVE_REGISTERS - BLOCK_FIRST
# 0x34 … 0x4D: all other measured values and the device time
BLOCK_REGISTERS: Final = BY_NAME["UPTIME"].address + 2 - BLOCK_FIRST
# 0x34 … 0x4B: the block of firmware without UPTIME
SHORT_BLOCK_REGISTERS: Final = BY_NAME["UPTIME"].address - BLOCK_FIRST
IDENTITY_FIRST: Final = BY_NAME["PNAME"].address
IDENTITY_REGISTERS: Final = 20  # 0x70 … 0x83, as in the example of the manual (section 4.4)

CUSTOM: Final = 0x50
SET_ID_BY_SERIAL: Final = 0x0031
RANDOMISE_IDS: Final = 0x0030
SERIAL_BYTES: Final = 8
NAME_BYTES: Final = 16
VERSIONS: Final = struct.Struct(">HH")
SERIAL_AT: Final = 2 * (BY_NAME["SN"].address - IDENTITY_FIRST)  # offset of the serial number in registers 0x70 … 0x83
FACTORY_ID: Final = 0x50
WRITE_REPLY_BYTES: Final = 8

READ: Final = struct.Struct(">BHH")
WRITE: Final = READ
BY_SERIAL: Final = struct.Struct(">BHH8sH")
BY_CHANCE: Final = struct.Struct(">BHHHHH")


def read_registers(first: int, count: int) -> Transfer:
    """Return the transfer that reads `count` registers from `first`."""
    if not 1 <= count <= REGISTERS_MAX or not 0 <= first <= 0x10000 - count:
        raise BadArgument(f"read: expected 1 … {REGISTERS_MAX} registers of 0x0000 … 0xFFFF, got {count} at {first}")
    return Transfer((READ.pack(READ_HOLDING, first, count),), READ_OVERHEAD_BYTES + 2 * count)


def write_register(register: int, value: int) -> Transfer:
    """Return the transfer that writes one register."""
    if not 0 <= register <= 0xFFFF or not 0 <= value <= 0xFFFF:
        raise BadArgument(f"write: expected register and value of 0 … 0xFFFF, got {value} to {register}")
    return Transfer((WRITE.pack(WRITE_SINGLE, register, value),), WRITE_REPLY_BYTES)


def set_id_by_serial(serial_number: str, new_id: int) -> Transfer:
    """Return the broadcast that sets the ID of the device with this serial number (16 hexadecimal digits)."""
    check_id("ID", new_id)
    serial = serial_bytes(serial_number)
    data_bytes = len(serial) + 2
    return Transfer((BY_SERIAL.pack(CUSTOM, SET_ID_BY_SERIAL, data_bytes, serial, new_id),))


def randomise_ids(lowest: int, highest: int) -> Transfer:
    """Return the broadcast that makes every device choose a random ID from `lowest` to `highest`, at least two IDs."""
    check_id("lowest ID", lowest)
    check_id("highest ID", highest)
    if lowest >= highest:
        raise BadArgument(f"random IDs: expected the lowest below the highest, got {lowest} … {highest}")
    return Transfer((BY_CHANCE.pack(CUSTOM, RANDOMISE_IDS, 6, lowest, highest, 0xFFFF),))


def check_id(name: str, value: int) -> int:
    """Return a valid slave address. Raises BadArgument."""
    # the manual gives 1 … 128, 1 … 255 and 1 … 0xFF; Modbus has 1 … 247
    if isinstance(value, bool) or not isinstance(value, int) or value not in SLAVES:
        raise BadArgument(f"{name}: expected {SLAVES.start} … {SLAVES.stop - 1}, got {value!r}")
    return value


def serial_bytes(serial_number: str) -> bytes:
    """Return the bytes of a serial number. Raises BadArgument."""
    try:
        serial = bytes.fromhex(serial_number)
    except ValueError:
        serial = b""
    if len(serial) != SERIAL_BYTES:
        digits = 2 * SERIAL_BYTES
        raise BadArgument(f"serial number: expected {digits} hexadecimal digits, got {serial_number!r}")
    return serial


def registers_of(reply: bytes, count: int) -> tuple[int, ...]:
    """Return the registers of a reply to a read. Raises DeviceRefused for another reply."""
    _check(reply, READ_HOLDING, READ_OVERHEAD_BYTES + 2 * count)
    if reply[2] != 2 * count:
        raise DeviceRefused(f"expected {2 * count} bytes of registers, got a reply of {reply[2]}")
    return struct.unpack_from(f">{count}H", reply, 3)


def check_written(reply: bytes, request: Transfer) -> None:
    """Raise DeviceRefused if the reply does not confirm a write."""
    _check(reply, WRITE_SINGLE, WRITE_REPLY_BYTES)
    if reply[1:-CRC_BYTES] != request.sends[0]:
        raise DeviceRefused(
            f"expected the confirmation {request.sends[0].hex(' ')}, got {reply[1:-CRC_BYTES].hex(' ')}"
        )


def _check(reply: bytes, function: int, size: int) -> None:
    if is_exception(reply):
        raise DeviceRefused(f"the device replied to function 0x{reply[1] & 0x7F:02x} with {exception_text(reply[2])}")
    if len(reply) != size or not is_whole(reply):
        raise DeviceRefused(f"damaged reply of {len(reply)} bytes, expected {size}: {reply[:16].hex(' ')}")
    if reply[1] != function:
        raise DeviceRefused(f"expected a reply of function 0x{function:02x}, got 0x{reply[1]:02x}")


# --- encoder for simulated devices ------------------------------------------------------------------------------


def registers_reply(data: bytes) -> bytes:
    """Return a reply to a read, without address and CRC."""
    return bytes([READ_HOLDING, len(data)]) + data


def pack_identity(product: str, firmware: int, loader: int, serial: bytes) -> bytes:
    """Return registers 0x70 … 0x83."""
    head = product.encode("ascii")[:NAME_BYTES].ljust(NAME_BYTES, b"\0") + VERSIONS.pack(firmware, loader)
    return (head.ljust(SERIAL_AT, b"\0") + serial).ljust(2 * IDENTITY_REGISTERS, b"\0")
