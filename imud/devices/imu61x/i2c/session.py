"""Transfer scripts of the Forsense IMU61x on I2C: identity and low-pass filters. Manual, sections 3.3.2 and 3.3.3.

S addr W 0x06 | Sr addr R  FILTER_CTRL, 1 byte          S addr W 0x06 value P
S addr W 0x6A | Sr addr R  PROD_ID, 8 bytes
"""

from collections.abc import Mapping
from typing import Final

from imud.contracts.driver import Identity
from imud.contracts.polling import Transfer, TransferScript
from imud.devices.imu61x.common.family import PRODUCT_ID_HEAD, product_of
from imud.devices.imu61x.common.register_driver import (
    RegisterSettings,
    check_filter,
    filter_words,
    identity_of,
    wanted_filter,
)
from imud.devices.imu61x.common.registers import FILTER_CTRL, PROD_ID

READ_FILTER: Final = Transfer((bytes([FILTER_CTRL]),), 1)
READ_ID: Final = Transfer((bytes([PROD_ID]),), len(PRODUCT_ID_HEAD) + 1)


def write_filter(control: int) -> Transfer:
    """Write FILTER_CTRL (figure 8)."""
    return Transfer((bytes([FILTER_CTRL, control]),))


def probe(_settings: RegisterSettings) -> TransferScript[Identity]:
    """Read PROD_ID. Raises DeviceRefused for anything but an IMU61x."""
    return identity_of((yield READ_ID))


def set_up(settings: RegisterSettings) -> TransferScript[Mapping[str, str]]:
    """Write FILTER_CTRL where it differs, read it back. Raises DeviceRefused if it is not the value written."""
    present = yield from read_control()
    wanted = wanted_filter(settings, present)
    if present != wanted:
        yield from write_control(wanted)
    return filter_words(wanted)


def read_control() -> TransferScript[int]:
    """Read FILTER_CTRL."""
    return _only((yield READ_FILTER))


def write_control(control: int) -> TransferScript[None]:
    """Write FILTER_CTRL and read it back. Raises DeviceRefused if it is not the value written."""
    yield write_filter(control)
    check_filter(control, (yield from read_control()))


def id_problem(data: bytes) -> str:
    """Compare a PROD_ID that was read later; an empty string if it is the same."""
    return "" if product_of(data) is not None else f"wrong product id {data.hex(' ')}"


def filter_problem(data: bytes, settings: RegisterSettings) -> str:
    """Compare a FILTER_CTRL that was read later; an empty string if it is as set up."""
    wanted = wanted_filter(settings, _only(data))
    if data == bytes([wanted]):
        return ""
    return f"FILTER_CTRL is {data.hex()}, was set to {wanted:#04x}: the device restarted"


def _only(data: bytes) -> int:
    return data[0] if data else 0
