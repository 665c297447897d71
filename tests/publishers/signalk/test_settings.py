"""Options: accepted URLs, messages for wrong values, and the libraries that a disabled output does not load."""

import subprocess
import sys
from typing import Any

import pytest

from imud.model.options import wrong_values
from imud.publishers.signalk.settings import SignalKOptions, address_of


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"url": "ws://127.0.0.1:3000"}, "expected a URL such as http://192.168.1.5:3000"),
        ({"url": "http://user:pw@boat:3000"}, "no user"), ({"url": "http://boat/admin"}, "no path"),
        ({"url": "http://boat:0"}, "got \"http://boat:0\""), ({"url": "http://boat:99999"}, "expected a URL"),
        ({"url": "http://a b"}, "expected a URL"), ({"ca_file": "/etc/ca.pem"}, "expected a url with https"),
        ({"rate_hz": 0}, "0.01"), ({"rate_hz": 101}, "100"), ({"devices": []}, "devices"),
    ],
)  # fmt: skip
def test_wrong_options_are_explained(given: dict[str, Any], words: str) -> None:
    try:
        SignalKOptions(**given)
        wrong = [str(one) for one in wrong_values(SignalKOptions, given)]
    except (ValueError, TypeError) as error:
        wrong = [str(error)]
    assert words in " ".join(wrong)


def test_addresses() -> None:
    for url, expected in (
        ("http://boat.local", "http://boat.local:80"), ("https://192.168.1.5:3443/", "https://192.168.1.5:3443"),
        ("https://[::1]", "https://[::1]:443"),
    ):  # fmt: skip
        found = address_of(url)
        assert found is not None
        assert found.url == expected


def test_a_disabled_output_loads_neither_its_code_nor_aiohttp() -> None:
    program = (
        "import sys, imud.daemon\nfrom imud.publishers import PUBLISHERS\nPUBLISHERS['signalk'].settings()\n"
        "print({'aiohttp', 'imud.publishers.signalk.publisher', 'imud.publishers.signalk.server'} & set(sys.modules))"
    )
    assert subprocess.check_output([sys.executable, "-c", program], text=True) == "set()\n"
