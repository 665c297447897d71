"""Table of the settings of an IMU61x on SPI: low-pass filters and kind of burst. Manual, sections 2.4.1 and 2.4.2."""

from collections.abc import Mapping
from typing import Annotated, Any, Final

from msgspec import Meta

from imud.contracts.action import Target
from imud.contracts.device_settings import DeviceSettings, Setting
from imud.contracts.polling import TransferScript
from imud.devices.imu61x.common.register_driver import FilterControl, check_settings, filter_settings, filter_words
from imud.devices.imu61x.spi.bursts import BurstKind
from imud.devices.imu61x.spi.session import read_control, read_state, write_control

Burst = Annotated[
    BurstKind,
    Meta(description="kind of burst by BURST_CTRL; `options.burst` sets it", extra={"section": "2.4.1, table 16"}),
]


def _read(_target: Target) -> TransferScript[Mapping[str, Any]]:
    state = yield from read_state()
    return {**filter_words(state.filter), "burst": state.kind}


SETTINGS: Final = DeviceSettings(
    table={**filter_settings(FilterControl(read_control, write_control)), "burst": Setting(type=Burst)},
    read=_read,
    check=check_settings,
)
"""Lost when the device restarts; the filters that it starts with are parameter 31 of its UART."""
