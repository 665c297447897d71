"""The commands of docs/operate.md: backup and restore run on a simulated host, all other names must exist.

Upgrade and downgrade run on a booted Debian (tests/lab_debian/guest/removal.py).
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from imud.cli.setup.changes import FOLDER as SETUP_FOLDER
from imud.cli.setup.plan import RULES
from imud.config.schema import General
from imud.device.flash import FILE_NAME as FLASH
from imud.device.flash import FOLDER as BACKUPS
from imud.device.search import FILE_NAME as FOUND
from imud.fleet.settings import MqttOptions
from imud.fleet.spool import FILE as SPOOL_FILE
from imud.publishers.recorder.directory import RecorderOptions
from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

pytestmark = pytest.mark.live

PAGE = (ROOT / "docs" / "operate.md").read_text()
STATE: Final = General().state_dir
KEPT: Final = {
    "/etc/imud.yaml": "devices:\n  bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0}}\n",
    "/etc/systemd/system/imud.service.d/override.conf": "[Service]\nNice=-5\n",
    RULES: "# rules\n",
    "/etc/systemd/network/80-imud-can0.network": "[Match]\nName=can0\n",
    f"{STATE}/{FOUND}": "{}",
    f"{STATE}/{FLASH}": "{}",
    f"{STATE}/{BACKUPS}/bow.20261123T011234.000000Z.yaml": "device: bow\n",
}
"""Files of a backup by path, as in the page."""
LEFT_OUT: Final = (
    f"{RecorderOptions().directory}/one.imudrec", f"{MqttOptions().spool_directory}/{SPOOL_FILE}",
    f"{SETUP_FOLDER}/journal.json", "/etc/systemd/network/10-other.network", "/etc/hostname",
)  # fmt: skip
STUB: Final = '#!/bin/sh\necho "${0##*/} $*" >>"$CALLS"\n'


def section(title: str) -> str:
    (text,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    return str(text)


def commands(title: str) -> list[str]:
    return re.findall(r"^```sh\n(.*?)^```", section(title), re.MULTILINE | re.DOTALL)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the root of a simulated host with imud. All programs only log their calls, except `imud check`."""
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("systemctl", "udevadm", "imud"):
        (programs / name).write_text(STUB)
    with (programs / "imud").open("a") as file:
        file.write(f'[ "$1" = settings ] || exec {sys.executable} -m imud "$@"\n')
    (programs / "sudo").write_text('#!/bin/sh\nexec "$@"\n')
    for program in programs.iterdir():
        program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    root = tmp_path / "root"
    for path, text in {**KEPT, **dict.fromkeys(LEFT_OUT, "")}.items():
        file_path = root / path.lstrip("/")
        file_path.parent.mkdir(parents=True, exist_ok=True)
        file_path.write_text(text)
    return root


def run(text: str, machine: Path) -> None:
    moved = re.sub(r"(?<= )/(etc|var)(?=/)", rf"{machine}/\1", text)
    assert moved.count(f"{machine}/") == len(re.findall(r" /(?:etc|var)/", text)) > 0
    folder = machine.parent
    done = subprocess.run(
        ["sh", "-e", "-c", moved], cwd=folder, capture_output=True, text=True, check=False, timeout=LIMIT_S
    )
    assert done.returncode == 0, done.stderr


def files(root: Path) -> dict[str, str]:
    return {f"/{path.relative_to(root)}": path.read_text() for path in root.rglob("*") if path.is_file()}


@pytest.mark.parametrize("missing", [(), (RULES, "/etc/systemd/network/80-imud-can0.network")], ids=["all", "some"])
def test_what_a_backup_has_is_there_again_after_it_was_restored(machine: Path, missing: tuple[str, ...]) -> None:
    backup, restore = commands("Backup")
    for path in missing:
        (machine / path.lstrip("/")).unlink()
    run(backup, machine)
    assert (machine.parent / "calls").read_text() == "imud settings bow --backup bow.yaml\n"
    shutil.rmtree(machine)
    run(restore, machine)
    assert files(machine) == {path: text for path, text in KEPT.items() if path not in missing}
    calls = (machine.parent / "calls").read_text().splitlines()[1:]
    assert [line for line in calls if not line.startswith("imud check")] == [
        "systemctl stop imud", "systemctl daemon-reload", "udevadm control --reload", "systemctl enable --now imud",
        "imud settings bow --restore bow.yaml --save",
    ]  # fmt: skip


def test_the_document_has_every_place_section_and_command() -> None:
    table = section("Backup")
    for path in (*KEPT, *LEFT_OUT[:3]):
        places = (path, str(Path(path).parent), re.sub(r"80-imud-\w+", "80-imud-*", path))
        assert any(f"`{place}`" in table for place in places), path
    for title in ("Upgrade", "Backup", "Log", "Scheduling", "Confinement", "Exit status"):
        assert section(title).strip()
    unit = (ROOT / "systemd" / "imud.service").read_text()
    (file,) = re.findall(r"^ExecStart=.*--config (\S+)$", unit, re.MULTILINE)
    forward, back = commands("Upgrade")
    assert f"imud check {file}" in forward
    assert f"imud check {file}" in back
    assert "--allow-downgrades" in back
    guest = (ROOT / "tests/lab_debian/guest/removal.py").read_text()
    assert '"--allow-downgrades"' in guest, "the rig runs it"
    recording = (ROOT / "docs" / "recording.md").read_text()
    assert re.search(r"^```ini\n\[Unit\]\nRequiresMountsFor=", recording, re.MULTILINE), (
        "recordings on an external disk"
    )
