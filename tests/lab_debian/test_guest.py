"""The guest's checks can fail: what they judge is given to them here, without a guest."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from imud.cli.setup.command import sudo_user
from imud.cli.setup.journal import FILE
from imud.cli.setup.udev import MODEM_MANAGER, RULES
from tests.lab_debian.guest import buses, first_contact, sandbox
from tests.lab_debian.guest.checks import Checks
from tests.lab_debian.host.machine import PLATFORMS
from tests.support.files import ROOT

REFUSED = "PermissionError: [Errno 1] Operation not permitted"
README = (ROOT / "tests/lab_debian/README.md").read_text()
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}


@pytest.fixture
def checks(tmp_path: Path) -> Checks:
    return Checks(tmp_path / "results.json")


# --- what the unit forbids --------------------------------------------------------------------------------------------


def results(text: str, **others: str) -> dict[str, str]:
    """The same result for everything that is forbidden, but for some."""
    return dict.fromkeys(sandbox.FORBIDDEN, text) | {name.replace("_", " "): one for name, one in others.items()}


def test_what_root_may_and_the_unit_refuses_passes(checks: Checks) -> None:
    sandbox.judge(checks, results(""), results(REFUSED), results(REFUSED))
    assert checks.failed == []
    assert checks.summary().startswith(f"{len(sandbox.FORBIDDEN)} checks, 0 failed")


@pytest.mark.parametrize("name", sandbox.FORBIDDEN)
def test_a_probe_that_fails_for_root_without_the_unit_too_shows_nothing(checks: Checks, name: str) -> None:
    able = results("") | {name: "FileNotFoundError: /dev/vda"}
    sandbox.judge(checks, able, results(REFUSED), results(REFUSED))
    (failed,) = checks.failed
    assert name in failed


@pytest.mark.parametrize("name", sandbox.FORBIDDEN)
def test_what_the_user_or_root_can_under_the_settings_fails(checks: Checks, name: str) -> None:
    sandbox.judge(checks, results(""), results(REFUSED) | {name: ""}, results(REFUSED))
    sandbox.judge(checks, results(""), results(REFUSED), results(REFUSED) | {name: ""})
    assert len(checks.failed) == (1 if name in sandbox.FREE_FOR_ROOT else 2)


def test_probes_run_apart_and_tell_what_they_raised() -> None:
    snippets = {
        "could": "1 + 1",
        "refused": "raise PermissionError(1, 'no')",
        "died": "import os; os.kill(os.getpid(), 9)",
    }
    text = f"SNIPPETS = {snippets!r}\n{sandbox.TRY_ALL}"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True, timeout=30)
    said = json.loads(done.stdout)
    assert said == {"could": "", "refused": "PermissionError: [Errno 1] no", "died": "Error: ended with 9"}


@pytest.mark.parametrize("name", [*sandbox.FORBIDDEN, *sandbox.NEEDED])
def test_every_probe_is_python(name: str) -> None:
    compile({**sandbox.FORBIDDEN, **sandbox.NEEDED}[name], name, "exec")


def test_every_file_that_a_probe_leaves_is_removed() -> None:
    made = re.findall(r"(?:mknod\(|open\()'([^']+)'(?:, 'w'|, stat)", " ".join(sandbox.FORBIDDEN.values()))
    assert sorted(made) == sorted(sandbox.LEFT)


# --- nodes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("architecture", PLATFORMS)
def test_a_node_that_the_rig_promises_is_checked_and_one_that_is_missing_fails(
    checks: Checks, tmp_path: Path, architecture: str
) -> None:
    machine = MACHINES[architecture]
    promised = buses.NODES[machine]
    for pattern in promised:
        (tmp_path / pattern.replace("*", "0.0")).touch()
    assert len(sandbox.present_nodes(checks, tmp_path, machine)) == len(promised)
    assert checks.failed == []
    (tmp_path / "gpiochip0").unlink()
    assert len(sandbox.present_nodes(checks, tmp_path, machine)) == len(promised) - 1
    assert len(checks.failed) == 1
    assert not buses.is_there(checks, "gpiochip0", "the daemon drives a GPIO line", tmp_path, machine)
    assert len(checks.failed) == 2
    assert not buses.is_there(checks, "spidev9", "another bus", tmp_path, machine)
    assert len(checks.failed) == 2, "one that nobody promised is left out"


def test_the_document_promises_the_same_nodes() -> None:
    table = README.partition("## What the guest has")[2].partition("\n## ")[0]
    for pattern in buses.NODES["x86_64"]:
        kind = re.sub(r"[\d*]+$", "", pattern)
        assert f"/dev/{kind}" in table or f"{kind} bound" in table, pattern


# --- imud setup -------------------------------------------------------------------------------------------------------


def test_the_guest_looks_where_imud_setup_writes() -> None:
    assert str(first_contact.RULES) == RULES
    assert str(first_contact.JOURNAL) == FILE
    assert first_contact.MODEM_MANAGER.name == MODEM_MANAGER


def test_a_property_of_an_adapter_is_one_of_its_own_line() -> None:
    text = "P: /devices/x\nN: ttyUSB0\nE: DEVNAME=/dev/ttyUSB0\nE: ID_MM_DEVICE_IGNORE=1\nS: ID_X=1\n"
    assert first_contact.properties(text) == ["DEVNAME=/dev/ttyUSB0", "ID_MM_DEVICE_IGNORE=1"]


def test_the_user_that_runs_sudo_is_known_to_imud_setup(monkeypatch: pytest.MonkeyPatch) -> None:
    assert first_contact.SETUP[:2] == ("env", f"SUDO_USER={first_contact.OPERATOR}")
    monkeypatch.setenv(*first_contact.SETUP[1].split("="))
    assert sudo_user() == first_contact.OPERATOR
