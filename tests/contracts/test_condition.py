"""Summary of the conditions of all devices, and durations."""

import pytest

from imud.contracts import condition as conditions
from imud.contracts.condition import Condition, DeviceCondition, Reason, ReasonCode
from tests.support.documented import check_schema

MISSING = "devices have a problem: a (missing), b (missing), c (missing), d (missing), e (missing)"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ({}, "The configuration has no devices."), ({"bow": "ok"}, "1 device is OK."),
        ({"bow": "missing"}, "1 device has a problem: bow (missing)."),
        ({"a": "ok", "b": "degraded", "c": "ok"}, "1 of 3 devices has a problem: b (degraded)."),
        ({"a": "ok", "b": "ok"}, "All 2 devices are OK."), (dict.fromkeys("abcde", "missing"), f"5 of 5 {MISSING}."),
        (dict.fromkeys("abcdef", "missing"), f"6 of 6 {MISSING} and 1 more."),
    ],
)  # fmt: skip
def test_summary(words: dict[str, str], line: str) -> None:
    assert conditions.summary({name: Condition(word) for name, word in words.items()}) == line


def test_durations_and_documented_limits() -> None:
    assert check_schema("Limits of the condition", conditions.ConditionLimits) == 6
    for seconds, text in (
        (-1, "0 s"), (119.9, "119 s"), (120, "2 min"), (7199, "119 min"), (7200, "2 h"), (172_800, "2 days"),
    ):  # fmt: skip
        assert conditions.duration(int(seconds * 1e9)) == text


def test_each_reason_has_one_condition_and_ok_reasons_are_no_signature() -> None:
    names = {"ok": conditions.OK, "degraded": conditions.DEGRADED, "missing": conditions.MISSING}
    found = {code: next((name for name, codes in names.items() if code in codes), "attention") for code in ReasonCode}
    assert {code: conditions.condition_of(code) for code in ReasonCode} == found
    reasons = (Reason(ReasonCode.LOST, "Lost."), Reason(ReasonCode.NONE_LOST, "None lost."))
    for condition, is_ok, text in ((Condition.OK, True, "ok"), (Condition.DEGRADED, False, "degraded")):
        made = DeviceCondition(condition, 0, reasons)
        assert (made.is_ok, str(made)) == (is_ok, f"{text}: Lost. None lost.")
        assert conditions.signature(made) == {("lost", "")}
    assert conditions.signature(None) == frozenset()
