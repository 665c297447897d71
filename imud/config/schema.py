"""Schema of the configuration file: keys of the daemon and of a device, and the tables that the rest comes from.

A new row of a table (DRIVERS, LINKS, PUBLISHERS) is configurable without a change here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, Protocol

import msgspec

from imud.contracts.claims import Claim
from imud.contracts.device_settings import DeviceSettings, OnDifference
from imud.contracts.driver import KeyProblem
from imud.contracts.lines import DeviceLines
from imud.contracts.settings import Settings
from imud.devices import DRIVERS
from imud.frames.conventions import Convention, Heading
from imud.links import LINKS
from imud.publishers import PUBLISHERS


class General(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of the daemon itself."""

    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level of messages in the log."""
    state_dir: Annotated[str, msgspec.Meta(min_length=1)] = "/var/lib/imud"
    """Folder of what imud remembers: at which rate each device was found, writes to flash, backups of settings.
    imud makes it where it is missing. A change counts from the next start. systemd's STATE_DIRECTORY wins over it."""


class DeviceGeneral(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a device itself, as opposed to those of its link and its driver."""

    driver: str = "auto"
    """Wire protocol of the device, or `auto`: detect it by listening."""
    enabled: bool = True
    """Whether imud uses the device; if not, its keys are checked all the same."""
    identify: bool = True
    """Whether imud may send queries (nothing that changes the device) to learn product, serial number and firmware. A
    device that does not answer is asked again after 5, 30 and 120 s, then every five minutes."""
    on_difference: OnDifference = OnDifference.REPORT
    """What imud does where the device is not as `settings` declare: report it, apply them, or apply and save to the
    device's flash."""
    convention: Convention | None = None
    """Axes and angles of what is published; null for the device's own, or with `frame` for enu-flu (docs/frames.md)."""
    declination_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)] | None = None
    """True north as seen from magnetic north, east positive: makes a magnetic heading true; null to leave it."""


class Row(Protocol):
    """Row of a table, as far as the configuration needs it."""

    @property
    def settings(self) -> type[Settings]:
        """The schema of the row's keys."""
        ...


class DriverRow(Row, Protocol):
    """Row of a driver, as far as the configuration needs it."""

    @property
    def lines(self) -> frozenset[str]:
        """GPIO lines that such a device can have."""
        ...

    @property
    def device_settings(self) -> DeviceSettings | None:
        """Settings that the device keeps itself; None for a driver that does not know them."""
        ...

    @property
    def declared_line_differences(self) -> Callable[[Mapping[str, Any], DeviceLines], Mapping[str, str]]:
        """Finds lines that declared settings contradict: why, by the line's key."""
        ...

    def problems(self, options: Any, link: Any) -> Sequence[KeyProblem]:
        """Return what does not work in the driver's options together with a link's settings."""
        ...

    @property
    def heading(self) -> Callable[[Any, Mapping[str, str]], Heading]:
        """Reference of yaw, from an instance of `settings` and the device's own settings (empty: not known yet)."""
        ...


class LinkRow(Row, Protocol):
    """Row of a link, as far as the configuration needs it."""

    @property
    def searchable(self) -> bool:
        """Whether `driver: auto` can identify the device on it."""
        ...

    @property
    def bus_of(self) -> Callable[[Any], str]:
        """Returns the name of the bus that settings of the link name, which devices share; empty without one."""
        ...

    @property
    def claims(self) -> Callable[[Any], Sequence[Claim]]:
        """What a link with these settings uses."""
        ...

    @property
    def problem(self) -> Callable[[Any, bool], str]:
        """Why these settings cannot be used, as far as that shows without opening a port."""
        ...

    def fits(self, driver: Any) -> bool:
        """Whether a driver can use such a link."""
        ...


@dataclass(frozen=True, slots=True)
class Tables:
    """The tables that the schema is made from."""

    drivers: Mapping[str, DriverRow]
    links: Mapping[str, LinkRow]
    publishers: Mapping[str, Row]


TABLES: Final = Tables(DRIVERS, LINKS, PUBLISHERS)
