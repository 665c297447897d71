"""Build of the kernel `imud/_kernel.c`: hook of hatchling, and a program (`python hatch_build.py`) for a checkout.

The kernel is optional. Without a C compiler or the headers of Python, or with IMUD_KERNEL=0, the build prints one line,
and imud uses its Python code. The kernel uses the limited API: one file works with Python 3.11 and all later versions.
"""

import os
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any
from zlib import crc32

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # as a program, without hatchling
    BuildHookInterface = object  # type: ignore[assignment,misc]

SOURCE = "imud/_kernel.c"
LIBRARY = "imud/_kernel.abi3.so"
# -ffp-contract=off: a fused product and sum would give other time stamps than Python
OPTIONS = ("-std=c11", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-fno-strict-aliasing")


def compile_kernel(root: Path, compiler: str = "", options: tuple[str, ...] = ()) -> str:
    """Compile the kernel below `root`. Return the reason if that is not possible, otherwise an empty text."""
    command = shlex.split(compiler or os.environ.get("CC", "") or "cc")
    include = sysconfig.get_paths()["include"]
    target = root / LIBRARY
    made = target.with_suffix(f".{os.getpid()}")  # a running imud keeps the old file
    source = root / SOURCE
    # imud does not use a library of another source
    version = f"-DSOURCE_CRC={crc32(source.read_bytes())}u"
    try:
        subprocess.run(
            [*command, *OPTIONS, *options, version, f"-I{include}", str(source), "-o", str(made), "-lm"],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        made.replace(target)
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    except subprocess.CalledProcessError as error:
        made.unlink(missing_ok=True)
        return next((line for line in error.stderr.splitlines() if "error" in line), f"status {error.returncode}")
    return ""


class KernelHook(BuildHookInterface):  # type: ignore[misc,type-arg,unused-ignore]
    """Adds the kernel to a wheel, or places it in the checkout of an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the kernel before the build."""
        is_off = os.environ.get("IMUD_KERNEL") == "0"
        problem = "IMUD_KERNEL=0" if is_off else compile_kernel(Path(self.root))
        if problem:
            print(f"imud is built without its C kernel, it uses more CPU time: {problem}", file=sys.stderr)
            return
        build_data["artifacts"].append(f"/{LIBRARY}")
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"cp311-abi3-{platform}"


def main() -> int:
    problem = compile_kernel(Path(__file__).parent, options=tuple(sys.argv[1:]))
    print(problem or f"compiled {LIBRARY}")
    return 1 if problem else 0


if __name__ == "__main__":
    sys.exit(main())
