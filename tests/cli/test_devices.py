"""`imud command` on a running daemon with a simulated module."""

from collections.abc import Iterator

import pytest

from imud.cli import main
from imud.cli.arguments import argument
from imud.errors import BadArgument
from tests.support.daemon_process import RunningDaemon, daemon_with_module


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    """A daemon with a simulated HiPNUC module."""
    with daemon_with_module(tmp_path_factory.mktemp("command")) as daemon:
        yield daemon


def test_the_list(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["command", "--socket", str(daemon.socket), "bow"]) == 0
    out = capsys.readouterr().out
    assert "sout_divider" in out
    assert "divisor (a whole number from 1 to 64)" in out


def test_a_module_obeys(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["command", "--socket", str(daemon.socket), "bow", "mode", "axes=9"]) == 0
    assert capsys.readouterr().out == "done\n"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["mode", "axes=7"], "arguments: axes (one of 6, 9)"),
        (["dance"], "no action 'dance'; there are: save, restart"),
        (["mode", "nine"], "expected NAME=VALUE, got 'nine'"),
    ],
)
def test_mistakes_are_explained(
    daemon: RunningDaemon, words: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["command", "--socket", str(daemon.socket), "bow", *words]) == 2
    assert expected in capsys.readouterr().err


def test_values_are_json_or_text() -> None:
    assert argument("axes=9") == ("axes", 9)
    assert argument("enabled=false") == ("enabled", False)
    assert argument("turned=[1,0,0]") == ("turned", [1, 0, 0])
    assert argument("turned=x-90") == ("turned", "x-90")
    assert argument("a=b=c") == ("a", "b=c")
    for text in ("axes", "=9"):
        with pytest.raises(BadArgument):
            argument(text)


def test_only_the_device_is_required(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["command"])
    assert capsys.readouterr().err.endswith("the following arguments are required: DEVICE\n")
