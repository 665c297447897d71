"""Independent programs: i2c-tools, can-utils, gpiod, spi-tools, iproute2. Also `imud demo`, as a process."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

LIMIT_S = 30.0


class ToolError(Exception):
    """A program ended with an exit status other than 0. The text is its standard error."""


def tool(*command: str, data: bytes | None = None) -> str:
    result = subprocess.run(command, input=data, capture_output=True, timeout=LIMIT_S, check=False)
    if result.returncode:
        raise ToolError(f"{' '.join(command)}: status {result.returncode}: {result.stderr.decode().strip()}")
    return result.stdout.decode("latin-1")


@contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=sys.stderr.fileno(), text=True)
    assert process.stdout is not None
    try:
        yield process
    finally:
        process.kill()
        process.wait(LIMIT_S)
        process.stdout.close()


PATIENT = """
import sys
from imud.cli import main
from imud.cli import demo
demo.START_LIMIT_S = demo.FOUND_LIMIT_S = demo.STOP_LIMIT_S = 60.0
sys.exit(main(["demo", "--plain", *sys.argv[1:]]))
"""
DEMO_LIMIT_S = 200.0  # for an emulated processor


def demo(*words: str) -> str:
    """Run `imud demo` to its end. Return its output."""
    argv = [sys.executable, "-c", PATIENT, *words]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=DEMO_LIMIT_S, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout
