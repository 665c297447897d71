"""The complete `imud doctor` on a simulated host and on the real host."""

import json
import re
from itertools import repeat
from pathlib import Path

import pytest

from imud.cli import main
from imud.cli.doctor.command import CHECKS, Examined, as_json, examine, exit_status, page, verdict
from imud.cli.doctor.surroundings import DoctorCheck, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.contracts.status import KernelCounters
from imud.host.installation import documents
from imud.model.errors import LinkError
from tests.cli.conftest import Cli
from tests.support.daemon_process import running_daemon
from tests.support.files import ROOT
from tests.support.metrics import device
from tests.support.surroundings import Machine


def healthy(machine: Machine) -> None:
    """Return a host without problems on which all checks can run."""
    machine.configure("bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}}")
    machine.port("ttyUSB0")
    machine.uid = 0
    machine.write("/etc/passwd", "root:x:0:0::/root:/bin/sh\n")
    machine.unit("ActiveState=active", "UnitFileState=enabled", "User=root")
    machine.prints("systemctl is-active", "inactive", 3)
    ledger = device("bow").ledger | {"lost_queue": 0, "frames_good": 10**8}
    machine.status = [device("bow", kernel=KernelCounters(), ledger=ledger)]
    machine.write("/proc/loadavg", "0.10 0.10 0.10 1/200 999\n")
    machine.write("/var/lib/imud/x")
    machine.sync_s = [0.01, 0.01, 0.01]
    machine.prints("journalctl", "usb 1-1: new full-speed USB device\n")
    machine.pages["127.0.0.1", 9321, "/scrapes"] = '{"scrapes":7,"age_s":9.0}'


@pytest.mark.parametrize("program", ["journalctl", "systemctl", "ip", "vcgencmd"])
def test_a_missing_program_is_not_checked_and_ends_no_check(machine: Machine, program: str) -> None:
    """A container has no systemd, and a small image has no `ip`."""
    healthy(machine)
    machine.write("/proc/device-tree/model", "Raspberry Pi 4 Model B")
    machine.prints("vcgencmd get_throttled", "throttled=0x0\n")
    machine.configure(
        "bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}}",
        "mast: {driver: hipnuc-canopen, socketcan: {interface: can0}}",
    )
    machine.write("/sys/class/net/can0/type", "280\n")
    machine.write("/sys/class/net/can0/flags", "0x40081\n")
    machine.prints("ip", '[{"stats64": {"rx": {"packets": 1}}, "linkinfo": {"info_kind": "vcan"}}]')

    def unseen() -> set[str]:
        machine.sync_s = [0.01, 0.01, 0.01]
        return {
            one.name for one in examine(CHECKS, machine.surroundings())
            if any(finding.severity == "not checked" for finding in one.findings)
        }  # fmt: skip

    before = unseen()
    for words in [words for words in machine.outputs if words.split()[0] == program]:
        del machine.outputs[words]
    assert unseen() - before == MISSING[program]


MISSING = {
    "journalctl": {"kernel log"}, "systemctl": {"service", "ModemManager"}, "ip": {"CAN state", "CAN bit rate"},
    "vcgencmd": {"power"},
}  # fmt: skip


def test_an_empty_host_and_one_on_which_all_checks_run(machine: Machine) -> None:
    examined = examine(CHECKS, machine.surroundings())
    assert ([one.name for one in examined], exit_status(examined)) == ([check.name for check in CHECKS], 2)
    assert "not checked" in verdict(examined)
    healthy(machine)
    examined = examine(CHECKS, machine.surroundings())
    assert (verdict(examined), exit_status(examined)) == ("no problem found", 0)
    del machine.outputs["journalctl"]
    machine.sync_s = [0.01, 0.01, 0.01]
    assert verdict(examine(CHECKS, machine.surroundings())).startswith("no problem found; 1 item not checked")


def test_on_this_machine_without_a_daemon(tmp_path: Path, cli: Cli) -> None:
    file = tmp_path / "imud.yaml"
    file.write_text(f"state_dir: {tmp_path}\ndevices:\n  bow: {{driver: auto, uart: {{port: {tmp_path}/none}}}}\n")
    words = ["doctor", "--config", str(file), "--socket", str(tmp_path / "none")]
    printed = cli(*words, status=2).out
    assert max(map(len, printed.splitlines())) <= 80
    assert "does not exist" in printed
    told = json.loads(cli(*words, "--json", status=2).out)
    assert [check["name"] for check in told["checks"]] == [check.name for check in CHECKS]
    (storage,) = [check for check in told["checks"] if check["name"] == "storage"]
    assert "writing 4 KiB" in storage["findings"][0]["seen"]
    assert sorted(tmp_path.iterdir()) == [file]


@pytest.mark.live
def test_the_file_of_the_running_daemon_is_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def found(*words: object) -> str:
        main(["doctor", "--json", "--socket", f"{tmp_path}/imud.sock", *map(str, words)])
        checks = json.loads(capsys.readouterr().out)["checks"]
        (check,) = [check for check in checks if check["name"] == "configuration"]
        return str(check["findings"][0]["seen"])

    with running_daemon(tmp_path, {}):
        assert found() == f"{tmp_path}/imud.yaml contains no device"
        assert f"{tmp_path}/none" in found("--config", tmp_path / "none")
    assert "/etc/imud.yaml" in found()


def test_documents_name_each_check_and_each_provoked_problem() -> None:
    text = (ROOT / "docs/doctor.md").read_text()
    names = [check.name for check in CHECKS]
    assert len(set(names)) == len(names)
    for name in names:
        assert f"| {name} |" in text, name
    tests = ("tests/lab/test_doctor.py", "tests/lab_debian/guest/first_contact.py")
    call = re.compile(r'(?:has|expect_finding)\(\s*"([^"]+)",\s*"(?:error|warning|note|not checked)"')
    provoked = {name for test in tests for name in call.findall((ROOT / test).read_text())}
    assert provoked <= {check.name for check in CHECKS}
    _, _, section = (ROOT / "tests/lab/README.md").read_text().partition("## Problems that `imud doctor` must find")
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| (?:lab|Debian|both) \|$", section, re.MULTILINE)
    assert set(rows) == provoked


GOOD, NOTE, WARNING, ERROR = ok("fine"), note("look"), warning("slow", "faster"), error("broken", "repair")
UNSEEN = not_checked("hidden")


def test_verdict_exit_status_json_and_page() -> None:
    for findings, status, words in [
        ([], 0, "no problem found"),
        ([GOOD, NOTE], 0, "no problem found"),
        ([GOOD, UNSEEN], 0, "no problem found; 1 item not checked"),
        ([WARNING, UNSEEN, UNSEEN], 1, "1 warning; 2 items not checked"),
        ([WARNING, ERROR, ERROR], 2, "2 errors, 1 warning"),
    ]:
        examined = [Examined("a", findings[:1]), Examined("b", findings[1:])]
        assert (exit_status(examined), verdict(examined)) == (status, words)
        assert page(examined).splitlines()[-1] == words
        told = json.loads(as_json(examined))
        assert (told["status"], told["verdict"]) == (status, words)
        assert told["complete"] is (UNSEEN not in findings)
    assert json.loads(as_json([Examined("a", [WARNING]), Examined("b", [])]))["checks"] == [
        {"name": "a", "findings": [{"severity": "warning", "seen": "slow", "advice": "faster"}]},
        {"name": "b", "findings": []},
    ]
    lines = page([Examined("a", [error("word " * 60, "another " * 40), GOOD, UNSEEN])]).splitlines()
    assert max(map(len, lines)) <= 80
    assert (lines[0], lines[1]) == ("ok           fine", "not checked  hidden")
    assert lines[2].startswith("error        word word")
    assert any(line.startswith("             → another") for line in lines)
    assert "\x1b" not in page([Examined("a", [error("\x1b[2J", "")])])
    assert "Folder docs:" not in "\n".join(lines)
    lines = page([Examined("a", [error("no edge", "is the wire connected (docs/lines.md)?")])]).splitlines()
    assert lines[-4:] == ["", f"Folder docs: {documents()}", "", "1 error"]


def test_a_check_that_cannot_look_ends_no_other_and_findings_are_bounded(machine: Machine) -> None:
    def broken(_at: Surroundings) -> Findings:
        yield GOOD
        raise problem

    def fine(_at: Surroundings) -> Findings:
        yield NOTE

    for problem, why in [  # noqa: B007 - `broken` raises it
        (FileNotFoundError(2, "No such file", "ip"), "x: ip does not exist or is not installed"),
        (LinkError("can0 is no CAN interface"), "x: can0 is no CAN interface"), (ValueError(), "x: ValueError"),
    ]:  # fmt: skip
        examined = examine([DoctorCheck("x", broken), DoctorCheck("y", fine)], machine.surroundings())
        assert (examined[0].findings, examined[1].findings) == ([GOOD, not_checked(why)], [NOTE])
    assert len(examine([DoctorCheck("x", lambda _at: repeat(GOOD))], machine.surroundings())[0].findings) == 300
