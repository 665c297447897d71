"""Table of the settings of an IMU61x on I2C: its low-pass filters. Manual, section 3.3.2."""

from collections.abc import Mapping
from typing import Any, Final

from imud.contracts.action import Target
from imud.contracts.device_settings import DeviceSettings
from imud.contracts.polling import TransferScript
from imud.devices.imu61x.common.register_driver import FilterControl, check_settings, filter_settings, filter_words
from imud.devices.imu61x.i2c.session import read_control, write_control


def _read(_target: Target) -> TransferScript[Mapping[str, Any]]:
    return filter_words((yield from read_control()))


SETTINGS: Final = DeviceSettings(
    table=filter_settings(FilterControl(read_control, write_control)), read=_read, check=check_settings
)
"""Lost when the device restarts; what it starts with is parameter 31 of its UART."""
