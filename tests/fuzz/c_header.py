"""Builds and runs the fuzzer of imud.h: libFuzzer with AddressSanitizer and UndefinedBehaviorSanitizer."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tests.fuzz.shm import base
from tests.fuzz.worker import libfuzzer_options
from tests.support.files import ROOT

TARGET: Final = "c-header"
SOURCE: Final = ROOT / "tests/fuzz/ring.c"
INCLUDE: Final = ROOT / "imud/include"
INPUT_BYTES_MAX: Final = 512
INPUT_S_MAX: Final = 120
_PROGRAM: Final = "c-header-fuzzer"
_BASE: Final = "ring.base"


def build(folder: Path) -> str:
    """Compile the fuzzer into `folder`. Return the error message; empty if the build succeeded."""
    clang = shutil.which("clang")
    if clang is None:
        return "cannot find clang; try apt-get install clang libclang-rt-14-dev"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _BASE).write_bytes(base())
    options = ["-std=c99", "-g", "-O1", "-Wall", "-Wextra", "-Werror", f"-I{INCLUDE}"]
    sanitizers = ["-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"]
    command = [clang, *options, *sanitizers, str(SOURCE), "-o", str(folder / _PROGRAM)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return f"clang failed: {done.stderr.strip()}" if done.returncode else ""


def is_needed() -> bool:
    """Return whether a failed build is an error. In CI with root and apt-get, `make fuzz-deps` can install clang."""
    return os.environ.get("CI") == "true" and os.geteuid() == 0 and shutil.which("apt-get") is not None


def command(seconds: float, seed: int, folder: Path, grown: Path, inputs: Sequence[str]) -> list[str]:
    options = libfuzzer_options(seconds, seed, folder, inputs)
    return [
        str(folder.parent / _PROGRAM), f"-max_len={INPUT_BYTES_MAX}", f"-timeout={INPUT_S_MAX}", *options, str(grown),
    ]  # fmt: skip


def run_once(folder: Path, inputs: list[Path]) -> subprocess.CompletedProcess[str]:
    """Run each input once through the fuzzer in `folder`."""
    return subprocess.run(
        [str(folder / _PROGRAM), *map(str, inputs)], capture_output=True, text=True, check=False,
        env=environment(folder),
    )  # fmt: skip


def environment(folder: Path = Path("build/fuzz")) -> dict[str, str]:
    """Return the environment of the fuzzer, with the path of the initial ring."""
    return {**os.environ, "IMUD_FUZZ_RING": str(folder / _BASE)}
