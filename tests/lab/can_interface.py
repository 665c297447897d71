"""CAN interfaces of the guest: virtual ones, and QEMU's two SJA1000 controllers on one bus."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.lab.tool import tool

BITRATE = 500_000


@dataclass(frozen=True)
class CanInterface:
    """A CAN network interface."""

    name: str

    def up(self) -> None:
        """Takes it into operation."""
        tool("ip", "link", "set", self.name, "up")

    def down(self) -> None:
        """Takes it out of operation: sockets on it get ENETDOWN."""
        tool("ip", "link", "set", self.name, "down")

    def statistic(self, name: str) -> int:
        """A kernel counter, such as rx_packets or tx_packets."""
        return int(Path(f"/sys/class/net/{self.name}/statistics/{name}").read_text(encoding="ascii"))


@contextmanager
def virtual_can(name: str) -> Iterator[CanInterface]:
    """A vcan interface of this name, up; it is deleted at the end."""
    tool("ip", "link", "add", "dev", name, "type", "vcan")
    interface = CanInterface(name)
    try:
        interface.up()
        yield interface
    finally:
        tool("ip", "link", "delete", name)


@contextmanager
def controller_pair(bitrate: int = BITRATE) -> Iterator[tuple[CanInterface, CanInterface]]:
    """can0 and can1, emulated SJA1000 controllers on one bus: real drivers, with bit timing and states."""
    pair = (CanInterface("can0"), CanInterface("can1"))
    try:
        for interface in pair:
            tool("ip", "link", "set", interface.name, "type", "can", "bitrate", str(bitrate))
            interface.up()
        yield pair
    finally:
        for interface in pair:
            interface.down()
