"""Process that simulates an RS-485 bus and delivers each byte at the end of its wire time: `… BAUD ADDRESS …`.

The first printed line is the port. The process ends when its standard input closes.
"""

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from imud.sim.control import StandardInputControl
from imud.sim.hipnuc.modbus import ModbusLine, slaves_at
from imud.sim.ports.arrival import BARE_UART
from imud.sim.ports.pty import Adapter, PtyNode, SimulatedPort, sharpen_timers
from imud.sim.sensor import SimulatorOptions


def main() -> None:
    baud, *addresses = map(int, sys.argv[1:])
    now_ns = time.monotonic_ns()
    # one byte per chunk: the simulator delivers each byte separately
    line = ModbusLine(now_ns, slaves_at(addresses, SimulatorOptions(baud=baud)), chunk_bytes=1)
    sharpen_timers()
    with TemporaryDirectory(prefix="imud-bench-") as folder:
        port = SimulatedPort(line, PtyNode(Path(folder) / "line"), Adapter(BARE_UART, now_ns))
        print(port.node.path, flush=True)
        StandardInputControl(port, time.monotonic_ns).run()
        port.close()


if __name__ == "__main__":
    main()
