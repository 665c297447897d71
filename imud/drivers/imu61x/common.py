"""Common parts of the four IMU61x protocols: check value, units, product ids, filter codes, I2C addresses.

Manual "IMU61X Interface Protocol and Instructions". The table of its chapter 5 has misprints, and it does not define g.
imud follows the vendor's programs in both cases.
"""

import zlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, get_args

from msgspec import Meta

from imud.attitude.conventions import Heading
from imud.contracts.driver import DataSheet, SensorName
from imud.model.units import RAD_PER_DEG, STANDARD_GRAVITY_M_S2

CRC_START: Final = 0xFFFFFFFE  # start value for `zlib.crc32`, which inverts start value and result: register value 1
# Inversion of the result of `zlib.crc32`. Also the result over data with its check value, because the register is then
# 0.
CRC_INVERSION: Final = 0xFFFFFFFF


def crc32(data: bytes | bytearray | memoryview) -> int:
    """Return the CRC-32 of UART frames and I2C and SPI bursts: polynomial 0xEDB88320, reflected, start 1, no final XOR.

    It covers all bytes before the check value, with the frame header (note 2 of table 2 and the table in chapter 5 of
    the manual are misprints). The check value of "123456789" is 0x3A8639CB.
    """
    return zlib.crc32(data, CRC_START) ^ CRC_INVERSION


# --- units: the device sends floats in g, °/s, ° and °C ----------------------------------------------------------

# 1 g of the device is standard gravity (not defined in the manual; the vendor's driver uses 9.80665)
M_S2_PER_G: Final = STANDARD_GRAVITY_M_S2
RAD_S_PER_DEG_S: Final = RAD_PER_DEG  # 1 °/s of the device


# Readable convention of `euler_rad`. The vendor's driver assumes this order.
# The vendor contradicts itself about the axes: its ROS 1 driver reverses Y and Z, pitch and yaw, as for a device with Z
# down. Its ROS 2 driver and its serial library do not. imud passes on the values as sent. If a level device reports
# -9.8 m/s² in Z, its Z points down: `frame: {z_down: true}` in the configuration corrects it. imud reports this case
# when the device is at rest (`imud.attitude.gravity`).
EULER_CONVENTION: Final = (
    "ZYX, assumed (the manual states none): yaw about Z, then pitch about Y, then roll about X; right-handed; "
    "it is not known whether Z points up or down"
)
# Destination frame of the rotation `quat_wxyz`, which imud computes from the Euler angles
NAVIGATION_FRAME: Final = (
    "level, Z up (assumed, the manual states none; with the device's Z down it is Z down); "
    "heading from power-on or the last heading reset"
)


def relative_heading(_options: object, _settings: Mapping[str, Any]) -> Heading:
    """Return the reference of yaw: the device has no magnetometer (assumed, like NAVIGATION_FRAME)."""
    return Heading.RELATIVE


# --- identity (tables 22 and 28) --------------------------------------------------------------------------------------

# First seven of the eight bytes of PROD_ID, registers 0x6A … 0x71. The last byte is the product.
PRODUCT_ID_HEAD: Final = b"\x00\x00IMU61"
# Product by the last byte of PROD_ID
PRODUCTS: Final[Mapping[int, str]] = MappingProxyType(
    {ord("2"): "IMU612", ord("4"): "IMU614", ord("8"): "IMU618", ord("A"): "IMU6132A", ord("B"): "IMU6132B"}
)


def product_of(product_id: bytes) -> str | None:
    """Return the product in the eight bytes of PROD_ID; None if they are not from an IMU61x."""
    if len(product_id) != len(PRODUCT_ID_HEAD) + 1 or not product_id.startswith(PRODUCT_ID_HEAD):
        return None
    return PRODUCTS.get(product_id[-1])


def product_id_of(product: str) -> bytes:
    """Return the eight bytes of PROD_ID of a product. Raises ValueError for another name."""
    for last, name in PRODUCTS.items():
        if name == product:
            return PRODUCT_ID_HEAD + bytes([last])
    raise ValueError(f"expected one of {', '.join(PRODUCTS.values())}, got {product!r}")


# --- filters (table 21; parameter 31 of the UART has the same codes) --------------------------------------------------

# Low-pass filter: corner frequency of an IIR filter, or number of samples of a moving average
FilterName = Literal[
    "0.2 Hz", "1 Hz", "2 Hz", "5 Hz", "10 Hz", "15 Hz", "20 Hz", "25 Hz", "30 Hz", "35 Hz", "40 Hz", "47 Hz",
    "average 4", "average 16", "average 32", "average 64",
]  # fmt: skip
FILTERS: Final[tuple[FilterName, ...]] = get_args(FilterName)  # low-pass filters by code 0 … 15
FILTER_DEFAULT: Final = 0xBB  # 47 Hz for both sensors, the factory setting

FilterCode = Annotated[int, Meta(ge=0, le=len(FILTERS) - 1)]  # an index of FILTERS
FilterChoice = FilterName | FilterCode  # a filter by name, or by its code in table 21
ACCEL_FILTER: Final = Meta(
    description="low-pass filter of the accelerometer, by name or by code in the order of the names",
    extra={"section": "2.4.2, table 21"},
)
GYRO_FILTER: Final = Meta(
    description="low-pass filter of the gyroscope, as for the accelerometer",
    extra={"section": "2.4.2, table 21"},
)


def filter_code(choice: FilterChoice) -> int:
    """Return the code of a filter. Raises ValueError for an unknown name."""
    return choice if isinstance(choice, int) else FILTERS.index(choice)


def same_filter(declared: FilterChoice, actual: FilterChoice) -> bool:
    """Return whether two choices are the same filter, by name or by code."""
    return filter_code(declared) == filter_code(actual)


def filter_control(accel: int, gyro: int) -> int:
    """Return the value of FILTER_CTRL, accelerometer in the high half byte. Raises ValueError for codes not 0 … 15."""
    if not (0 <= accel < len(FILTERS) and 0 <= gyro < len(FILTERS)):
        raise ValueError(f"expected filter codes 0 … {len(FILTERS) - 1}, got {accel} (accel) and {gyro} (gyro)")
    return accel << 4 | gyro


def filter_codes(control: int) -> tuple[int, int]:
    """Return the codes (accelerometer, gyro) in a value of FILTER_CTRL. Its high byte is reserved."""
    return control >> 4 & 0xF, control & 0xF


# --- I2C addresses (parameter 30 of the UART sets it) -----------------------------------------------------------------

I2cAddress = Literal[0x18, 0x19, 0x1A, 0x1B]  # 7-bit address that a device can have
I2C_ADDRESSES: Final[tuple[I2cAddress, ...]] = get_args(I2cAddress)  # all I2C addresses, factory setting first
# An I2C address as hexadecimal text or as a number
I2cAddressChoice = Literal["0x18", "0x19", "0x1a", "0x1b", "0x1A", "0x1B", 0x18, 0x19, 0x1A, 0x1B]


def i2c_address(choice: int | str) -> int:
    return choice if isinstance(choice, int) else int(choice, 16)


def same_address(declared: int | str, actual: int | str) -> bool:
    """Return whether two choices are the same address."""
    return i2c_address(declared) == i2c_address(actual)


def filter_words(settings: Mapping[str, str], sensor: SensorName) -> str:
    """Return a description of the low-pass filter of a sensor from the device settings."""
    read = settings.get(f"{sensor}_filter")
    if read is not None:
        return f"low-pass {read}"
    accel, gyro = filter_codes(FILTER_DEFAULT)
    return f"low-pass {FILTERS[accel if sensor == 'accel' else gyro]} (factory setting; imud has not read the filter)"


SHEET: Final = DataSheet(
    document="Forsense IMU61x manual (IMU612, IMU614, IMU618, IMU6132A, IMU6132B): no noise figures for any model",
    filter_words=filter_words,
)
