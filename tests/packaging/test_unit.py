"""The service unit as a file: its exposure according to systemd, and its permitted system calls and networks.

The commands of docs/operate.md: backup and restore run on a simulated host, all other names must exist.
Effects of the settings, upgrade and downgrade are tested on a booted Debian (tests/lab_debian/guest).
"""

import os
import re
import shutil
import subprocess
import sys
from ipaddress import ip_address, ip_network
from pathlib import Path
from typing import Final

import pytest

from imud.cli import build_parser
from imud.cli.setup.changes import FOLDER as SETUP_FOLDER
from imud.cli.setup.plan import RULES
from imud.config.schema import General
from imud.device.flash import FILE_NAME as FLASH
from imud.device.flash import FOLDER as BACKUPS
from imud.device.search import FILE_NAME as FOUND
from imud.fleet.settings import MqttOptions
from imud.fleet.spool import FILE as SPOOL_FILE
from imud.publishers.recorder.directory import FlightOptions, RecorderOptions
from imud.publishers.shm import ShmOptions
from imud.web.guard import is_loopback
from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

pytestmark = pytest.mark.live

UNIT = ROOT / "systemd" / "imud.service"
WEB_UNIT = ROOT / "systemd" / "imud-web.service"
FLEET_UNIT = ROOT / "systemd" / "imud-fleet-collect.service"
EXPOSURE_MAX = 2.0
"""Maximum exposure. docs/operate.md explains its parts. The check in the guest has the same limit."""
REASON_WORDS = 5
"""Minimum number of words in a reason. A shorter reason only repeats the name of the directive."""
PAGE = (ROOT / "docs" / "operate.md").read_text()
DROP_INS = re.findall(r"^```ini\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
COLLECTOR_EXPOSURE_MAX = 2.5
"""Maximum exposure of the collector. It connects to brokers and databases anywhere: no IPAddressDeny."""
OFFLINE_SINCE = 250
"""First version of systemd with a systemd-analyze that rates a file."""


def values(name: str) -> list[str]:
    return " ".join(re.findall(rf"^{name}=(.*)$", UNIT.read_text(), re.MULTILINE)).split()


def analyze_version() -> int:
    if shutil.which("systemd-analyze") is None:
        return 0
    said = subprocess.run(["systemd-analyze", "--version"], capture_output=True, text=True, check=True, timeout=LIMIT_S)
    return int(said.stdout.split()[1])


def exposure(text: str, folder: str) -> float:
    path = f"{folder}/imud.service"
    with open(path, "w") as file:
        file.write(text)
    argv = ["systemd-analyze", "security", "--offline=true", "--no-pager", path]
    said = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=LIMIT_S).stdout
    found = re.search(r"Overall exposure level for imud\.service: ([\d.]+)", said)
    assert found, said
    return float(found[1])


judged = pytest.mark.skipif(analyze_version() < OFFLINE_SINCE, reason="cannot find a systemd-analyze that rates files")


@judged
def test_systemd_judges_the_units_as_little_exposed(tmp_path: Path) -> None:
    folder, text = str(tmp_path), UNIT.read_text()
    assert exposure(text, folder) <= EXPOSURE_MAX
    for setting in ("IPAddressDeny=any", "RemoveIPC=yes"):
        assert exposure(text.replace(f"\n{setting}\n", "\n"), folder) > EXPOSURE_MAX, "the judge sees a setting go"
    assert exposure(WEB_UNIT.read_text(), folder) <= EXPOSURE_MAX
    assert exposure(FLEET_UNIT.read_text(), folder) <= COLLECTOR_EXPOSURE_MAX


def test_every_block_of_directives_has_its_reason_and_removing_ipc_does_not_reach_the_rings() -> None:
    directives = set(re.findall(r"^(\w+)=", UNIT.read_text(), re.MULTILINE))
    assert len(directives) > 50
    blocks = re.findall(r"^((?:#.*\n)*)((?:\w+=.*\n)+)", UNIT.read_text(), re.MULTILINE)
    assert {name for _, block in blocks for name in re.findall(r"^(\w+)=", block, re.MULTILINE)} == directives
    for reason, block in blocks:
        assert len(reason.split()) >= REASON_WORDS, block
    # RemoveIPC= of systemd.exec(5) removes System V and POSIX IPC: /dev/shm and message queues
    assert values("RemoveIPC") == ["yes"]
    assert not any(folder.startswith("/dev/shm") for folder in (ShmOptions().directory, FlightOptions().directory))
    assert f"/run/{values('RuntimeDirectory')[1]}" == ShmOptions().directory


@judged
@pytest.mark.parametrize("text", DROP_INS, ids=lambda text: text.splitlines()[0])
def test_drop_ins_of_the_document_are_taken_by_systemd(text: str, tmp_path: Path) -> None:
    head, _, rest = text.partition("\n")
    assert re.fullmatch(r"# /etc/systemd/system/imud\.service\.d/\w+\.conf", head)
    unit = tmp_path / "imud.service"
    plain = re.sub(r"^Exec\w+=.*", "", UNIT.read_text(), flags=re.MULTILINE).replace("Type=notify", "Type=oneshot")
    plain = re.sub(r"^(Wants|Restart|After)=.*", "", plain, flags=re.MULTILINE)
    unit.write_text(f"{plain}\n{rest}ExecStart=/bin/true\n")
    argv = ["systemd-analyze", "verify", "--man=no", str(unit)]
    said = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=LIMIT_S)
    assert [line for line in said.stderr.splitlines() if "imud.service" in line] == []


def test_the_unit_of_the_page_may_read_the_socket_and_listens_on_this_machine_only() -> None:
    lines = WEB_UNIT.read_text().splitlines()
    assert "SupplementaryGroups=imud" in lines
    assert "DynamicUser=yes" in lines
    (command,) = [line.partition("=")[2] for line in lines if line.startswith("ExecStart=")]
    assert is_loopback(build_parser(("web",)).parse_args(command.split()[1:]).address)
    assert any(re.match(r"# +ExecStart=.*--token-file \$\{CREDENTIALS_DIRECTORY\}/token$", line) for line in lines)


def test_the_unit_of_the_collector_has_a_command_line_that_is_taken_and_starts_it_again_after_status_2() -> None:
    text = FLEET_UNIT.read_text()
    given = dict(re.findall(r"^#   (BROKERS|STORE|OPTIONS)=(.*?)(?:  .*)?$", text, re.MULTILINE))
    (command,) = re.findall(r"^ExecStart=\S+/imud (.*)$", text, re.MULTILINE)
    assert "${CREDENTIALS_DIRECTORY}/password" in command
    for name, value in given.items():
        command = command.replace(f"${{{name}}}", value).replace(f"${name}", value)
    args = build_parser(("fleet",)).parse_args(command.split())
    assert (args.urls, args.user) == (["mqtts://broker.example"], "collector")
    assert args.to == "postgresql://imud@db.example/fleet"
    assert "RestartPreventExitStatus" not in text, "2 is a database that is away (docs/fleet.md)"
    assert "Restart=on-failure\n" in text
    assert "StartLimitIntervalSec=0\n" in text
    document = (ROOT / "docs" / "fleet.md").read_text()
    for file in re.findall(r"^(?:EnvironmentFile=|LoadCredential=password:)(\S+)$", text, re.MULTILINE):
        assert f"install -m 600 /dev/null {file} " in document


def test_clock_calls_networks_and_the_documents() -> None:
    assert {name for name in values("SystemCallFilter") if "time" in name or "clock" in name or "adj" in name} == {
        "adjtimex", "clock_adjtime", "clock_adjtime64"
    }  # fmt: skip
    assert "CapabilityBoundingSet=\n" in UNIT.read_text(), "with CAP_SYS_TIME they would set it"
    assert values("IPAddressDeny") == ["any"]
    allowed = values("IPAddressAllow")
    assert {"localhost", "link-local"} <= set(allowed)
    networks = [ip_network(word) for word in allowed if "/" in word]
    assert len(networks) == len(allowed) - 2
    for address in ("192.168.1.20", "10.0.0.7", "172.20.1.1", "100.101.1.2", "fd00::7"):
        assert any(ip_address(address) in network for network in networks), address
    for network in networks:
        assert not network.is_global, network
    assert f"`systemd-analyze security imud` gives {EXPOSURE_MAX} " in PAGE
    left_open = re.findall(r"Not (\w+)=(\w*):", UNIT.read_text())
    assert len(left_open) == 3
    for name, value in left_open:
        assert value not in values(name) if value else not values(name), name


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
    argv = ["sh", "-e", "-c", moved]
    done = subprocess.run(argv, cwd=folder, capture_output=True, text=True, check=False, timeout=LIMIT_S)
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
    assert "\n```ini\n[Unit]\nRequiresMountsFor=" in recording, "recordings on an external disk"
