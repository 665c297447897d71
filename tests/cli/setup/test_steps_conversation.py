"""Output of setup in 80 columns, and its questions."""

import pytest

from imud.cli.setup.hardware import Attached
from imud.cli.setup.steps import Conversation, attached_table
from imud.model.errors import BadArgument


def test_paragraphs_silence_and_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    Conversation(ask=False).say("note: " + "word " * 40 + "\x1b[31m", indent="      ")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert all(line.startswith("      ") for line in lines[1:])
    assert "\x1b" not in "".join(lines)
    talk = Conversation(ask=False, silent=True)
    talk.say("word")
    talk.show(["line"])
    assert capsys.readouterr().out == ""
    talk = Conversation(ask=False)
    assert talk.agreed("?", default=True)
    assert not talk.agreed("?", default=False)
    assert talk.answer("name?", "imu") == "imu"


@pytest.mark.parametrize(
    ("word", "default", "agreed"),
    [("", True, True), ("", False, False), ("Y", False, True), ("yes", False, True), ("n", True, False),
     ("x", True, False)],
)  # fmt: skip
def test_answers(answers: dict[str, str], word: str, default: bool, agreed: bool) -> None:
    answers["Sure?"] = word
    assert Conversation(ask=True).agreed("Sure?", default=default) is agreed


def test_the_end_of_the_input_is_no_answer(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def ended(_: str) -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", ended)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    with pytest.raises(BadArgument, match="end of the input"):
        Conversation(ask=True).agreed("Sure?", default=True)
    assert capsys.readouterr().out == "\n"  # the error starts on a new line


def test_an_interrupted_question_ends_it_with_a_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_: str) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("builtins.input", interrupted)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    with pytest.raises(KeyboardInterrupt):
        Conversation(ask=True).agreed("Sure?", default=True)
    assert capsys.readouterr().out == "\nimud setup made no further changes.\n"


def test_the_table_has_80_columns() -> None:
    here = [
        Attached("/dev/serial/by-id/usb-A", "/dev/ttyUSB0", "Adapter " * 9, "hipnuc-uart", "", 115200, {}, "bow"),
        Attached("can0", "can0", "", problem="nothing is heard: " + "is the bus terminated? " * 6),
    ]
    lines = attached_table(here)
    assert max(map(len, lines)) <= 80
    assert lines[1].split()[:3] == ["/dev/ttyUSB0", "hipnuc-uart", "115200"]
    assert lines[1].endswith("bow")
    assert lines[3].startswith("  can0: nothing is heard")
    assert lines[4].startswith("  ")
    widest = Attached(
        "/dev/ttyUSB10", "/dev/ttyUSB10", "t" * 90, "hipnuc-nmea2000", "source 253", 1_000_000, {}, "n" * 32
    )
    assert max(map(len, attached_table([widest]))) == 80
