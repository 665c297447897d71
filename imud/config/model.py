"""A checked configuration, and the differences between two configurations."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from imud.attitude.conventions import AttitudeSource, Convention
from imud.attitude.published import FrameOptions
from imud.contracts.condition import ConditionLimits
from imud.contracts.lines import DeviceLines
from imud.contracts.setting import OnDifference
from imud.contracts.status import Deviations
from imud.model.options import Options
from imud.utc.receivers import RmcOptions


@dataclass(frozen=True, slots=True)
class DeviceConfig:
    name: str
    driver: str  # name in DRIVERS, or `auto`
    options: Options | None  # options of the driver; None with driver `auto`
    identify: bool
    link: str  # name in LINKS
    link_settings: Options
    line: int = 0  # Line number of the name in the file. It is not a property of the device.
    lines: DeviceLines | None = None  # GPIO lines of the device; None if it has no lines
    rmc: RmcOptions | None = None  # source of the RMC sentences for the device; None if imud sends no sentences
    # Declared settings, an instance of `SettingsTable.declarable`; None if the configuration declares no settings.
    declared: Options | None = None
    on_difference: OnDifference = OnDifference.REPORT  # reaction of imud if a setting differs from its declaration
    frame: FrameOptions | None = None  # mounting of the sensor in its body; None to publish the sensor axes
    # Convention of the published samples; None: the convention of the device, or enu-flu if `frame` is set.
    convention: Convention | None = None
    # True heading minus magnetic heading, degrees; None: the heading stays unchanged.
    declination_deg: float | None = None
    noise: Deviations | None = None  # standard deviations of the samples; None if they are unknown
    condition: ConditionLimits = field(default_factory=ConditionLimits)
    attitude: AttitudeSource = AttitudeSource.DEVICE


@dataclass(frozen=True, slots=True)
class Config:
    """A complete and checked configuration."""

    log_level: str
    state_dir: str
    publishers: Mapping[str, Options]  # options of each row of PUBLISHERS, with defaults for absent keys
    devices: tuple[DeviceConfig, ...]  # enabled devices in the order of the file
    disabled: tuple[str, ...] = ()  # names of devices with `enabled: false`
    # Problems of other packages with drivers or outputs, each with the place of the device or output that imud ignores
    ignored: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Differences:
    """Changes between two configurations, by name. `str()` returns a sentence for the log."""

    devices_added: tuple[str, ...]
    devices_removed: tuple[str, ...]
    devices_changed: tuple[str, ...]
    publishers_changed: tuple[str, ...]
    keys_changed: tuple[str, ...]  # changed keys of the daemon: `log_level`, `state_dir`

    def __str__(self) -> str:
        """Return for example `devices added: front, rear; publishers changed: metrics`, or `nothing differs`."""
        parts = ((field.name.replace("_", " "), getattr(self, field.name)) for field in fields(self))
        return "; ".join(f"{title}: {', '.join(names)}" for title, names in parts if names) or "nothing differs"


def differences(old: Config, new: Config) -> Differences:
    """Return the changes in `new`. The order of devices in the file has no effect."""
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
