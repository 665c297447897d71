"""A check of every test of an output: no descriptor stays open."""

import os
from collections.abc import Iterator

import pytest


def open_descriptors() -> dict[int, str]:
    """Return the files of the open descriptors of this process."""
    found = {}
    for name in os.listdir("/proc/self/fd"):
        try:
            found[int(name)] = os.readlink(f"/proc/self/fd/{name}")
        except FileNotFoundError:  # of the listing itself
            continue
    return found


@pytest.fixture(autouse=True)
def _no_descriptor_left(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail if a test leaves a descriptor open. The tests of mqtt check this in their own way."""
    before = open_descriptors()
    yield
    if "mqtt" not in request.path.parts:
        assert {number: file for number, file in open_descriptors().items() if number not in before} == {}
