"""What an IMU61x on I2C or SPI can be told by name: the low-pass filters; all else is set over its UART."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import msgspec

from imud.contracts.action import Action, Actions, Target
from imud.contracts.polling import TransferScript
from imud.contracts.settings import Settings
from imud.devices.imu61x.common.registers import FilterCode, RegisterSettings
from imud.errors import BadArgument

S = TypeVar("S", bound=RegisterSettings)


class FilterParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Low-pass filters."""

    accel_filter: FilterCode | None = None
    """Code of table 21 (11: 47 Hz); null leaves it as it is."""
    gyro_filter: FilterCode | None = None
    """The same of the gyroscope."""


def filter_actions(set_up: Callable[[S], TransferScript[Mapping[str, str]]]) -> Actions:
    """The actions of a device whose driver sets it up, and reads back, by `set_up`."""

    def set_filter(target: Target, params: FilterParams) -> TransferScript[Mapping[str, str]]:
        settings: S = target.settings
        for name in FilterParams.__struct_fields__:
            wanted, configured = getattr(params, name), getattr(settings, name)
            if None not in (wanted, configured) and wanted != configured:
                raise BadArgument(f"{name}: expected {configured}, which `options.{name}` says, got {wanted}")
        given = {name: code for name, code in msgspec.structs.asdict(params).items() if code is not None}
        return set_up(msgspec.structs.replace(settings, **given))

    return {
        "filter": Action(
            "set the low-pass filters until it restarts, and answer what they are; `options` set them for good",
            set_filter,
            FilterParams,
        )
    }
