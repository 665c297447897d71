"""Whose pages may read."""

import pytest

from imud.cli.foxglove.origins import ViewerOrigins
from imud.errors import BadArgument

HOST = "127.0.0.1:8765"
RULE = ViewerOrigins(names=["Gateway.example"], origins=["https://Viewer.example:8443"])


@pytest.mark.parametrize(
    "origin",
    [
        "",
        "file://",
        "https://app.foxglove.dev",
        "http://localhost:8080",
        "http://127.0.0.1",
        "https://[::1]:8080",
        "https://viewer.example:8443",
    ],
)
def test_viewers_and_pages_of_this_machine_may(origin: str) -> None:
    assert RULE.problem(HOST, origin) == ""


@pytest.mark.parametrize(
    "origin",
    [
        "null",
        "https://attacker.example",
        "http://app.foxglove.dev",
        "https://app.foxglove.dev.attacker.example",
        "https://viewer.example",
        "https://localhost.attacker.example",
        "https://localhost@attacker.example",
        "http://localhost/path",
        "http://localhost:port",
        "chrome-extension://localhost",
        "http://[::1",
    ],
)
def test_other_sites_may_not_and_are_named(origin: str) -> None:
    problem = RULE.problem(HOST, origin)
    assert "may not read" in problem
    assert f"--allow-origin {origin}" in problem


@pytest.mark.parametrize("host", ["localhost:8765", "[::1]:8765", "192.168.1.7:8765", "gateway.example:8765"])
def test_hosts_that_nobody_else_can_have_are_good(host: str) -> None:
    assert RULE.problem(host, "file://") == ""


@pytest.mark.parametrize("host", ["attacker.example:8765", "127.0.0.1.attacker.example", ""])
def test_other_names_of_this_host_are_refused_whatever_the_page(host: str) -> None:
    assert "--host NAME" in RULE.problem(host, "")
    assert "expected an IP address or one of gateway.example, localhost" in RULE.problem(host, "file://")


@pytest.mark.parametrize("words", ["viewer.example", "*", "null", "https://", "https://viewer.example/page", "ftp://a"])
def test_what_is_no_origin_is_refused(words: str) -> None:
    with pytest.raises(BadArgument, match=r"--allow-origin: expected a site as https://viewer\.example:8080"):
        ViewerOrigins(origins=[words])
