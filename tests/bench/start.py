"""Duration of a command from start to end: `imud --help`, `imud status`, and the import of the package.

A user or a script waits for these commands. The figure is therefore the elapsed time of a new process, median of ten.
The CPU time of the same processes is also a row, because other programs affect it less. The interpreter alone is the
minimum for every Python program.
"""

import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Final

from tests.bench.rig import Load, start_server
from tests.bench.rows import Row, at_most

ROOT: Final = Path(__file__).parents[2]
STARTS: Final = 10  # the rows show their median
LIMIT_MS: Final = 150.0  # goal for the elapsed time
TIMEOUT_S: Final = 60.0
NO_DAEMON: Final = 2
"""Exit status of `imud status` without a daemon."""
NOT_STREAMING: Final = 1  # exit status with a device without samples


def start_rows(name: str, *arguments: str, status: int = 0) -> Iterator[Row]:
    """Yield median time and CPU time of Python with these arguments, after one run that fills the caches.

    Raises RuntimeError if the exit status is not `status`, because a failed command is fast.
    """
    took_ms, cpu_ms = [], []
    for number in range(STARTS + 1):
        begin_ns, begin_cpu_ms = time.monotonic_ns(), _children_cpu_ms()
        done = subprocess.run(
            [sys.executable, *arguments], cwd=ROOT, capture_output=True, timeout=TIMEOUT_S, check=False
        )
        if number:
            took_ms.append((time.monotonic_ns() - begin_ns) / 1e6)
            cpu_ms.append(_children_cpu_ms() - begin_cpu_ms)
        if done.returncode != status:
            raise RuntimeError(f"{arguments}: expected exit status {status}, got {done.returncode}: {done.stderr!r}")
    yield at_most(f"start: {name}", median(took_ms), "ms", LIMIT_MS)
    yield Row(f"start: {name}, CPU", median(cpu_ms), "ms")


def _children_cpu_ms() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (used.ru_utime + used.ru_stime) * 1000


def rows(*, quick: bool = False) -> Iterator[Row]:
    yield from start_rows("the interpreter alone", "-c", "pass")
    yield from start_rows("import imud", "-c", "import imud")
    yield from start_rows("imud --help", "-m", "imud", "--help")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="imud-start-")))
        ask = ("-m", "imud", "status", "--socket", str(folder / "s"))
        yield from start_rows("imud status, no daemon", *ask, status=NO_DAEMON)
        near, far = os.openpty()
        stack.callback(os.close, near)
        stack.callback(os.close, far)
        start_server(stack, folder, [os.ttyname(far)], Load())
        yield from start_rows("imud status, one device", *ask, status=NOT_STREAMING)
