"""Runs the tests of the C kernel with AddressSanitizer and UndefinedBehaviorSanitizer (`make sanitize`)."""

import os
import platform
import shutil
import subprocess
import sys
from typing import Final

from hatch_build import LIBRARY, SOURCE, compile_kernel
from tests.fuzz import c_header
from tests.support.files import ROOT

FOLDER: Final = ROOT / "build/sanitized"
OPTIONS: Final = (
    "-g", "-O1", "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror", "-shared-libasan", "-fno-sanitize-recover=all",
    "-fsanitize=address,undefined,float-cast-overflow",
)  # fmt: skip
TESTS: Final = (
    "tests/sampling/test_path_kernel.py",
    "tests/publishers/test_shm.py",
    "tests/publishers/socket/test_history.py",
    "tests/publishers/rules/test_limit.py",
    "tests/links/test_socketcan.py",
)
# The tests import `imud._kernel`, and find the module that is already loaded.
PROGRAM: Final = """
import sys
from importlib.util import module_from_spec, spec_from_file_location

spec = spec_from_file_location("imud._kernel", sys.argv[1])
module = sys.modules["imud._kernel"] = module_from_spec(spec)
spec.loader.exec_module(module)

import pytest

sys.exit(pytest.main(["-q", "-s", "-p", "no:cacheprovider", *sys.argv[2:]]))
"""


def build() -> str:
    """Compile the kernel with the sanitizers. Return the error message; empty if the build succeeded."""
    if shutil.which("clang") is None:
        return "cannot find clang; try make fuzz-deps"
    source = FOLDER / SOURCE
    source.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / SOURCE, source)
    return compile_kernel(FOLDER, "clang", OPTIONS)


def main() -> int:
    if problem := build():
        print(f"cannot test the kernel with sanitizers: {problem}", file=sys.stderr)
        return 1 if c_header.is_needed() else 0
    name = f"libclang_rt.asan-{platform.machine()}.so"
    found = subprocess.run(["clang", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
    environment = {
        **os.environ, "LD_PRELOAD": found.stdout.strip(), "PYTHONMALLOC": "malloc", "IMUD_KERNEL": "1",
        "ASAN_OPTIONS": "detect_leaks=0", "UBSAN_OPTIONS": "print_stacktrace=1",
    }  # fmt: skip
    command = [sys.executable, "-c", PROGRAM, str(FOLDER / LIBRARY), *TESTS, *sys.argv[1:]]
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
