"""`imud web`: invalid arguments and messages. The tests of the server are in tests/web."""

import errno
import signal
import socket
import sys
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest

from imud.cli import build_parser
from imud.cli.web import _say, guard_of
from imud.model.errors import BadArgument
from imud.web.connections import CONNECTIONS_MAX
from imud.web.guard import WebGuard
from tests.cli.conftest import Cli, imud_process
from tests.support.daemon_process import LIMIT_S

TOKEN = "correct-horse-battery-staple"


@pytest.fixture
def token(tmp_path: Path) -> str:
    file = tmp_path / "token"
    file.write_text(TOKEN + "\n")
    return str(file)


def parsed(*words: str) -> WebGuard:
    return guard_of(build_parser(("web",)).parse_args(["web", *words]))


def test_another_address_needs_a_token_and_who_may_look(token: str) -> None:
    for address in ("0.0.0.0", "::", "192.168.1.5", "gateway"):
        with pytest.raises(BadArgument, match="add --token-file FILE, or omit --address and use a tunnel: ssh -L"):
            parsed("--address", address)
    with pytest.raises(BadArgument, match="--reading token: add --token-file"):
        parsed("--reading", "token")

    def can_read(*words: str) -> bool:
        return parsed(*words).rights(None, None).read

    assert can_read()
    guard = parsed("--host", "gw.example")
    assert (guard.host_problem("gw.example"), guard.host_problem("other.example") != "") == ("", True)
    assert can_read("--token-file", token)
    assert not can_read("--token-file", token, "--reading", "token")
    assert not can_read("--token-file", token, "--address", "0.0.0.0")
    assert can_read("--token-file", token, "--address", "0.0.0.0", "--reading", "open")


def test_without_the_library_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    monkeypatch.delitem(sys.modules, "imud.web.server", raising=False)
    cli.refuses(" install 'imud[web]'", "web")


@pytest.mark.live
@pytest.mark.parametrize("words", [("--address", "0.0.0.0"), ()])
def test_it_serves_until_a_signal_and_says_where_it_is_open(words: tuple[str, ...], token: str, tmp_path: Path) -> None:
    more = ("--port", 0, "--token-file", token, *words, "--socket", tmp_path / "none")
    with imud_process("web", *more, python=("-X", "dev", "-W", "error")) as web:
        line = web.out.readline().strip()
        port = int(line.rstrip("/").rpartition(":")[2])
        idle = [socket.create_connection(("127.0.0.1", port), LIMIT_S) for _ in range(CONNECTIONS_MAX + 1)]
        assert idle[0].recv(1) == b"", "a new connection replaces the oldest idle connection"
        idle[-1].sendall(b"GET / HTTP/9.9\r\n\r\n")
        assert b" 400 " in idle[-1].recv(100)
        for one in idle:
            one.close()
        asked = HTTPConnection("127.0.0.1", port, timeout=LIMIT_S)
        asked.request("GET", "/")
        assert b"<title>imud</title>" in asked.getresponse().read()
        asked.close()
        errors = web.end(signal.SIGTERM).err
    assert ("OPEN: other hosts can reach 0.0.0.0 port" in errors) == bool(words)
    assert "Traceback" not in errors
    assert TOKEN not in line + errors


def test_a_port_that_cannot_be_had_is_refused(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    for port in ("-1", "65536", "99999999999999999999"):
        assert cli("web", "--port", port, status=2).err == f"imud web: --port: expected 0 to 65535, got {port}\n"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        cli.refuses(f"cannot listen on 127.0.0.1 port {port}: ", "web", "--port", port)

    class WithoutIpv6(socket.socket):
        def __init__(self, family: int = -1, *arguments: int, **names: Any) -> None:
            if family == socket.AF_INET6:
                raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
            super().__init__(family, *arguments, **names)

    monkeypatch.setattr(socket, "socket", WithoutIpv6)
    cli.refuses("cannot listen on ::1 port 9322: Address family not supported by protocol", "web", "--address", "::1")


def test_addresses_and_who_may_look_and_change_are_said(capsys: pytest.CaptureFixture[str]) -> None:
    def said(*words: str) -> tuple[str, str]:
        _say(build_parser(("web",)).parse_args(["web", *words]), 81)
        return capsys.readouterr()

    assert said() == ("http://127.0.0.1:81/\nthe page cannot change devices, because --token-file is not set\n", "")
    assert said("--address", "::1", "--token-file", "x") == ("http://[::1]:81/\n", "")
    out, err = said("--address", "::", "--token-file", "x", "--reading", "open")
    assert out == "http://[::]:81/\n"
    assert "OPEN: other hosts can reach :: port 81: every user of these networks can see the page" in err
    assert "every user with the token can see" in said("--address", "0.0.0.0", "--token-file", "x")[1]
