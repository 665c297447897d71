"""How long a command takes from its start to its end: `imud --help`, `imud status`, and the import of the package.

What waits is a person or a script in a loop, so that it is the time that passes, a new process each, the median of ten.
The CPU time of the same starts is beside it, which other programs disturb less, and the interpreter alone: nothing in
Python is faster.
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
STARTS: Final = 10
LIMIT_MS: Final = 150.0
TIMEOUT_S: Final = 60.0
NO_DAEMON: Final = 2
"""Exit status of `imud status` without a daemon."""
NOT_STREAMING: Final = 1


def start_rows(name: str, *arguments: str, status: int = 0) -> Iterator[Row]:
    """Median time and CPU time of runs of Python with these arguments, after one that fills the caches.

    Raises RuntimeError where it does not end as expected: an error would be quick.
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
            raise RuntimeError(f"{arguments} ended with {done.returncode}, expected {status}: {done.stderr!r}")
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
