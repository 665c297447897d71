"""The kernel `imud/_kernel.c`, if it is installed for this Python: the results of the Python code in less CPU time.

The value 0 of the environment variable IMUD_KERNEL switches the kernel off.
"""

import os
from importlib import import_module
from types import ModuleType
from typing import NamedTuple


class Kernel(NamedTuple):
    """The loaded kernel, or the reason why there is none."""

    module: ModuleType | None
    problem: str = ""  # one sentence; empty if the kernel is loaded


def load(setting: str | None) -> Kernel:
    """Load the kernel. `setting` is the value of IMUD_KERNEL."""
    if setting == "0":
        return Kernel(None, "IMUD_KERNEL=0 switches it off")
    try:
        return Kernel(import_module("imud._kernel"))
    except ImportError as error:
        return Kernel(None, f"it is not installed: {error}")


# Kernel of this process. Users read it at each call, so that a test can replace it.
present = load(os.environ.get("IMUD_KERNEL"))
