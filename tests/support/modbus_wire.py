"""A simulated RS-485 line behind a pseudo-terminal, moved along by a thread of its own."""

import select
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from imud.formats.modbus import SLAVES
from imud.sim.hipnuc.modbus import ModbusLine, Slave, SlaveSettings
from imud.sim.ports.arrival import BARE_UART
from imud.sim.ports.pty import Adapter, PtyNode, SimulatedPort
from imud.units import NS_PER_S

LIMIT_S = 10.0
BAUD = 921600
"""The fastest, so that tests are."""


def serial_of(number: int) -> bytes:
    """Some serial number."""
    return (0xA000_0000_0000_0000 + number).to_bytes(8, "big")


def slave(address: int, *, baud: int = BAUD, serial: int = 0, **more: object) -> Slave:
    """A module; its serial number ends with its first address."""
    assert address in SLAVES
    return Slave(serial_of(serial or address), SlaveSettings(address, baud), **more)  # type: ignore[arg-type]  # passed on


@contextmanager
def wired(folder: Path, *slaves: Slave, echo: bool = False, chunk_bytes: int = 0) -> Iterator[tuple[Path, ModbusLine]]:
    """The path of a port with these modules on its line."""
    now_ns = time.monotonic_ns()
    line = ModbusLine(now_ns, slaves, echo=echo, chunk_bytes=chunk_bytes)
    node = PtyNode(folder / "line")
    port = SimulatedPort(line, node, Adapter(BARE_UART, now_ns))
    ended = threading.Event()
    failed: list[BaseException] = []

    def run() -> None:
        try:
            while not ended.is_set():
                now_ns = time.monotonic_ns()
                port.step(now_ns)
                wait_s = min(max(port.next_ns(now_ns) - time.monotonic_ns(), 0) / NS_PER_S, 0.05)
                if node.is_open:
                    select.select([node.fileno()], [], [], wait_s)
                else:
                    ended.wait(min(wait_s, 0.002))
        except BaseException as error:  # noqa: BLE001 - reported to the test below
            failed.append(error)

    thread = threading.Thread(target=run, name="line", daemon=True)
    thread.start()
    try:
        yield node.path, line
    finally:
        ended.set()
        thread.join(LIMIT_S)
        port.close()
        assert not failed, failed
