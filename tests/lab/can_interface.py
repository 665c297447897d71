"""CAN interfaces of the guest: virtual ones, and QEMU's two SJA1000 controllers on one bus."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.lab.tool import tool

BITRATE = 500_000
FAULT = Path("/sys/module/imud_lab/parameters/can_fault")
COUNTERS = Path("/sys/module/imud_lab/parameters/can_counters")
MODE_RESET = b"\x01"
"""Mode register, the first of an SJA1000, with bit RM alone."""


@dataclass(frozen=True)
class CanInterface:
    name: str

    def up(self) -> None:
        tool("ip", "link", "set", self.name, "up")

    def down(self) -> None:
        """Takes it out of operation: sockets on it get ENETDOWN."""
        tool("ip", "link", "set", self.name, "down")

    def enter(self, state: str) -> None:
        """Lets the controller's driver see an error state: `error-passive`, `bus-off`, `error-active`.

        A controller that is bus-off takes no part in the bus until it is restarted, so it is put into reset mode, as
        an SJA1000 puts itself (data sheet, 6.4.4: bit RM of the mode register is set).
        """
        if state == "bus-off":
            with open(f"/sys/class/net/{self.name}/device/resource1", "r+b", buffering=0) as registers:
                registers.write(MODE_RESET)
        FAULT.write_text(f"{self.name} {state}", encoding="ascii")

    @contextmanager
    def error_counters(self, tx: int, rx: int) -> Iterator[None]:
        """Has its driver report these error counters for as long as the block; the emulated chip's stay 0."""
        COUNTERS.write_text(f"{self.name} {tx} {rx}", encoding="ascii")
        try:
            yield
        finally:
            COUNTERS.write_text(f"{self.name} 0 0", encoding="ascii")

    def restart(self) -> None:
        """Restarts a controller that is bus-off, as an administrator does."""
        tool("ip", "link", "set", self.name, "type", "can", "restart")

    def restart_by_itself(self, after_ms: int) -> None:
        self.down()
        tool("ip", "link", "set", self.name, "type", "can", "restart-ms", str(after_ms))
        self.up()

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
            tool("ip", "link", "set", interface.name, "type", "can", "bitrate", str(bitrate), "restart-ms", "0")
            interface.up()
        yield pair
    finally:
        for interface in pair:
            interface.down()
