"""Table: conversion factors to SI units, each the exact definition; a value times its factor is the SI value.

A factor that belongs to one sensor (counts to m/s²) is in that sensor's file, made from these.
"""

import math
from typing import Final

RAD_PER_DEG: Final = math.pi / 180
"""Degrees to radians; also °/s to rad/s."""

STANDARD_GRAVITY_M_S2: Final = 9.80665
"""1 g by ISO 80000-3, in m/s². Sensors that mean another g name their own."""

T_PER_UT: Final = 1e-6
"""Microtesla to tesla."""

PPM_PER_ONE: Final = 1_000_000
"""Parts per million in a ratio of 1."""

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000
NS_PER_US: Final = 1_000

BITS_PER_UART_BYTE: Final = 10
"""8N1: one start bit, eight data bits, one stop bit."""


def uart_byte_ns(baud: int) -> int:
    """Time one 8N1 byte takes on the wire at `baud` bit/s, in ns; 0 for a link without a wire time (baud 0)."""
    return BITS_PER_UART_BYTE * NS_PER_S // baud if baud else 0
