"""Check that each test closes the descriptors that it opens. A `conftest.py` that imports the fixture applies it."""

import os
from collections.abc import Iterator
from contextlib import suppress

import pytest


@pytest.fixture(autouse=True)
def _no_open_descriptor() -> Iterator[None]:
    before = open_descriptors()
    yield
    left = [target for number, target in open_descriptors().items() if before.get(number) != target]
    assert not left, f"the test left open: {left}"


def open_descriptors() -> dict[int, str]:
    """Return the target of each descriptor of this process."""
    found = {}
    for number in map(int, os.listdir("/proc/self/fd")):
        with suppress(FileNotFoundError):  # the descriptor of the listing itself
            found[number] = os.readlink(f"/proc/self/fd/{number}")
    return found
