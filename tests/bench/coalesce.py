"""What `coalesce_ms` saves: CPU of reading 16 ports at 1,000 frames a second each. Run: python -m tests.bench.coalesce

A child process writes the frames; only this process, which runs the links and does nothing with the bytes, is measured.
"""

import asyncio
import os
import subprocess
import sys
import time
from collections.abc import Iterator

from imud.links.uart.link import UartLink, UartSettings
from tests.bench.rows import Row
from tests.support.pty_port import PtyPort

PORTS = 16
FRAME_BYTES = 82
COALESCE_MS = (0, 2, 5)
WRITER = f"""
import os, sys, time
ports = [int(fd) for fd in sys.argv[1:]]
due = time.monotonic()
while True:
    for fd in ports:
        try:
            os.write(fd, bytes({FRAME_BYTES}))
        except BlockingIOError:
            pass
    due += 0.001
    time.sleep(max(0.0, due - time.monotonic()))
"""


async def read_for(links: list[UartLink], seconds: float) -> tuple[int, int, float]:
    """Bytes, reads and CPU seconds of reading all links so long."""
    size = reads = 0

    def on_data(data: bytes, t_rx_ns: int) -> None:
        nonlocal size, reads
        size += len(data)
        reads += 1

    for link in links:
        link.open()
        link.start(on_data, print)
    spent_s = time.process_time()
    await asyncio.sleep(seconds)
    spent_s = time.process_time() - spent_s
    for link in links:
        link.close()
    return size, reads, spent_s


def measure(coalesce_ms: int, seconds: float) -> tuple[int, int, float]:
    """One run with fresh ports and a fresh writer."""
    ports = [PtyPort() for _ in range(PORTS)]
    masters = [port.master for port in ports]
    for fd in masters:
        os.set_inheritable(fd, True)
    with subprocess.Popen([sys.executable, "-c", WRITER, *map(str, masters)], pass_fds=masters) as writer:
        links = [UartLink(UartSettings(port=port.path, coalesce_ms=coalesce_ms)) for port in ports]
        try:
            return asyncio.run(read_for(links, seconds))
        finally:
            writer.terminate()
            for port in ports:
                port.unplug()


def rows(*, quick: bool = False) -> Iterator[Row]:
    """CPU and reads per frame for each setting."""
    for coalesce_ms in COALESCE_MS:
        size, reads, spent_s = measure(coalesce_ms, 1 if quick else 4)
        frames = size / FRAME_BYTES
        yield Row(f"read {PORTS} ports at 1 kHz, coalesce {coalesce_ms} ms: CPU", spent_s / frames * 1e6, "us/frame")
        yield Row(f"read {PORTS} ports at 1 kHz, coalesce {coalesce_ms} ms: reads", reads / frames, "per frame")


if __name__ == "__main__":
    for row in rows():
        print(f"{row.name:64} {row.value:8.3f} {row.unit}")
