"""Registers of the Forsense IMU61x on SPI and I2C: addresses, scales, identity. Manual, chapters 2.4 and 3.3.

    window 0    0x00 BURST                    0x0E … 0x28 TEMP, GYRO, ACCL: high word, then low word, each 16 bits
    window 1    0x06 FILTER_CTRL  0x0C BURST_CTRL  0x6A … 0x70 PROD_ID1 … 4
    both        0x7E WIN_CTRL

I2C has bytes instead of words, no windows, and its burst at 0x12. Scales of table 19; acceleration is in g (the manual
prints mg, with which a device at rest would show 1/1000 g).
"""

from collections.abc import Mapping
from typing import Annotated, Final

from msgspec import Meta

from imud.contracts.driver import Identity
from imud.contracts.settings import Settings
from imud.devices.imu61x.common.family import FILTERS, M_S2_PER_G, RAD_S_PER_DEG_S, filter_codes, product_of
from imud.devices.polled_frames import absence
from imud.errors import DeviceRefused
from imud.units import NS_PER_S

BURST: Final = 0x00
FILTER_CTRL: Final = 0x06
BURST_CTRL: Final = 0x0C
"""Its high byte, at 0x0D, selects the burst: 0 standard, 1 extended (the value is the vendor's, not the manual's)."""
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


# --- what can be configured on both buses ----------------------------------------------------------------------------

FilterCode = Annotated[int, Meta(ge=0, le=len(FILTERS) - 1)]


class RegisterSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an IMU61x on a polled bus."""

    accel_filter: FilterCode | None = None
    """Low-pass filter of the accelerometer, code 0 to 15 of table 21 (11: 47 Hz); null leaves it as it is."""
    gyro_filter: FilterCode | None = None
    """The same of the gyroscope."""
    update_hz: Annotated[float, Meta(ge=0, le=10000)] = 0.0
    """How often the device renews its registers, per second, for the error of time stamps; 0 for not known."""


def wanted_filter(settings: RegisterSettings, present: int) -> int:
    """The value that FILTER_CTRL should have, from what it has."""
    accel, gyro = filter_codes(present)
    accel = accel if settings.accel_filter is None else settings.accel_filter
    gyro = gyro if settings.gyro_filter is None else settings.gyro_filter
    return accel << 4 | gyro


def check_filter(wanted: int, got: int) -> None:
    """Raises DeviceRefused when FILTER_CTRL reads back otherwise than written."""
    if got & 0xFF != wanted:
        raise DeviceRefused(f"FILTER_CTRL: wrote {wanted:#04x}, read back {got & 0xFF:#04x}; is the bus too fast?")


def filter_words(control: int) -> Mapping[str, str]:
    """The filters for people."""
    accel, gyro = filter_codes(control)
    return {"accel_filter": FILTERS[accel], "gyro_filter": FILTERS[gyro]}


def update_ns(settings: RegisterSettings) -> int:
    """Time between two updates of the registers; 0 for not known."""
    return int(NS_PER_S / settings.update_hz) if settings.update_hz else 0


# --- who is it? ------------------------------------------------------------------------------------------------------


def identity_of(product_id: bytes) -> Identity:
    """Who has this PROD_ID. Raises DeviceRefused when it is none of the family, with what to look at."""
    product = product_of(product_id)
    if product is None:
        why = absence(product_id) or "another device, or the wrong SPI mode or speed?"
        raise DeviceRefused(f"PROD_ID: expected 00 00 'IMU61' and a letter, got {product_id.hex(' ')}: {why}")
    return Identity(product=product)
