"""Registry of the links, one for each kind of port."""

from typing import Any

from imud.contracts.link import LinkType
from imud.contracts.registry import Registry

LINKS: Registry[LinkType[Any]] = Registry(
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
