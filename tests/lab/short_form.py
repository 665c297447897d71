"""The short form of the lab: `-m "not thorough"` deselects the marked tests and parameters."""

from collections.abc import Iterable
from typing import Any

import pytest


def cases(all_of: Iterable[str], *kept: str) -> list[Any]:
    """Return parameters. The short form has only the parameters in `kept`."""
    names = list(all_of)
    assert set(kept) <= set(names), f"expected names of {names}, got {kept}"
    return [pytest.param(name, marks=() if name in kept else pytest.mark.thorough) for name in names]
