"""Serial ports of the guest: pseudo terminals, and two 8250 UARTs wired to each other."""

import os
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PseudoTerminal:
    path: Path
    far_fd: int
    """Descriptor of the controlling end, blocking."""

    def write(self, data: bytes) -> None:
        while data:
            data = data[os.write(self.far_fd, data) :]

    def read(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            data += os.read(self.far_fd, size - len(data))
        return data


@contextmanager
def pseudo_terminal() -> Iterator[PseudoTerminal]:
    far_fd, near_fd = os.openpty()
    try:
        tty.setraw(near_fd)
        yield PseudoTerminal(Path(os.ttyname(near_fd)), far_fd)
    finally:
        os.close(near_fd)
        os.close(far_fd)


def uart_pair() -> tuple[Path, Path]:
    """Return the device nodes of two connected UARTs (16550A on PCI, driver 8250)."""
    first, second = sorted(
        Path("/dev") / port.name
        for port in Path("/sys/class/tty").glob("ttyS*")
        if "/pci" in str((port / "device").resolve())
    )
    return first, second
