"""Two chips that are not there."""

import sys
from pathlib import Path

import pytest

from tests.support.signal_bench import FakeGpiod


@pytest.fixture
def gpiod(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeGpiod:
    """gpiochip0 with SOUT, a line without a name, TWIN; gpiochip10 with RESET, TWIN."""
    fake = FakeGpiod(
        tmp_path, gpiochip0=("pinctrl-bcm2711", ("SOUT", "", "TWIN")), gpiochip10=("expander", ("RESET", "TWIN"))
    )
    monkeypatch.setitem(sys.modules, "gpiod", fake)
    return fake
