"""The tables that the schema is made from: a new row of one is configurable without a change here."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

from imud.contracts.settings import Settings
from imud.devices import DRIVERS
from imud.links import LINKS
from imud.publishers import PUBLISHERS


class Row(Protocol):
    """What the configuration needs to know of a row of a table."""

    @property
    def settings(self) -> type[Settings]:
        """The schema of the row's keys."""
        ...


class DriverRow(Row, Protocol):
    """What the configuration needs to know of a driver besides."""

    @property
    def lines(self) -> frozenset[str]:
        """Wires besides its data that such a device can have."""
        ...


class LinkRow(Row, Protocol):
    """What the configuration needs to know of a link besides."""

    @property
    def searchable(self) -> bool:
        """Whether `driver: auto` finds out what talks on it."""
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
