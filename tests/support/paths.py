"""Where the tests find the files of the repository, and recordings that stay out of it."""

import os
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
SHARED: Final = Path(os.environ.get("IMUD_SHARED") or ROOT.parent / "shared")
