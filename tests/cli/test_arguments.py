"""Settings of a driver on the command line, for captures of devices that are not set as delivered."""

import json
from pathlib import Path

import pytest

from imud.cli import main
from imud.cli.arguments import chosen_fields
from imud.errors import BadArgument
from tests.cli.test_decode import MANUAL_FRAME
from tests.support.files import imu61x_log


@pytest.mark.parametrize(
    "words",
    [
        ("watch", "--rate"),
        ("watch", "--latency"),
        ("clock", "--duration"),
        ("demo", "--duration"),
        ("demo", "--rate"),
    ],
)
@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "ten"])
def test_what_is_no_number_is_refused(words: tuple[str, str], value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*words, value] if value != "-inf" else [words[0], f"{words[1]}={value}"])
    assert ended.value.code == 2
    assert f"argument {words[1]}: expected a number, got '{value}'" in capsys.readouterr().err


@pytest.fixture
def moved(tmp_path: Path) -> Path:
    """A device whose identifiers begin at 512."""
    log = tmp_path / "drive.log"
    text = imu61x_log(range(10))
    for slot in range(5):
        text = text.replace(f" {101 + slot:03X}#", f" {512 + slot:03X}#")
    log.write_text(text)
    return log


def test_decode_and_replay_take_the_drivers_settings(moved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    decode = ["decode", "--driver", "imu61x-can", str(moved)]
    assert main(decode) == 1
    assert json.loads(capsys.readouterr().err)["bytes_skipped"] == 400
    assert main([*decode, "--option", "base_id=512"]) == 0
    assert [json.loads(line)["index"] for line in capsys.readouterr().out.splitlines()] == list(range(10))
    replay = ["replay", "--driver", "imu61x-can", "--json", str(moved)]
    assert main(replay) == 1
    capsys.readouterr()
    assert main([*replay, "--option", "base_id=512"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 10


def test_settings_of_a_stream_driver(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = tmp_path / "c.raw"
    capture.write_bytes(MANUAL_FRAME)
    decode = ["decode", "--driver", "hipnuc-uart", str(capture)]
    shown = []
    for meaning in ("pps", "status"):
        assert main([*decode, "--option", f"hi91_word={meaning}"]) == 0
        shown.append(json.loads(capsys.readouterr().out))
    assert "pps_age_ms" in shown[0]
    assert "pps_age_ms" not in shown[1]


@pytest.mark.parametrize("command", ["decode", "replay"])
@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("base_id=high", '--option base_id: expected a whole number from 0 to 2043, got "high"'),
        ("base_id=4000", "--option base_id: expected a whole number from 0 to 2043, got 4000"),
        ("baseid=201", "--option baseid: expected an option of imu61x-can that imud knows, got \"baseid\"; "
         "did you mean base_id? known: base_id"),
        ("base_id", "expected NAME=VALUE, got 'base_id'"),
    ],
)  # fmt: skip
def test_bad_option_is_one_clear_line(
    command: str, option: str, said: str, moved: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--driver", "imu61x-can", "--option", option, str(moved)]) == 2
    assert capsys.readouterr().err == f"imud {command}: {said}\n"


def test_fields_come_in_the_order_in_which_they_are_named() -> None:
    assert chosen_fields("t_ns, accel_m_s2,device") == ("t_ns", "accel_m_s2", "device")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_ns,accel", ['got "accel"; did you mean accel_m_s2? known: accel_m_s2, device, ']),
        ("", ['got ""', "known: accel_m_s2"]),
        ("t_ns,,seq", ['got ""']),
        ("seq,t_ns,seq", ["expected each field once, got seq twice"]),
    ],
)
def test_wrong_names_are_an_error_that_lists_the_known_ones(text: str, words: list[str]) -> None:
    with pytest.raises(BadArgument) as caught:
        chosen_fields(text)
    assert all(word in str(caught.value) for word in ["--fields: ", *words])
