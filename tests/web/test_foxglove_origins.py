"""Origins of pages that may read."""

import pytest

from imud.model.errors import BadArgument
from imud.web.foxglove import ViewerOrigins

HOST = "127.0.0.1:8765"
RULE = ViewerOrigins(names=["Gateway.example"], origins=["https://Viewer.example:8443"])
VIEWERS = (
    "", "file://", "https://app.foxglove.dev", "http://localhost:8080", "http://127.0.0.1", "https://[::1]:8080",
    "https://viewer.example:8443",
)  # fmt: skip
OTHERS = (
    "null", "https://attacker.example", "http://app.foxglove.dev", "https://app.foxglove.dev.attacker.example",
    "https://viewer.example", "https://localhost.attacker.example", "https://localhost@attacker.example",
    "http://localhost/path", "http://localhost:port", "chrome-extension://localhost", "http://[::1",
)  # fmt: skip


def test_viewers_and_pages_of_this_host_may_read_and_other_sites_are_named() -> None:
    assert [origin for origin in VIEWERS if RULE.problem(HOST, origin)] == []
    for origin in OTHERS:
        problem = RULE.problem(HOST, origin)
        assert "may not read" in problem, origin
        assert f"--allow-origin {origin}" in problem


def test_only_own_host_names_are_accepted() -> None:
    for host in ("localhost:8765", "[::1]:8765", "192.168.1.7:8765", "gateway.example:8765"):
        assert RULE.problem(host, "file://") == "", host
    for host in ("attacker.example:8765", "127.0.0.1.attacker.example", ""):
        assert "--host NAME" in RULE.problem(host, "")
        assert "expected an IP address or one of gateway.example, localhost" in RULE.problem(host, "file://")


@pytest.mark.parametrize("words", ["viewer.example", "*", "null", "https://", "https://viewer.example/page", "ftp://a"])
def test_an_invalid_origin_is_refused(words: str) -> None:
    with pytest.raises(BadArgument, match=r"--allow-origin: expected a site as https://viewer\.example:8080"):
        ViewerOrigins(origins=[words])
