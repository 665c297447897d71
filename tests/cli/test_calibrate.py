"""`imud calibrate` on a running daemon with a simulated module at rest."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from imud.cli import main
from imud.cli.calibrate import progress_line
from imud.event import Event, EventKind
from tests.support.daemon_process import RunningDaemon, daemon_with_module


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    """A daemon with a simulated HiPNUC module that does not move."""
    with daemon_with_module(tmp_path_factory.mktemp("calibrate"), "--motion", "still") as daemon:
        yield daemon


def calibrate(daemon: RunningDaemon, *words: str) -> int:
    """Run the command."""
    return main(["calibrate", "--socket", str(daemon.socket), "bow", *words])


def test_the_list(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert calibrate(daemon) == 0
    out = capsys.readouterr().out
    assert "magnetometer_once" in out
    assert "until power-off; it cannot be saved" in out


def test_level_is_verified_and_saved(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert calibrate(daemon, "level", "--yes", "--save") == 0
    out = capsys.readouterr().out
    assert "  1. Put the module down in the attitude that is to be level, and do not touch it.\n" in out
    assert "\nverified\n  roll: " in out
    assert "°, limit 0.5°: passed\n  saved\n" in out


def test_as_json(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert calibrate(daemon, "heading", "--yes", "--json") == 0
    *events, result = map(json.loads, capsys.readouterr().out.splitlines())
    assert {event["kind"] for event in events} == {"calibration"}
    assert [event["detail"]["phase"] for event in events] == ["begin", "end"]
    assert result["verified"] is True
    assert result["kept"] == "until power-off; it cannot be saved"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["dance", "--yes"], "no calibration 'dance'; there are: magnetometer, "),
        (["heading", "--yes", "--save"], "expected no `save`, for its result lasts until power-off"),
        (["magnetometer", "--yes"], "expected 9-axis mode"),
        (["level"], "expected a terminal to ask on, or --yes"),
    ],
)
def test_mistakes_are_explained(
    daemon: RunningDaemon, words: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert calibrate(daemon, *words) == 2
    assert expected in capsys.readouterr().err


def test_progress_as_a_bar() -> None:
    detail: dict[str, str | int | float | bool | None] = {
        "kind": "magnetometer", "phase": "turn", "progress": 0.5, "field_t": 45.1e-6, "residual": 0.012,
        "device": "bias 0, 0, 0 µT",
    }  # fmt: skip
    line = progress_line(Event(0, "bow", EventKind.CALIBRATION, "…", detail))
    assert line == "[###############...............]  50%  field 45.1 µT, residual 1.2%  bias 0, 0, 0 µT"
    assert progress_line(Event(0, "bow", EventKind.CALIBRATION, "verified", {"phase": "end"})) == "verified"


def test_a_module_on_rs485_is_levelled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with daemon_with_module(tmp_path, "--motion", "still", driver="hipnuc-modbus") as daemon:
        assert calibrate(daemon, "level", "--yes", "--save") == 0
    out = capsys.readouterr().out
    assert "\nverified\n  roll: " in out
    assert out.endswith("  saved\n")
