"""Independent programs: i2c-tools, can-utils, gpiod, spi-tools, iproute2."""

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
