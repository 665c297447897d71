"""CAN interfaces of the guest: virtual interfaces, and two SJA1000 controllers of QEMU on one bus."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.lab.tool import tool

BITRATE = 500_000
FAULT = Path("/sys/module/imud_lab/parameters/can_fault")
COUNTERS = Path("/sys/module/imud_lab/parameters/can_counters")
MODE_RESET = b"\x01"
"""Value of the mode register, the first register of an SJA1000: only bit RM is set."""


@dataclass(frozen=True)
class CanInterface:
    name: str

    def up(self) -> None:
        tool("ip", "link", "set", self.name, "up")

    def down(self) -> None:
        """Set the interface down. Sockets on it receive ENETDOWN."""
        tool("ip", "link", "set", self.name, "down")

    def enter(self, state: str) -> None:
        """Report an error state to the driver of the controller: `error-passive`, `bus-off` or `error-active`.

        A controller in the state bus-off neither sends nor receives until its restart. The function therefore sets the
        emulated chip to reset mode, like an SJA1000 does itself (data sheet, 6.4.4: bit RM of the mode register).
        """
        if state == "bus-off":
            with open(f"/sys/class/net/{self.name}/device/resource1", "r+b", buffering=0) as registers:
                registers.write(MODE_RESET)
        FAULT.write_text(f"{self.name} {state}", encoding="ascii")

    @contextmanager
    def error_counters(self, tx: int, rx: int) -> Iterator[None]:
        """Let the driver report these error counters during the block. The emulated chip always has 0."""
        COUNTERS.write_text(f"{self.name} {tx} {rx}", encoding="ascii")
        try:
            yield
        finally:
            COUNTERS.write_text(f"{self.name} 0 0", encoding="ascii")

    def restart(self) -> None:
        """Restart a controller in the state bus-off, like an administrator."""
        tool("ip", "link", "set", self.name, "type", "can", "restart")

    def restart_by_itself(self, after_ms: int) -> None:
        self.down()
        tool("ip", "link", "set", self.name, "type", "can", "restart-ms", str(after_ms))
        self.up()


@contextmanager
def virtual_can(name: str) -> Iterator[CanInterface]:
    """Create a vcan interface with this name and set it up. Delete it at the end."""
    tool("ip", "link", "add", "dev", name, "type", "vcan")
    interface = CanInterface(name)
    try:
        interface.up()
        yield interface
    finally:
        tool("ip", "link", "delete", name)


@contextmanager
def controller_pair(bitrate: int = BITRATE) -> Iterator[tuple[CanInterface, CanInterface]]:
    """Return can0 and can1, emulated SJA1000 controllers on one bus, with real drivers, bit timing and error states."""
    pair = (CanInterface("can0"), CanInterface("can1"))
    try:
        for interface in pair:
            tool("ip", "link", "set", interface.name, "type", "can", "bitrate", str(bitrate), "restart-ms", "0")
            interface.up()
        yield pair
    finally:
        for interface in pair:
            interface.down()
