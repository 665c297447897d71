"""The kernel is loaded if it belongs to its source. Otherwise imud knows why it does not use the kernel."""

import sys
from types import SimpleNamespace
from zlib import crc32

import pytest

from imud.formats import kernel
from imud.formats.kernel import Kernel


def test_the_kernel_of_the_present_source_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    made, older = SimpleNamespace(source_crc=crc32(kernel.SOURCE.read_bytes())), SimpleNamespace(source_crc=1)
    for found, module, start in (
        (made, made, ""), (older, None, "it was compiled from another version of imud/"),
        (None, None, "it is not installed: "),
    ):  # fmt: skip
        monkeypatch.setitem(sys.modules, "imud._kernel", found)
        assert (kernel.load("1").module, kernel.load(None).module) == (module, module)
        assert kernel.load(None).problem.startswith(start)
        assert kernel.load("0") == Kernel(None, "IMUD_KERNEL=0 switches it off")
