"""Common arguments: numbers, durations, driver options, field names."""

import argparse
import json
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from imud.cli import build_parser
from imud.cli.arguments import argument, check_port, chosen_fields, confirmed, duration_s, named_values, read_noise
from imud.contracts.status import Deviations
from imud.model.errors import BadArgument, ImudError
from tests.cli.conftest import Cli
from tests.cli.test_decode import MANUAL_FRAME
from tests.support.files import imu61x_log


def test_an_unknown_option_and_one_that_is_not_a_finite_number_are_refused(cli: Cli) -> None:
    for command, option, value in [
        ("watch", "--rate", "nan"), ("watch", "--rate", "-inf"), ("watch", "--rate", "ten"),
        ("watch", "--latency", "inf"), ("demo", "--rate", "inf"), ("setup", "--wait", "inf"),
    ]:  # fmt: skip
        cli.refuses(f"argument {option}: expected a number, got '{value}'", command, f"{option}={value}")
    for words in ("clock", "fleet top mqtt://host", "modbus scan /dev/x"):
        found = cli(*words.split(), "--bogus", status=2).err
        assert found.startswith(f"usage: imud {words.rpartition(' ')[0] or words} ")
        assert "unrecognized arguments: --bogus" in found


def test_ports_and_durations_and_values_are_json_or_text() -> None:
    for port in (0, 65535):
        check_port(port)
    for port in (-1, 65536):
        with pytest.raises(BadArgument, match=f"--port: expected 0 to 65535, got {port}"):
            check_port(port)
    durations = {"90": 90, "90s": 90, "10min": 600, "1.5h": 5400, "2 d": 172_800, " .5s ": 0.5}
    assert {text: duration_s(text) for text in durations} == durations
    for text in ["", "min", "0", "-1s", "1 week", "1e3", "10m", "nan", "9" * 400 + "s"]:
        with pytest.raises(argparse.ArgumentTypeError, match="expected a duration, for example 90s, 10min or 2h"):
            duration_s(text)
    for words in (["clock"], ["record"], ["noise", "bow"], ["demo"], ["fleet", "top", "mqtt://host"]):
        parsed = [build_parser(words[:1]).parse_args([*words, name, "2min"]) for name in ("--duration", "--for")]
        assert [one.duration for one in parsed] == [120, 120]
    texts = ("axes=9", "enabled=false", "turned=[1,0,0]", "turned=x-90", "a=b=c", "a=")
    assert [argument(text)[1] for text in texts] == [9, False, [1, 0, 0], "x-90", "b=c", ""]
    assert argument("axes=9")[0] == "axes"
    for text in ("axes", "=9"):
        with pytest.raises(BadArgument, match="expected NAME=VALUE"):
            argument(text)
    assert named_values(["a=1", "b=1"]) == {"a": 1, "b": 1}
    with pytest.raises(BadArgument, match='a: expected one value, got 1 and "x"'):
        named_values(["a=1", "b=1", "a=x"])


def test_a_risk_is_confirmed_on_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    question = "all is lost; reset bow? [y/N] "
    with mock.patch("sys.stdin.isatty", return_value=True):
        for typed, agreed in [("y", True), (" YES ", True), ("n", False), ("", False)]:
            with mock.patch("builtins.input", {question: typed}.pop):
                assert confirmed("reset bow", "all is lost", yes=False) is agreed, typed
            assert capsys.readouterr().out == ("" if agreed else "imud changed nothing\n")
        assert confirmed("reset bow", "all is lost", yes=True)
    with (
        mock.patch("sys.stdin.isatty", return_value=False),
        pytest.raises(BadArgument, match="all is lost: cannot ask for confirmation without a terminal"),
    ):
        confirmed("reset bow", "all is lost", yes=False)


@pytest.fixture
def moved(tmp_path: Path) -> Path:
    """A device with identifiers from 512."""
    log = tmp_path / "drive.log"
    text = imu61x_log(range(10))
    for slot in range(5):
        text = text.replace(f" {101 + slot:03X}#", f" {512 + slot:03X}#")
    log.write_text(text)
    return log


def test_decode_and_replay_take_the_drivers_settings(moved: Path, cli: Cli) -> None:
    decode = ("decode", "--driver", "imu61x-can", moved)
    found, counters = cli(*decode, status=1).err.splitlines()
    assert "unknown types (identifier 512: 10, identifier 513: 10" in found
    assert json.loads(counters)["bytes_skipped"] == 400
    lines = cli(*decode, "--option", "base_id=512").out.splitlines()
    assert [json.loads(line)["index"] for line in lines] == list(range(10))
    replay = ("replay", "--driver", "imu61x-can", "--json", moved)
    cli(*replay, status=1)
    assert len(cli(*replay, "--option", "base_id=512").out.splitlines()) == 10


def test_settings_of_a_stream_driver(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "c.raw").write_bytes(MANUAL_FRAME)
    decode = ("decode", "--driver", "hipnuc-uart", tmp_path / "c.raw", "--option")
    assert "pps_age_ms" in json.loads(cli(*decode, "hi91_word=pps").out)
    assert "pps_age_ms" not in json.loads(cli(*decode, "hi91_word=status").out)


def test_bad_option_is_one_clear_line(moved: Path, cli: Cli) -> None:
    unknown = 'expected an option of imu61x-can that imud knows, got "baseid"; did you mean base_id? known: base_id'
    for option, said in [
        ("base_id=high", '--option base_id: expected a whole number from 0 to 2043, got "high"'),
        ("base_id=4000", "--option base_id: expected a whole number from 0 to 2043, got 4000"),
        ("baseid=201", f"--option baseid: {unknown}"), ("base_id", "expected NAME=VALUE, got 'base_id'"),
    ]:  # fmt: skip
        for command in ("decode", "replay"):
            printed = cli(command, "--driver", "imu61x-can", "--option", option, moved, status=2)
            assert printed.err == f"imud {command}: {said}\n"


def test_fields_come_in_their_order_and_wrong_names_are_an_error() -> None:
    assert chosen_fields("t_ns, accel_m_s2,device") == ("t_ns", "accel_m_s2", "device")
    for text, words in [
        ("t_ns,accel", ['got "accel"; did you mean accel_m_s2? known: accel_m_s2, device, ']),
        ("", ['got ""', "known: accel_m_s2"]),
        ("t_ns,,seq", ['got ""']),
        ("seq,t_ns,seq", ["expected each field once, got seq twice"]),
    ]:
        with pytest.raises(BadArgument) as caught:
            chosen_fields(text)
        assert all(word in str(caught.value) for word in ["--fields: ", *words])


def report(**sensors: list[float]) -> dict[str, Any]:
    """Return a report with the used members and some others."""
    found: dict[str, Any] = {}
    for name, values in sensors.items():
        axes = zip("xyz", values, strict=True)
        found[name] = {"unit": "x", "axes": {axis: {"spread": {"value": value, "si": "x"}} for axis, value in axes}}
    return {"measurement": {"device": "bow", "imud": "1"}, "sensors": found, "data_sheet": None}


def written(tmp_path: Path, content: object) -> Path:
    file = tmp_path / "noise.json"
    file.write_text(json.dumps(content))
    return file


def test_deviations_are_the_quadratic_mean_of_the_axes(tmp_path: Path) -> None:
    device, noise = read_noise(written(tmp_path, report(gyro=[0.001, 0.007, 0.005], accel=[0.02, 0.02, 0.02])))
    assert device == "bow"
    assert noise.gyro_rad_s == pytest.approx(0.005)  # (1 + 49 + 25) / 3 = 25
    assert noise.accel_m_s2 == pytest.approx(0.02)
    assert (noise.mag_t, noise.attitude_rad) == (None, None)
    assert read_noise(written(tmp_path, report(gyro=[0.0, 0.0, 0.0])))[1] == Deviations()
    with pytest.raises(ImudError, match=r"nothing\.json: expected a report"):
        read_noise(tmp_path / "nothing.json")
    moved = report(gyro=[0.001, 0.007, 0.005]) | {"at_rest": False, "motion": "angular rate: too large"}
    with pytest.raises(ImudError, match=r"at rest, got motion \(angular rate: too large\); measure again"):
        read_noise(written(tmp_path, moved))
    for content in [[], {}, {"measurement": {"device": "bow"}, "sensors": {"gyro": 1}}, "text"]:
        with pytest.raises(ImudError, match="expected a report of `imud noise --json`"):
            read_noise(written(tmp_path, content))
