"""Checks of the container files without a build. `make image-try` builds and starts the image."""

import re
import subprocess

import msgspec
import pytest

from imud import __version__
from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

IMAGE = ROOT / "packaging" / "image"
COMPOSE = msgspec.yaml.decode((IMAGE / "compose.yaml").read_bytes())["services"]["imud"]
UNIT = (ROOT / "systemd" / "imud.service").read_text()


@pytest.mark.parametrize("name", ["build", "try"])
def test_scripts_are_shell(name: str) -> None:
    assert (IMAGE / name).stat().st_mode & 0o111
    subprocess.run(["bash", "-n", IMAGE / name], check=True, timeout=LIMIT_S)


def test_compose_and_page_name_this_version() -> None:
    release = __version__.partition(".dev")[0]
    assert COMPOSE["image"] == f"localhost/imud:{release}"
    assert re.findall(r"localhost/imud:(\S+)", (ROOT / "docs" / "containers.md").read_text()) == [release]


def test_limits_are_those_of_the_unit() -> None:
    assert f"LimitNOFILE={COMPOSE['ulimits']['nofile']}\n" in UNIT
    assert f"MemoryMax={COMPOSE['mem_limit'].upper()}\n" in UNIT
    assert (COMPOSE["cap_drop"], COMPOSE["read_only"]) == (["ALL"], True)


# numbers of Documentation/admin-guide/devices.txt of Linux; 254 is the first dynamic number
MAJORS = {
    4: "char-tty*",
    166: "char-tty*",
    188: "char-tty*",
    204: "char-tty*",
    89: "char-i2c",
    153: "char-spi",
    254: "char-gpiochip",
}


def test_device_rules_are_those_of_the_unit() -> None:
    rules = [re.fullmatch(r"c (\d+):\* rw", rule) for rule in COMPOSE["device_cgroup_rules"]]
    assert [int(rule[1]) for rule in rules if rule] == list(MAJORS)
    allowed = set(re.findall(r"^DeviceAllow=(\S+) rw$", UNIT, re.MULTILINE)) - {"char-pts"}  # simulators
    assert set(MAJORS.values()) == allowed


def test_users_of_the_image_and_of_the_page() -> None:
    build, page = (IMAGE / "build").read_text(), (ROOT / "docs" / "containers.md").read_text()
    numbers = dict(re.findall(r"\b(imud|imud-control):x:(\d+):", build))
    assert numbers == {"imud": "990", "imud-control": "991"}
    assert {name: gid for gid, name in re.findall(r"groupadd --gid (\d+) (\S+?)`", page)} == numbers
    assert f"d /run/imud 0755 {numbers['imud']} {numbers['imud']}" in page
