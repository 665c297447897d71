"""Access control: Host, Origin, token, cookie."""

import os
from pathlib import Path

import pytest

from imud.model.errors import BadArgument
from imud.web.guard import WebGuard, WebRights, host_name, is_loopback, read_token, safety_headers

SESSION_S = 43_200
TOKEN = "correct-horse-battery-staple"


class Clock:
    now_s = 1_790_000_000.0

    def __call__(self) -> float:
        return self.now_s


def make(*, reading_needs_token: bool = False, token: str = TOKEN, clock: Clock | None = None) -> WebGuard:
    return WebGuard(
        token.encode(), clock or Clock(), reading_needs_token=reading_needs_token, names=["Gateway.example"]
    )


def test_hosts_origins_rights_and_policy() -> None:
    good = ("127.0.0.1:9322", "localhost:8080", "LOCALHOST", "[::1]:9322", "192.168.1.7", "gateway.example:9322",
            "localhost.", "[::1")  # fmt: skip
    assert [host for host in good if make().host_problem(host)] == []
    for host in ("attacker.example:9322", "127.0.0.1.attacker.example", "", None, "1", "0x7f.1"):
        assert "see imud web --host" in make().host_problem(host), host
    guard = make()
    assert guard.origin_problem("http://localhost:9322", "localhost:9322", with_token=False) == ""
    others = ("http://localhost:8080", "http://attacker.example", "null", "", "localhost:9322", "ftp://localhost:9322")
    for origin in others:
        assert guard.origin_problem(origin, "localhost:9322", with_token=False), origin
        assert guard.origin_problem(origin, "localhost:9322", with_token=True), origin
    assert make().origin_problem(None, "localhost", with_token=True) == ""
    assert make().origin_problem(None, "localhost", with_token=False)
    guard = make(reading_needs_token=True)
    assert guard.rights(None, None) == WebRights(False, False)
    assert guard.rights(f"Bearer {TOKEN}", None) == WebRights(True, True)
    assert guard.rights(f"Bearer {TOKEN}x", None) == WebRights(False, False)
    assert guard.rights(TOKEN, None) == WebRights(False, False)
    assert guard.rights(None, guard.new_session()) == WebRights(True, True, by_cookie=True)
    assert guard.rights(None, TOKEN) == WebRights(False, False)
    assert make().rights(None, None) == WebRights(True, False), "reading is open"
    guard = make(token="")
    assert guard.rights("Bearer ", "") == WebRights(True, False)
    assert guard.rights("Bearer", guard.new_session()) == WebRights(True, False)
    assert not guard.has_token
    assert host_name("[fe80::1]:80") == "fe80::1"
    assert [is_loopback(one) for one in ("127.0.0.1", "127.8.8.8", "::1", "localhost")] == [True] * 4
    assert [is_loopback(one) for one in ("0.0.0.0", "::", "192.168.1.1", "", "gateway")] == [False] * 5
    policy = safety_headers()["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy


def test_a_session_ends_and_cannot_be_prolonged_or_forged() -> None:
    clock = Clock()
    guard = make(clock=clock)
    cookie = guard.new_session()
    end, _, signature = cookie.partition(".")
    assert guard.is_session(cookie)
    assert make(clock=clock).is_session(cookie), "a restart keeps it"
    assert not make(token=TOKEN + "2", clock=clock).is_session(cookie), "another token ends it"
    assert not guard.is_session(f"{int(end) + 1}.{signature}")
    for forged in (f"{end}.", end, f".{signature}", f"٣{end[1:]}.{signature}", "9" * 400 + "." + signature, "é.é"):
        assert not guard.is_session(forged), forged
    clock.now_s += SESSION_S
    assert not guard.is_session(cookie)
    for end_s, valid in ((10**12 - 1, True), (10**12, False)):  # an end has at most 12 digits
        clock.now_s = end_s - SESSION_S
        assert guard.is_session(guard.new_session()) is valid


def test_a_token_comes_from_the_first_line_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(f"  {TOKEN} \nmore\n")
    assert read_token(str(file)) == TOKEN.encode()
    file.write_text("x" * 20)  # docs: at least 20 characters
    assert read_token(str(file)) == b"x" * 20
    for text, words in (
        ("x" * 19, "got 19"),
        ("short\n", "at least 20 characters, got 5; make one with: openssl rand"),
    ):
        file.write_text(text)
        with pytest.raises(BadArgument, match=words):
            read_token(str(file))
    with pytest.raises(BadArgument, match="No such file"):
        read_token(str(tmp_path / "none"))
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(BadArgument, match="is a FIFO, expected a regular file"):
        read_token(str(tmp_path / "fifo"))
