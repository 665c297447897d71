"""Runs `imud demo` to its end with time limits for an emulated processor."""

import subprocess
import sys

PATIENT = """
import sys
from imud.cli import main
from imud.cli import demo
demo.START_LIMIT_S = demo.FOUND_LIMIT_S = demo.STOP_LIMIT_S = 60.0
sys.exit(main(["demo", "--plain", *sys.argv[1:]]))
"""
LIMIT_S = 200.0


def demo(*words: str) -> str:
    argv = [sys.executable, "-c", PATIENT, *words]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout
