"""Table: the links by name, each for one kind of port."""

from typing import Any

from imud.contracts.link import LinkType
from imud.contracts.table import Table

LINKS: Table[LinkType[Any]] = Table(
    "link",
    {
        "uart": "imud.links.uart.link:LINK",
        "socketcan": "imud.links.can.link:LINK",
        "i2c": "imud.links.i2c:LINK",
        "spi": "imud.links.spi:LINK",
        "rs485": "imud.links.rs485.link:LINK",
        "replay": "imud.links.replay.link:LINK",
        "memory": "imud.links.memory:LINK",
    },
)
