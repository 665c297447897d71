"""`imud calibrate` with a running daemon and a simulated device at rest."""

import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Event as ThreadingEvent
from unittest.mock import Mock

import pytest

from imud.cli.calibrate import _account, _show, progress_line
from imud.contracts.command import CalibrationInfo, CalibrationResult, Check, Handling, Kept
from imud.model.event import Event, EventKind
from tests.cli.conftest import Cli, Terminal
from tests.support.daemon_process import LIMIT_S, RunningDaemon, daemon_with_module

live = pytest.mark.live


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    with daemon_with_module(tmp_path_factory.mktemp("calibrate"), "--motion", "still") as daemon:
        yield daemon


@live
def test_calibrations_are_listed_verified_and_saved(daemon: RunningDaemon, cli: Cli) -> None:
    words = ("calibrate", "--socket", daemon.socket, "bow")
    out = cli(*words).out
    found = "magnetometer_once", "not done yet", "until power-off; it cannot be saved"
    assert [words for words in found if words not in out] == []
    out = cli(*words, "level", "--yes", "--save").out
    assert "  1. Put the device down in the attitude that must be level, and do not touch it.\n" in out
    result = "\nverified\n  roll: ", "°, limit 0.5°: passed\n  save to flash: sent, not verified: "
    assert [words for words in result if words not in out] == []
    (level,) = [line for line in cli(*words).out.splitlines() if line.startswith("level ")]
    assert ", verified, save not verified " in level
    shown = cli("events", "--since", "1h", "--socket", daemon.socket)
    past = shown.out.splitlines()
    assert shown.err.startswith("imud events: imud has all events of the last "), "it started less than 1 h ago"
    assert [line for line in past if " bow: up: " in line]
    assert "calibration: calibration level: verified" in past[-1]
    assert cli("events", "--since", "1h", "--count", "1", "--socket", daemon.socket).out.count("\n") == 1
    assert cli(*words, "--stop", status=1).out == "bow has no running calibration\n"
    cli.refuses("expected --stop without a calibration, got 'level'", *words, "level", "--stop")
    *events, result = map(json.loads, cli(*words, "heading", "--yes", "--json").out.splitlines())
    assert {event["kind"] for event in events} == {"calibration"}
    assert [event["detail"]["phase"] for event in events] == ["begin", "end"]
    assert (result["verified"], result["kept"]) == (True, "until power-off; it cannot be saved")


@live
def test_mistakes_are_explained(daemon: RunningDaemon, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("calibrate", "--socket", daemon.socket, "bow")
    cli.refuses("unknown calibration 'dance'; bow has: magnetometer, ", *words, "dance", "--yes")
    refusal = "the device cannot save the result, which lasts until power-off; repeat the command without --save"
    cli.refuses(refusal, *words, "heading", "--yes", "--save")
    cli.refuses("expected 9-axis mode", *words, "magnetometer", "--yes")
    cli.refuses("cannot ask for confirmation without a terminal; confirm with --yes", *words, "level")
    turn = "Start to turn the device, then press Enter to start"
    asked = iter(["Press Enter to start the calibration, or type n", turn])

    def refuse(question: str) -> str:
        assert question.startswith(next(asked))
        return "n"

    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr("builtins.input", refuse)
    for kind in ("level", "magnetometer"):
        assert cli(*words, kind, status=1).out.endswith("\nimud changed nothing\n")


@live
def test_a_module_on_rs485_is_levelled(tmp_path: Path, cli: Cli) -> None:
    with daemon_with_module(tmp_path, "--motion", "still", driver="hipnuc-modbus") as daemon:
        out = cli("calibrate", "--socket", daemon.socket, "bow", "level", "--yes", "--save").out
    assert "\nverified\n  roll: " in out
    assert out.endswith("  save to flash: sent, not verified: imud cannot read the flash\n")


class Asked:
    stopped = False
    verified = True
    interrupts = False

    def __enter__(self) -> "Asked":
        return self

    def __exit__(self, *_error: object) -> None: ...

    def call(self, method: str, **params: object) -> object:
        if method == "calibrations":
            return [CalibrationInfo("level", "level it", "2.3", Handling.REST, ("Put it down.",), Kept.BY_SAVE)]
        if method == "stop_calibration":
            type(self).stopped = True
            ENDED.set()
            return None
        assert (method, params) == ("calibrate", {"device": "bow", "kind": "level", "save": True})
        ENDED.wait(LIMIT_S)
        problem = "" if self.verified else "it moved"
        return CalibrationResult("level", self.verified, problem, "", (), False, Kept.BY_SAVE)

    def events(self, names: list[str], timeout_s: float) -> Iterator[Event]:
        assert (names, timeout_s) == (["bow"], 0.5)
        if self.interrupts:
            raise KeyboardInterrupt
        yield END
        ENDED.set()
        while True:
            yield END


ENDED = ThreadingEvent()


@pytest.mark.parametrize(("verified", "status"), [(True, 0), (False, 1)])
def test_exit_statuses_and_an_interrupt(verified: bool, status: int, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    class Made(Asked):
        pass

    Made.verified = verified
    client = Mock(side_effect=lambda *_arguments, **_options: Made())
    monkeypatch.setattr("imud.cli.calibrate.Client", client)
    words = ("calibrate", "bow", "level", "--yes", "--save")
    ENDED.clear()
    assert ("NOT verified: it moved" in cli(*words, status=status).out) is not verified
    assert not Made.stopped
    assert [call.kwargs for call in client.call_args_list] == [{}, {"timeout_s": 600.0}], (
        "the daemon stops each calibration earlier"
    )
    Made.interrupts = True
    ENDED.clear()
    cli(*words, status=130)
    assert Made.stopped, "the device does not go on"


TURN = Event(0, "bow", EventKind.CALIBRATION, "half of it", {
    "kind": "magnetometer", "phase": "turn", "progress": 0.5, "field_t": 45.1e-6, "residual": 0.012,
    "device": "bias 0, 0, 0 µT",
})  # fmt: skip
END = Event(0, "bow", EventKind.CALIBRATION, "verified", {"phase": "end"})


def test_progress_is_a_bar_on_a_terminal_and_only_begin_and_end_elsewhere() -> None:
    line = "[###############...............]  50%  field 45.1 µT, residual 1.2%  bias 0, 0, 0 µT"
    assert (progress_line(TURN), progress_line(END)) == (line, "verified")
    terminal, plain, for_programs = Terminal(), io.StringIO(), io.StringIO()
    for event in (TURN, Event(0, "bow", EventKind.UP, "is there"), END):
        _show(event, terminal, as_json=False)
        _show(event, plain, as_json=False)
        _show(event, for_programs, as_json=True)
    assert (terminal.getvalue(), plain.getvalue()) == (f"\r\x1b[2K{line}\r\x1b[2Kverified", "verified\n")
    assert [json.loads(one)["message"] for one in for_programs.getvalue().splitlines()] == ["half of it", "verified"]


def account(kept: Kept, *checks: Check, problem: str = "", asked_to_save: bool = False) -> list[str]:
    result = CalibrationResult("level", not problem, problem, "bias 0", checks, kept is Kept.BY_DEVICE, kept)
    return _account(result, asked_to_save=asked_to_save).splitlines()


def test_a_result_has_its_checks_in_units_of_people_and_a_way_to_save_it() -> None:
    checks = (
        Check("roll", 0.01, 0.02, "rad", True), Check("turn", 0.1, 0.05, "rad/s", False),
        Check("field", 45.1e-6, 67e-6, "T", True), Check("share", 0.5, 1.0, "", True),
        Check("force", None, 1.0, "m/s²", False),
    )  # fmt: skip
    assert account(Kept.BY_SAVE, *checks) == [
        "verified", "  device reports: bias 0", "  roll: 0.573°, limit 1.15°: passed",
        "  turn: 5.73 °/s, limit 2.86 °/s: NOT passed", "  field: 45.1 µT, limit 67 µT: passed",
        "  share: 50.0%, limit 100.0%: passed", "  force: not reported, limit 1 m/s²: NOT passed",
        "  not saved: lasts until power-off, unless it is saved; save it with --save",
    ]  # fmt: skip
    assert account(Kept.BY_SAVE, asked_to_save=True)[-1].endswith("unless it is saved")
    assert account(Kept.NEVER)[-1] == "  not saved: lasts until power-off; it cannot be saved"
    assert account(Kept.BY_DEVICE)[-1] == "  saved by the device itself"
    sent = CalibrationResult("level", True, "", "", (), True, Kept.BY_SAVE)
    words = ["verified", "  save to flash: sent, not verified: imud cannot read the flash"]
    assert _account(sent, asked_to_save=True).splitlines() == words
    failed = account(Kept.BY_SAVE, problem="it moved")
    unsaved = "  not saved: lasts until power-off, unless it is saved"
    assert (failed[0], failed[-1]) == ("NOT verified: it moved", unsaved)
