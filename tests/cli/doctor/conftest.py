"""A simulated host for each test."""

from pathlib import Path

import pytest

from tests.support.surroundings import Machine


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)
