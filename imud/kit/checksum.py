"""Check values of the wire protocols, each by the name it has in the literature."""

import binascii
from typing import Final

crc16_xmodem: Final = binascii.crc_hqx
"""CRC-16/XMODEM: polynomial 0x1021, not reflected, no final XOR: `crc16_xmodem(data, crc)` with 0 as the first `crc`.

The check value of "123456789" is 0x31C3. This is the C function of the standard library itself, not a wrapper: a call
per frame is spared. A value that was reached before goes on with more data as `crc`.
"""
