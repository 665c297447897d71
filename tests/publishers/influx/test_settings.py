"""Options of the output: invalid URLs and contradicting keys."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.publishers.influx.settings import PUBLISHER, InfluxOptions


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({}, "expected at least one destination in the key to"),
        ({"to": {f"udp://127.0.0.1:{port}": {} for port in range(1, 10)}}, "to: expected at most 8 .*, got 9"),
        *(({"to": {url: {}}}, "to: expected a URL such as") for url in (
            "udp://localhost:1", "udp://127.0.0.1", "udp://1.2.3.4:0", "tcp://1.2.3.4:5/x", "tcp://u@1.2.3.4:5", "file://a",
            "file:///a/",
            "file:///a\n", "http://h", "http://u:p@h/write", "http://h/write?db=a&p=secret", "http://h/write?token=a", "ftp://h/x",
            "http://h:99999/write", "http://h/wri te", "http://[::1/write", "http://h/write#x",
        )),
        ({"to": {"http://h/write?precision=s": {}}}, "to: expected precision=ns"),
        ({"to": {"udp://127.0.0.1:1": {"gzip": True}}}, "to: expected an http or https URL for token_file"),
    ],
)  # fmt: skip
def test_options_that_contradict(given: dict[str, Any], problem: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=problem):
        msgspec.convert({"enabled": True, **given}, InfluxOptions)


def test_valid_urls() -> None:
    urls = (
        "udp://[::1]:8089",
        "tcp://10.0.0.1:8094",
        "file:///a/b",
        "https://db.example/api/v2/write?org=o&bucket=b&precision=ns",
    )
    assert msgspec.convert({"enabled": True, "to": {url: {} for url in urls}}, InfluxOptions).enabled


def problem_of(*urls: str, files: int = 10) -> str:
    options = msgspec.convert({"enabled": True, "to": {url: {"files": files} for url in urls}}, InfluxOptions)
    return "; ".join(PUBLISHER.check(options, {}).values())


def test_two_names_of_one_file(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    path.write_text("")
    (tmp_path / "hard").hardlink_to(path)
    (tmp_path / "symbolic").symlink_to(path)
    (tmp_path / "folder").symlink_to(tmp_path)
    names = ["./lines", "hard", "symbolic", "folder/lines", "folder/./lines", "/lines", "lines.1", "lines.9"]
    for name in names:
        url = f"file://{tmp_path}/{name}"
        assert problem_of(f"file://{path}", url).endswith("which write to the same file"), name
        assert problem_of(url, f"file://{path}").endswith("which write to the same file"), name


def test_different_files(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    assert problem_of(f"file://{path}", f"file://{path}.10", f"file://{tmp_path}/other", "udp://127.0.0.1:1") == ""
    assert problem_of(f"file://{path}", f"file://{path}.1", files=1) == ""
