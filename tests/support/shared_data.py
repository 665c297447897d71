"""Files to compare with that are not part of the repository: in the folder IMUD_SHARED, or ../shared/data beside it."""

from pathlib import Path
from typing import Final

import pytest

from tests.support.paths import SHARED

FOLDER: Final = SHARED / "data"


def shared(name: str) -> Path:
    """The path of a file; skips the test where it is not there."""
    path = FOLDER / name
    if not path.is_file():
        pytest.skip(f"{path} is not there: set IMUD_SHARED to the folder with {name}")
    return path
