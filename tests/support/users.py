"""Contract: processes of other users of this machine, for tests of what they may not do; only root can make them."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import pytest

from tests.support.files import ROOT

DAEMON_UID: Final = 65534
HOSTILE_UID: Final = 65533

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can run a process as another user")


@contextmanager
def python_as(uid: int, program: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A Python program of the user `uid`, without groups; killed at the end."""
    command = [sys.executable, "-X", "dev", "-c", program, *arguments]
    with subprocess.Popen(
        command, cwd=ROOT, user=uid, group=uid, extra_groups=[],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()
