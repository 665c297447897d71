"""Waiting for samples, in virtual time."""

from collections.abc import Callable, Sequence

import pytest

from imud.cli.setup.steps import reasons, samples_table, wait_for_samples
from imud.contracts.status import DeviceState, DeviceStatus
from imud.model.errors import ImudError, LinkMissing
from tests.support.metrics import device

SEARCHING = device("bow", state=DeviceState.SEARCHING, problem="nothing is heard")


def waited(
    answers: Callable[[float], Sequence[DeviceStatus]], names: Sequence[str]
) -> tuple[list[DeviceStatus], float]:
    now = [0.0]

    def sleep(s: float) -> None:
        now[0] += s

    found = wait_for_samples(lambda: list(answers(now[0])), names, 30.0, lambda: now[0], sleep)
    return found, now[0]


def test_waiting_ends_four_seconds_after_all_run_or_at_the_limit() -> None:
    found, end_s = waited(lambda now: [device("bow"), device("other")] if now >= 3 else [SEARCHING], ["bow"])
    assert [one.name for one in found] == ["bow"]
    assert end_s == 7.0
    found, end_s = waited(lambda now: [SEARCHING if 2 <= now < 5 else device("bow")], ["bow"])
    assert (found[0].state, end_s) == ("running", 9.0)
    found, end_s = waited(lambda _: [SEARCHING, device("mast")], ["bow", "mast"])
    assert ([one.state for one in found], end_s) == (["searching", "running"], 30.0)


def test_a_daemon_that_never_answers_is_an_error() -> None:
    def gone(_: float) -> Sequence[DeviceStatus]:
        raise LinkMissing("no daemon")

    with pytest.raises(ImudError, match="does not reply: no daemon"):
        waited(gone, ["bow"])


def test_reasons_and_table() -> None:
    assert reasons([device("bow")], ["bow"]) == []
    assert reasons([SEARCHING, device("mast")], ["bow", "mast", "keel"]) == [
        "bow: nothing is heard", "keel: the daemon does not use this device: check `systemctl status imud`",
    ]  # fmt: skip
    head, bow, mast = samples_table(
        [device("bow"), device("mast", state=DeviceState.MISSING, identity={})]
    ).splitlines()
    assert head.split() == ["DEVICE", "STATE", "RATE", "HZ", "PRODUCT", "CLOCK", "ERROR"]
    assert bow.split() == ["bow", "running", "999.5", "HI13", "0.045", "ms"]
    named = device("n" * 32, identity={"product": "p" * 40}, state=DeviceState.SEARCHING, rate_hz=1000.5)
    assert max(map(len, samples_table([named]).splitlines())) <= 80
    assert mast.split() == ["mast", "missing", "999.5", "-", "-"]
