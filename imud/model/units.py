"""Conversion factors to SI units, each by its exact definition. Value times factor is the SI value.

A factor of one sensor (counts to m/s²) is in the file of that sensor.
"""

import math
from typing import Final

RAD_PER_DEG: Final = math.pi / 180  # degrees to radians; also °/s to rad/s

STANDARD_GRAVITY_M_S2: Final = 9.80665  # 1 g by ISO 80000-3, m/s². Sensors with another g define their own constant.

T_PER_UT: Final = 1e-6  # microtesla to tesla

PPM_PER_ONE: Final = 1_000_000  # parts per million in a ratio of 1

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000
NS_PER_US: Final = 1_000

BITS_PER_UART_BYTE: Final = 10  # bits of one 8N1 byte: one start bit, eight data bits, one stop bit


def uart_byte_ns(baud: int) -> int:
    """Return the time of one 8N1 byte on the wire at `baud` bit/s, ns; 0 for baud 0 (a link without wire time)."""
    return BITS_PER_UART_BYTE * NS_PER_S // baud if baud else 0
