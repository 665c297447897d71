"""Summary of the conditions of all devices, and durations."""

import pytest

from imud.contracts.condition import Condition, duration, summary


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ({}, "The configuration has no devices."),
        ({"bow": "ok"}, "1 device is OK."),
        ({"bow": "missing"}, "1 device has a problem: bow (missing)."),
        ({"a": "ok", "b": "degraded", "c": "ok"}, "1 of 3 devices has a problem: b (degraded)."),
        ({"a": "ok", "b": "ok"}, "All 2 devices are OK."),
        (
            {f"d{n}": "attention" for n in range(6)},
            "6 of 6 devices have a problem: "
            "d0 (attention), d1 (attention), d2 (attention), d3 (attention), d4 (attention) and 1 more.",
        ),
    ],
)
def test_summary(words: dict[str, str], line: str) -> None:
    assert summary({name: Condition(word) for name, word in words.items()}) == line


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(-1, "0 s"), (119.9, "119 s"), (120, "2 min"), (7199, "119 min"), (7200, "2 h"), (172_800, "2 days")],
)
def test_duration(seconds: float, text: str) -> None:
    assert duration(int(seconds * 1e9)) == text
