"""A configuration after reading and checking, and the differences between two of them."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

from imud.attitude.conventions import Convention
from imud.attitude.published import FrameOptions
from imud.contracts.lines import DeviceLines
from imud.contracts.setting import OnDifference
from imud.contracts.status import Deviations
from imud.model.options import Options
from imud.utc.receivers import RmcOptions


@dataclass(frozen=True, slots=True)
class DeviceConfig:
    """One device of the configuration."""

    name: str
    driver: str
    """A name in DRIVERS, or `auto`."""
    options: Options | None
    """Settings of the driver; None with driver `auto`."""
    identify: bool
    link: str
    """A name in LINKS."""
    link_settings: Options
    line: int = 0
    """Line of its name in the file; no property of the device."""
    lines: DeviceLines | None = None
    """GPIO lines of the device; None without any."""
    rmc: RmcOptions | None = None
    """Source of the RMC sentences that are sent to it; None for none."""
    declared: Options | None = None
    """Values that its own settings should have, an instance of `DeviceSettings.declarable`; None for no declaration."""
    on_difference: OnDifference = OnDifference.REPORT
    """What imud does where they are others."""
    frame: FrameOptions | None = None
    """How the sensor lies in its body; None to publish its own axes."""
    convention: Convention | None = None
    """Convention of what is published; None for the device's own, and for enu-flu beside `frame`."""
    declination_deg: float | None = None
    """True heading minus magnetic heading; None to leave the heading as it is."""
    noise: Deviations | None = None
    """What is known of the noise of its samples; None for nothing."""


@dataclass(frozen=True, slots=True)
class Config:
    """A whole configuration, checked."""

    log_level: str
    state_dir: str
    publishers: Mapping[str, Options]
    """Settings of every row of PUBLISHERS; defaults where the file has none."""
    devices: tuple[DeviceConfig, ...]
    """In the order of the file, without the disabled."""
    disabled: tuple[str, ...] = ()
    """Names of devices with `enabled: false`."""


@dataclass(frozen=True, slots=True)
class Differences:
    """Changes from one configuration to another, by name. `str()` of it is a sentence for the log."""

    devices_added: tuple[str, ...]
    devices_removed: tuple[str, ...]
    devices_changed: tuple[str, ...]
    publishers_changed: tuple[str, ...]
    keys_changed: tuple[str, ...]
    """Of `log_level` and `state_dir`."""

    def __str__(self) -> str:
        """For example `devices added: front, rear; publishers changed: metrics`, or `nothing differs`."""
        parts = ((field.name.replace("_", " "), getattr(self, field.name)) for field in fields(self))
        return "; ".join(f"{title}: {', '.join(names)}" for title, names in parts if names) or "nothing differs"


def differences(old: Config, new: Config) -> Differences:
    """List the changes in `new`. The order of devices in the file makes no difference."""
    before, after = ({d.name: _without_line(d) for d in config.devices} for config in (old, new))
    return Differences(
        devices_added=tuple(name for name in after if name not in before),
        devices_removed=tuple(name for name in before if name not in after),
        devices_changed=tuple(name for name in after if name in before and after[name] != before[name]),
        publishers_changed=tuple(
            name for name, settings in new.publishers.items() if settings != old.publishers.get(name)
        ),
        keys_changed=tuple(key for key in ("log_level", "state_dir") if getattr(old, key) != getattr(new, key)),
    )


def _without_line(device: DeviceConfig) -> tuple[object, ...]:
    return tuple(getattr(device, field.name) for field in fields(device) if field.name != "line")
