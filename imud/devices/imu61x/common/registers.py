"""Table of the registers of the Forsense IMU61x on SPI and I2C: addresses and scales. Manual, chapters 2.4 and 3.3.

    window 0    0x00 BURST                    0x0E … 0x28 TEMP, GYRO, ACCL: high word, then low word, each 16 bits
    window 1    0x06 FILTER_CTRL  0x0C BURST_CTRL  0x6A … 0x70 PROD_ID1 … 4
    both        0x7E WIN_CTRL

I2C has bytes instead of words, no windows, and its burst at 0x12. Scales of table 19; acceleration is in g (the manual
prints mg, with which a device at rest would show 1/1000 g).
"""

from typing import Final

from imud.devices.imu61x.common.family import M_S2_PER_G, RAD_S_PER_DEG_S

BURST: Final = 0x00
FILTER_CTRL: Final = 0x06
BURST_CTRL: Final = 0x0C
"""The high byte, at 0x0D, selects the burst: 0 standard, 1 extended (the vendor's value, not the manual's)."""
TEMP_HIGH: Final = 0x0E
ZACCEL_LOW: Final = 0x28
PROD_ID: Final = 0x6A
"""The first of four words, 0x6A to 0x70; on I2C of eight bytes."""
WIN_CTRL: Final = 0x7E
I2C_BURST: Final = 0x12
"""The text of 3.3.1; table 26 prints 0x00."""

M_S2_PER_COUNT: Final = 0.2 / 65536 * M_S2_PER_G
"""Burst: 327680 counts are 1 g."""
M_S2_PER_COUNT_REGISTER: Final = 0.2 / 1000 / 65536 * M_S2_PER_G
"""Single registers: 65536 counts, one step of the high word, are 0.0002 g."""
RAD_S_PER_COUNT: Final = 0.016 / 65536 * RAD_S_PER_DEG_S
"""Burst and single registers: 4096000 counts are 1 °/s."""
TEMPERATURE_ZERO_COUNTS: Final = 172_621_824
"""2634 · 65536: the count at 25 °C."""
C_PER_COUNT: Final = -1 / 263.4 / 65536


def temperature_c(counts: int) -> float:
    """Temperature of TEMP, high and low word joined."""
    return (counts - TEMPERATURE_ZERO_COUNTS) * C_PER_COUNT + 25.0


def temperature_counts(celsius: float) -> int:
    """The inverse, for the device's side."""
    return round((celsius - 25.0) / C_PER_COUNT) + TEMPERATURE_ZERO_COUNTS
