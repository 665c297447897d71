"""A data-ready line. Another process sends its edges through a pipe, like the kernel through a descriptor."""

import asyncio
import os
import struct
import subprocess
import sys

from imud.contracts.lines import Edge, OnEdges, OnLineEnd

STAMP = struct.Struct("q")
MAKE_EDGES = """
import os, struct, sys, time
due_ns = time.monotonic_ns()
while True:
    due_ns += int(sys.argv[1])
    time.sleep(max(0, due_ns - time.monotonic_ns()) / 1e9)
    due_ns = max(due_ns, time.monotonic_ns() - 50_000)  # a sensor's edges never come in a heap
    os.write(1, struct.pack("q", time.monotonic_ns()))
"""


class PipeInput:
    """An `InputLine`. Synchronization: only the thread of the event loop."""

    title = "pipe"
    edges_lost = 0

    def __init__(self, every_ns: int) -> None:
        self._every_ns = every_ns
        self._process: subprocess.Popen[bytes] | None = None
        self._fd = -1
        self._number = 0
        self._on_edges: OnEdges | None = None

    def open(self) -> None:
        command = (sys.executable, "-c", MAKE_EDGES, str(self._every_ns))
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert self._process.stdout is not None
        self._fd = self._process.stdout.fileno()
        os.set_blocking(self._fd, False)

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        assert watch
        self._on_edges = on_edges
        asyncio.get_running_loop().add_reader(self._fd, self.drain)

    def fileno(self) -> int:
        return self._fd

    def drain(self) -> None:
        if self._on_edges is None:
            return
        try:
            data = os.read(self._fd, 64 * STAMP.size)
        except BlockingIOError:
            return
        edges = []
        for (t_ns,) in STAMP.iter_unpack(data):
            self._number += 1
            edges.append(Edge(t_ns, True, self._number))
        if edges:
            self._on_edges(edges)

    def level(self) -> bool:
        return False

    def close(self) -> None:
        """End the other process. A second call does nothing."""
        process, self._process, self._on_edges = self._process, None, None
        if process is not None:
            asyncio.get_running_loop().remove_reader(self._fd)
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()
