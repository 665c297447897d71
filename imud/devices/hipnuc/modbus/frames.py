"""Modbus RTU requests and replies of HiPNUC modules on RS-485. Manual "IMU配置手冊" V1.5.9, sections 4.1 and 4.6.

    read    03 first(2) count(2)                   →  03 bytes data(2 × count)
    write   06 register(2) value(2)                →  the same
    50 0031 000A serial number(8) ID(2)            to address 0: the module of that serial number takes the ID
    50 0030 0006 lowest(2) highest(2) FF FF        to address 0: every module takes a random ID of that range

Registers have two bytes, high byte first. Requests stand here without address and CRC, which the line adds
(`imud.formats.modbus`); replies come with both. Whether 0x50 is answered is not stated: no answer is expected.
"""

import struct
from typing import Final

from imud.contracts.polling import Transfer
from imud.devices.hipnuc.modbus.registers import BY_NAME, IDENTITY_FIRST, IDENTITY_REGISTERS
from imud.errors import BadArgument, DeviceRefused
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

CUSTOM: Final = 0x50
SET_ID_BY_SERIAL: Final = 0x0031
RANDOMISE_IDS: Final = 0x0030
SERIAL_BYTES: Final = 8
NAME_BYTES: Final = 16
VERSIONS: Final = struct.Struct(">HH")
SERIAL_AT: Final = 2 * (BY_NAME["SN"].address - IDENTITY_FIRST)
"""Name, versions and serial number in registers 0x70 … 0x83."""
FACTORY_ID: Final = 0x50
WRITE_REPLY_BYTES: Final = 8

READ: Final = struct.Struct(">BHH")
WRITE: Final = READ
BY_SERIAL: Final = struct.Struct(">BHH8sH")
BY_CHANCE: Final = struct.Struct(">BHHHHH")


def read_registers(first: int, count: int) -> Transfer:
    """Read `count` registers from `first` on."""
    if not 1 <= count <= REGISTERS_MAX or not 0 <= first <= 0x10000 - count:
        raise BadArgument(f"read: expected 1 … {REGISTERS_MAX} registers of 0x0000 … 0xFFFF, got {count} at {first}")
    return Transfer((READ.pack(READ_HOLDING, first, count),), READ_OVERHEAD_BYTES + 2 * count)


def write_register(register: int, value: int) -> Transfer:
    """Write one register."""
    if not 0 <= register <= 0xFFFF or not 0 <= value <= 0xFFFF:
        raise BadArgument(f"write: expected register and value of 0 … 0xFFFF, got {value} to {register}")
    return Transfer((WRITE.pack(WRITE_SINGLE, register, value),), WRITE_REPLY_BYTES)


def set_id_by_serial(serial_number: str, new_id: int) -> Transfer:
    """Give the module with this serial number (16 hexadecimal digits) an ID; a broadcast."""
    check_id("ID", new_id)
    serial = serial_bytes(serial_number)
    data_bytes = len(serial) + 2
    return Transfer((BY_SERIAL.pack(CUSTOM, SET_ID_BY_SERIAL, data_bytes, serial, new_id),))


def randomise_ids(lowest: int, highest: int) -> Transfer:
    """Make every module choose a random ID from `lowest` to `highest`; a broadcast. Ranges of one ID are refused."""
    check_id("lowest ID", lowest)
    check_id("highest ID", highest)
    if lowest >= highest:
        raise BadArgument(f"random IDs: expected the lowest below the highest, got {lowest} … {highest}")
    return Transfer((BY_CHANCE.pack(CUSTOM, RANDOMISE_IDS, 6, lowest, highest, 0xFFFF),))


def check_id(name: str, value: int) -> int:
    """Check that an address is one of a slave. Raises BadArgument.

    The manual gives 1 … 128, 1 … 255 and 1 … 0xFF; Modbus has 1 … 247.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value not in SLAVES:
        raise BadArgument(f"{name}: expected {SLAVES.start} … {SLAVES.stop - 1}, got {value!r}")
    return value


def serial_bytes(serial_number: str) -> bytes:
    """A serial number as it is sent. Raises BadArgument."""
    try:
        serial = bytes.fromhex(serial_number)
    except ValueError:
        serial = b""
    if len(serial) != SERIAL_BYTES:
        digits = 2 * SERIAL_BYTES
        raise BadArgument(f"serial number: expected {digits} hexadecimal digits, got {serial_number!r}")
    return serial


def registers_of(reply: bytes, count: int) -> tuple[int, ...]:
    """The registers of a reply to a read. Raises DeviceRefused with the reason if it is none."""
    _check(reply, READ_HOLDING, READ_OVERHEAD_BYTES + 2 * count)
    if reply[2] != 2 * count:
        raise DeviceRefused(f"expected {2 * count} bytes of registers, the reply says {reply[2]}")
    return struct.unpack_from(f">{count}H", reply, 3)


def check_written(reply: bytes, request: Transfer) -> None:
    """Whether the reply confirms a write. Raises DeviceRefused with the reason if it does not."""
    _check(reply, WRITE_SINGLE, WRITE_REPLY_BYTES)
    if reply[1:-CRC_BYTES] != request.sends[0]:
        raise DeviceRefused(f"expected {request.sends[0].hex(' ')} to be confirmed, got {reply[1:-CRC_BYTES].hex(' ')}")


def _check(reply: bytes, function: int, size: int) -> None:
    if is_exception(reply):
        raise DeviceRefused(f"the module answered function 0x{reply[1] & 0x7F:02x} with {exception_text(reply[2])}")
    if len(reply) != size or not is_whole(reply):
        raise DeviceRefused(f"damaged reply of {len(reply)} bytes, expected {size}: {reply[:16].hex(' ')}")
    if reply[1] != function:
        raise DeviceRefused(f"expected a reply of function 0x{function:02x}, got 0x{reply[1]:02x}")


# --- the device's side ------------------------------------------------------------------------------------------------


def registers_reply(data: bytes) -> bytes:
    """A reply to a read, without address and CRC."""
    return bytes([READ_HOLDING, len(data)]) + data


def pack_identity(product: str, firmware: int, loader: int, serial: bytes) -> bytes:
    """Registers 0x70 … 0x83."""
    head = product.encode("ascii")[:NAME_BYTES].ljust(NAME_BYTES, b"\0") + VERSIONS.pack(firmware, loader)
    return (head.ljust(SERIAL_AT, b"\0") + serial).ljust(2 * IDENTITY_REGISTERS, b"\0")
