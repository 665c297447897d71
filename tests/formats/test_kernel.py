"""The kernel is loaded if it belongs to its source. Otherwise imud knows why it does not use the kernel."""

import re
import sys
from pathlib import Path
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
    # Python 3.11 refuses the format unit `#` in a library that a later Python compiled
    assert not re.search(r'(?:ParseTuple|BuildValue)[^;]*"[^"\n]*#', kernel.SOURCE.read_text())


def test_a_file_is_at_its_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link, status = tmp_path / "é", tmp_path.stat()
    link.symlink_to(tmp_path)
    for found in (kernel.present, Kernel(None)):
        monkeypatch.setattr(kernel, "present", found)
        checked = [kernel.is_at(bytes(path), status.st_dev, status.st_ino) for path in (tmp_path, link, link / "no")]
        assert checked == [True, False, False]
        assert not kernel.is_at(bytes(tmp_path), status.st_dev, status.st_ino + 1)
        assert not kernel.is_at(bytes(tmp_path), status.st_dev + 1, status.st_ino)
