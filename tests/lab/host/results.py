"""The output folder: one folder per active run, and the kept files of ended runs."""

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.lab.host.errors import LabError

LOGS = ("console.log", "qemu.log", "machine.log")
REPORT = "junit.xml"
LEFTOVER_S = 86400  # age of a folder that no run uses


@contextlib.contextmanager
def run_folder(output: Path) -> Iterator[Path]:
    """Make a new folder below `output` for one run and remove it afterwards. Any number of runs can be active."""
    try:
        output.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(output)
        folder = Path(tempfile.mkdtemp(prefix="run-", dir=output.absolute()))
    except OSError as error:
        raise LabError(f"output folder {output}: {error.strerror}") from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def keep(folder: Path, output: Path, failed: bool) -> list[Path]:
    """Move the report, and after a failure the logs, to `output`. Remove older files. Return the kept logs."""
    _move(folder / REPORT, output / REPORT)
    if failed:
        return [output / name for name in LOGS if _move(folder / name, output / name)]
    for name in LOGS:
        (output / name).unlink(missing_ok=True)
    return []


def _move(source: Path, target: Path) -> bool:
    """Replace the target by the source. Remove the target if the source is missing or empty."""
    target.unlink(missing_ok=True)
    if not source.exists() or source.stat().st_size == 0:
        return False
    os.replace(source, target)
    return True


def _remove_leftovers(output: Path) -> None:
    """Remove folders of killed runs. They are one day old, so that no active run uses them."""
    for folder in output.glob("run-*"):
        if folder.stat().st_mtime < time.time() - LEFTOVER_S:
            shutil.rmtree(folder, ignore_errors=True)
