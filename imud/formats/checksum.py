"""Check values of the wire protocols, each by the name it has in the literature."""

import binascii
from typing import Final

crc16_xmodem: Final = binascii.crc_hqx
"""CRC-16/XMODEM: polynomial 0x1021, not reflected, no final XOR: `crc16_xmodem(data, crc)` with 0 as the first `crc`.

The check value of "123456789" is 0x31C3. This is the C function of the standard library itself, not a wrapper: a call
per frame is spared. A value that was reached before goes on with more data as `crc`.
"""


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS: reflected polynomial 0xA001, start value 0xFFFF, no final XOR. "123456789" gives 0x4B37.

    The check value goes low byte first behind what it covers; over both together the result is 0. The standard library
    has none; a table takes 60 ns a byte, where a frame of 57 bytes takes 5 ms on its wire.
    """
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _MODBUS[(crc ^ byte) & 0xFF]
    return crc


def _modbus_of(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


_MODBUS: Final = tuple(map(_modbus_of, range(256)))
