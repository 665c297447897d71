"""`imud web`: what it refuses to start with, and what it says of itself. The server is tested in tests/web."""

import signal
import subprocess
import sys
from http.client import HTTPConnection
from pathlib import Path

import pytest

from imud.cli import build_parser, main
from imud.cli.web import guard_of
from imud.errors import BadArgument

TOKEN = "correct-horse-battery-staple"
LIMIT_S = 20.0


@pytest.fixture
def token(tmp_path: Path) -> str:
    file = tmp_path / "token"
    file.write_text(TOKEN + "\n")
    return str(file)


def parsed(*words: str) -> object:
    return guard_of(build_parser(("web",)).parse_args(["web", *words]))


def test_another_address_needs_a_token() -> None:
    for address in ("0.0.0.0", "::", "192.168.1.5", "gateway"):
        with pytest.raises(
            BadArgument, match="expected --token-file FILE as well, or no --address, and a tunnel: ssh -L"
        ):
            parsed("--address", address)
    with pytest.raises(BadArgument, match="--reading token: expected --token-file"):
        parsed("--reading", "token")


@pytest.mark.parametrize("port", ["-1", "65536", "99999999999999999999"])
def test_a_port_that_there_is_not(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["web", "--port", port]) == 2
    assert f"--port: expected 0 to 65535, got {port}" in capsys.readouterr().err


def test_who_may_look(token: str) -> None:
    def can_read(*words: str) -> bool:
        guard = guard_of(build_parser(("web",)).parse_args(["web", *words]))
        return guard.rights(None, None).read

    assert can_read()
    assert can_read("--token-file", token)
    assert not can_read("--token-file", token, "--reading", "token")
    assert not can_read("--token-file", token, "--address", "0.0.0.0")
    assert can_read("--token-file", token, "--address", "0.0.0.0", "--reading", "open")


def test_without_the_library_it_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    monkeypatch.delitem(sys.modules, "imud.web.app", raising=False)
    assert main(["web"]) == 2
    assert "pip install 'imud[web]'" in capsys.readouterr().err


@pytest.mark.parametrize(("words", "is_open"), [(("--address", "0.0.0.0"), True), ((), False)])
def test_it_serves_until_a_signal_and_says_where_it_is_open(
    words: tuple[str, ...], is_open: bool, token: str, tmp_path: Path
) -> None:
    argv = [sys.executable, "-X", "dev", "-W", "error", "-m", "imud", "web", "--port", "0", "--token-file", token]
    argv += [*words, "--socket", str(tmp_path / "none")]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline().strip()
        try:
            asked = HTTPConnection("127.0.0.1", int(line.rstrip("/").rpartition(":")[2]), timeout=LIMIT_S)
            asked.request("GET", "/")
            assert b"<title>imud</title>" in asked.getresponse().read()
            asked.close()
        finally:
            process.send_signal(signal.SIGTERM)
            _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, errors
    assert ("OPEN: 0.0.0.0 port" in errors) == is_open
    assert "Traceback" not in errors
    assert TOKEN not in line + errors


@pytest.mark.parametrize("port", ["-1", "65536"])
def test_a_port_that_no_machine_has_is_refused(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["web", "--port", port]) == 2
    assert capsys.readouterr().err == f"imud web: --port: expected 0 to 65535, got {port}\n"


def test_a_port_that_is_taken_is_said_to_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert main(["web", "--port", str(taken.getsockname()[1])]) == 2
    assert "cannot listen on 127.0.0.1 port" in capsys.readouterr().err
