"""Links: each owns one kind of port."""

from imud.kit.link import LinkType
from imud.kit.table import Table

LINKS: Table[LinkType] = Table(
    "link",
    {
        "uart": "imud.links.uart:LINK",
        "replay": "imud.links.replay:LINK",
        "memory": "imud.links.memory:LINK",
    },
)
