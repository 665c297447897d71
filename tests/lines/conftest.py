"""Fixtures: two simulated GPIO chips, and a check for descriptors that stay open."""

import sys
from pathlib import Path

import pytest

from tests.support.leaks import _no_open_descriptor
from tests.support.signal_bench import FakeGpiod

__all__ = ["_no_open_descriptor"]


@pytest.fixture
def gpiod(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeGpiod:
    """gpiochip0 with SOUT, a line without a name, TWIN; gpiochip10 with RESET, TWIN."""
    fake = FakeGpiod(
        tmp_path, gpiochip0=("pinctrl-bcm2711", ("SOUT", "", "TWIN")), gpiochip10=("expander", ("RESET", "TWIN"))
    )
    monkeypatch.setitem(sys.modules, "gpiod", fake)
    return fake
