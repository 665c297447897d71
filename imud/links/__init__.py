"""Links: each owns one kind of port."""

from imud.kit.link import LinkType
from imud.kit.table import Table

LINKS: Table[LinkType] = Table(
    "link",
    {
        "uart": "imud.links.uart:LINK",
        "socketcan": "imud.links.socketcan:LINK",
        "i2c": "imud.links.i2c:LINK",
        "spi": "imud.links.spi:LINK",
        "rs485": "imud.links.rs485:LINK",
        "replay": "imud.links.replay:LINK",
        "memory": "imud.links.memory:LINK",
    },
)
