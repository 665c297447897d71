"""Printed findings and the exit status."""

import json

import pytest

from imud.cli.doctor.command import Examined, as_json, examine, exit_status, page, verdict
from imud.cli.doctor.surroundings import DoctorCheck, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.model.errors import LinkError
from tests.support.surroundings import Machine

GOOD, NOTE, WARNING, ERROR = ok("fine"), note("look"), warning("slow", "faster"), error("broken", "repair")
UNSEEN = not_checked("hidden")


def test_verdict_exit_status_json_and_page() -> None:
    for findings, status, words in [
        ([], 0, "no problem found"),
        ([GOOD, NOTE], 0, "no problem found"),
        ([GOOD, UNSEEN], 0, "no problem found; 1 item not checked"),
        ([WARNING, UNSEEN, UNSEEN], 1, "1 warning; 2 items not checked"),
        ([WARNING, ERROR, ERROR], 2, "2 errors, 1 warning"),
    ]:
        examined = [Examined("a", findings[:1]), Examined("b", findings[1:])]
        assert exit_status(examined) == status
        assert verdict(examined) == words
        assert page(examined).splitlines()[-1] == words
        told = json.loads(as_json(examined))
        assert (told["status"], told["verdict"]) == (status, words)
        assert told["complete"] is (UNSEEN not in findings)
    assert json.loads(as_json([Examined("a", [WARNING]), Examined("b", [])]))["checks"] == [
        {"name": "a", "findings": [{"severity": "warning", "seen": "slow", "advice": "faster"}]},
        {"name": "b", "findings": []},
    ]
    long = error("word " * 60, "another " * 40)
    lines = page([Examined("a", [long, GOOD, UNSEEN])]).splitlines()
    assert max(map(len, lines)) <= 80
    assert (lines[0], lines[1]) == ("ok           fine", "not checked  hidden")
    assert lines[2].startswith("error        word word")
    assert any(line.startswith("             → another") for line in lines)
    assert "\x1b" not in page([Examined("a", [error("\x1b[2J", "")])])


@pytest.mark.parametrize(
    ("problem", "why"),
    [
        (FileNotFoundError(2, "No such file", "ip"), "x: ip does not exist or is not installed"),
        (LinkError("can0 is no CAN interface"), "x: can0 is no CAN interface"),
        (ValueError(), "x: ValueError"),
    ],
)
def test_a_check_that_cannot_look_ends_no_other(machine: Machine, problem: Exception, why: str) -> None:
    def broken(_at: Surroundings) -> Findings:
        yield GOOD
        raise problem

    def fine(_at: Surroundings) -> Findings:
        yield NOTE

    examined = examine([DoctorCheck("x", broken), DoctorCheck("y", fine)], machine.surroundings())
    assert (examined[0].findings, examined[1].findings) == ([GOOD, not_checked(why)], [NOTE])


def test_findings_of_one_check_are_bounded(machine: Machine) -> None:
    def endless(_at: Surroundings) -> Findings:
        while True:
            yield GOOD

    assert len(examine([DoctorCheck("x", endless)], machine.surroundings())[0].findings) == 300
