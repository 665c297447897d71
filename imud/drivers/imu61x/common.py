"""Constants that the four wire protocols of the Forsense IMU61x share: check value, units, product ids, filter codes.

Manual "IMU61X Interface Protocol and Instructions". Departures from it: the table of its chapter 5 has misprints, and
it leaves g open; both are settled as the vendor's own programs have them.
"""

import zlib
from collections.abc import Mapping, Sequence
from math import isfinite
from random import Random
from types import MappingProxyType
from typing import Annotated, Final, Literal, get_args

from msgspec import Meta

from imud.attitude.conventions import Heading
from imud.contracts.driver import DataSheet, SensorName
from imud.model.sample import Vector3
from imud.model.units import RAD_PER_DEG, STANDARD_GRAVITY_M_S2

CRC_START: Final = 0xFFFFFFFE
"""`zlib.crc32` inverts its start value and its result: this start value stands for the register value 1."""
CRC_INVERSION: Final = 0xFFFFFFFF
"""What turns the result of `zlib.crc32` into the register's value. It is that result, too, over anything followed by
its own check value, which leaves 0 in the register."""


def crc32(data: bytes | bytearray | memoryview) -> int:
    """CRC-32 of UART frames and I2C and SPI bursts: reflected polynomial 0xEDB88320, start value 1, no final XOR.

    It covers everything before the check value, frame header included (the manual's note 2 of table 2 and its table
    in chapter 5 are misprinted). The check value of "123456789" is 0x3A8639CB.
    """
    return zlib.crc32(data, CRC_START) ^ CRC_INVERSION


# --- units: floats of the device are in g, °/s, ° and °C --------------------------------------------------------------

M_S2_PER_G: Final = STANDARD_GRAVITY_M_S2
"""1 g of the device is standard gravity (the manual leaves it open; the vendor's own driver takes 9.80665)."""
RAD_S_PER_DEG_S: Final = RAD_PER_DEG
"""1 °/s of the device."""


def scaled(values: Sequence[float], factor: float) -> Vector3 | None:
    """Three 32-bit floats times `factor`; None where one of them is NaN or infinite."""
    x, y, z = values
    # three 32-bit floats cannot add up to a 64-bit infinity
    return (x * factor, y * factor, z * factor) if isfinite(x + y + z) else None


def random_vector(random: Random, spread: float) -> Vector3:
    """Three random numbers around zero, for the examples of the shared property tests."""
    return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))


EULER_CONVENTION: Final = (
    "ZYX, assumed (the manual states none): yaw about Z, then pitch about Y, then roll about X; right-handed; "
    "whether Z points up or down is not settled"
)
"""Of `euler_rad`. The order is that for which the vendor's own driver takes the angles.

The vendor contradicts itself about the axes: its driver for ROS 1 turns Y and Z, pitch and yaw about, as for a device
whose Z points down; its driver for ROS 2 and its serial library do not. Values are passed on as sent. A device that
lies level and shows -9.8 m/s² in Z has its Z down: then `frame: {z_down: true}` in the configuration makes them right,
and imud says so when it sees that device at rest (`imud.attitude.gravity`)."""
NAVIGATION_FRAME: Final = (
    "level, Z up (assumed, the manual states none; with the device's Z down it is Z down); "
    "heading from power-on or the last heading reset"
)
"""The frame that `quat_wxyz`, computed from the Euler angles, turns into."""


def relative_heading(_settings: object, _read_back: Mapping[str, str]) -> Heading:
    """Return the reference of yaw: the module has no magnetometer (assumed, as NAVIGATION_FRAME)."""
    return Heading.RELATIVE


# --- identity (tables 22 and 28) --------------------------------------------------------------------------------------

PRODUCT_ID_HEAD: Final = b"\x00\x00IMU61"
"""The first seven of the eight bytes of PROD_ID, in the order of the registers 0x6A … 0x71; the last is the product."""
PRODUCTS: Final[Mapping[int, str]] = MappingProxyType(
    {ord("2"): "IMU612", ord("4"): "IMU614", ord("8"): "IMU618", ord("A"): "IMU6132A", ord("B"): "IMU6132B"}
)
"""Product by the last byte of PROD_ID."""


def product_of(product_id: bytes) -> str | None:
    """The product that the eight bytes of PROD_ID name; None if they are not those of an IMU61x."""
    if len(product_id) != len(PRODUCT_ID_HEAD) + 1 or not product_id.startswith(PRODUCT_ID_HEAD):
        return None
    return PRODUCTS.get(product_id[-1])


def product_id_of(product: str) -> bytes:
    """The eight bytes of PROD_ID of a product. Raises ValueError for a name that is none of PRODUCTS."""
    for last, name in PRODUCTS.items():
        if name == product:
            return PRODUCT_ID_HEAD + bytes([last])
    raise ValueError(f"expected one of {', '.join(PRODUCTS.values())}, got {product!r}")


# --- filters (table 21; parameter 31 of the UART has the same codes) --------------------------------------------------

FilterName = Literal[
    "0.2 Hz", "1 Hz", "2 Hz", "5 Hz", "10 Hz", "15 Hz", "20 Hz", "25 Hz", "30 Hz", "35 Hz", "40 Hz", "47 Hz",
    "average 4", "average 16", "average 32", "average 64",
]  # fmt: skip
"""A low-pass filter: corner frequency of an IIR filter, or number of samples of a moving average."""
FILTERS: Final[tuple[FilterName, ...]] = get_args(FilterName)
"""Low-pass filters by code 0 … 15."""
FILTER_DEFAULT: Final = 0xBB
"""47 Hz for both, as delivered."""
FILTER_CODES: Final = ", ".join(f"{code} = {name}" for code, name in enumerate(FILTERS))
"""Table 21 in a line, for help and documents."""
FilterCode = Annotated[int, Meta(ge=0, le=len(FILTERS) - 1)]
"""An index of FILTERS."""
FilterChoice = FilterName | FilterCode
"""A filter by name, or by its code of table 21."""
ACCEL_FILTER: Final = Meta(
    description="low-pass filter of the accelerometer, by name, or by its code in the order of the names",
    extra={"section": "2.4.2, table 21"},
)
GYRO_FILTER: Final = Meta(
    description="low-pass filter of the gyroscope, by name or code as that of the accelerometer",
    extra={"section": "2.4.2, table 21"},
)


def filter_code(choice: FilterChoice) -> int:
    """The code of a filter. Raises ValueError for a name that is none."""
    return choice if isinstance(choice, int) else FILTERS.index(choice)


def same_filter(declared: FilterChoice, actual: FilterChoice) -> bool:
    """Whether two choices are the same filter, by name or by code."""
    return filter_code(declared) == filter_code(actual)


def filter_control(accel: int, gyro: int) -> int:
    """The value of FILTER_CTRL, accelerometer's code in the high half byte. Raises ValueError for codes not 0 … 15."""
    if not (0 <= accel < len(FILTERS) and 0 <= gyro < len(FILTERS)):
        raise ValueError(f"expected filter codes 0 … {len(FILTERS) - 1}, got {accel} (accel) and {gyro} (gyro)")
    return accel << 4 | gyro


def filter_codes(control: int) -> tuple[int, int]:
    """The codes (accelerometer, gyro) in a value of FILTER_CTRL; its high byte is reserved."""
    return control >> 4 & 0xF, control & 0xF


# --- I2C addresses (parameter 30 of the UART sets it) -----------------------------------------------------------------

I2cAddress = Literal[0x18, 0x19, 0x1A, 0x1B]
"""A 7-bit address that a device can have."""
I2C_ADDRESSES: Final[tuple[I2cAddress, ...]] = get_args(I2cAddress)
"""All I2C addresses, the factory setting first."""
I2cAddressChoice = Literal["0x18", "0x19", "0x1a", "0x1b", "0x1A", "0x1B", 0x18, 0x19, 0x1A, 0x1B]
"""An I2C address as it is shown, in hexadecimal, or as a number."""


def i2c_address(choice: int | str) -> int:
    """The address of a choice."""
    return choice if isinstance(choice, int) else int(choice, 16)


def same_address(declared: int | str, actual: int | str) -> bool:
    """Whether two choices are the same address."""
    return i2c_address(declared) == i2c_address(actual)


def filter_words(settings: Mapping[str, str], sensor: SensorName) -> str:
    """Describe the low-pass filter of a sensor, from the settings as read back."""
    read = settings.get(f"{sensor}_filter")
    if read is not None:
        return f"low-pass {read}"
    accel, gyro = filter_codes(FILTER_DEFAULT)
    return f"low-pass {FILTERS[accel if sensor == 'accel' else gyro]} as delivered; it was not read back"


SHEET: Final = DataSheet(
    document="Forsense IMU61x manual (IMU612, IMU614, IMU618, IMU6132A, IMU6132B): no figure of noise for any model",
    filter_words=filter_words,
)
