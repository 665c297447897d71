"""Checks of the configuration, the unit, the socket and the device states."""

import os

import pytest

from imud.cli.doctor.daemon import c_kernel, configuration, device_states, service, socket, stale_configuration
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import CKernelStatus, DeviceState
from imud.model.errors import LinkDenied, LinkMissing, ServerError
from tests.support.metrics import device
from tests.support.surroundings import Machine

CONFIGURATION, SERVICE, SOCKET = DoctorCheck("c", configuration), DoctorCheck("s", service), DoctorCheck("o", socket)
STALE, STATES = DoctorCheck("t", stale_configuration), DoctorCheck("d", device_states)
BOW = "bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}}"
ACTIVE = ("ActiveState=active", "UnitFileState=enabled", "Result=success", "NRestarts=2", "NeedDaemonReload=no")


def test_configurations(machine: Machine) -> None:
    machine.tells(CONFIGURATION, "error", "No such file", "`sudo imud setup`")
    machine.configure(BOW, "old: {enabled: false, driver: hipnuc-uart, uart: {port: /dev/ttyUSB1, baud: 115200}}")
    assert machine.told(CONFIGURATION) == [
        ("ok", "/etc/imud.yaml is valid; devices: bow → "),
        ("note", "device old is disabled in /etc/imud.yaml → "),
    ]
    machine.configure()
    assert [finding.severity for finding in machine.find(CONFIGURATION)] == ["warning"]
    machine.configure("bow: {driver: hipnuc-uart, uart: {prt: /dev/ttyUSB0}}")
    found = machine.told(CONFIGURATION)
    assert found
    assert {severity for severity, _ in found} == {"error"}
    assert any("imud.yaml:2:" in text and "prt" in text for _, text in found)


def test_a_service_that_runs_and_what_is_wrong_with_one(machine: Machine) -> None:
    machine.unit(*ACTIVE)
    assert [finding.severity for finding in machine.find(SERVICE)] == ["ok", "ok"]
    for changed, severity, words in [
        ("UnitFileState=disabled", "warning", "sudo systemctl enable imud"),
        ("UnitFileState=masked", "error", "sudo systemctl unmask imud"),
        ("ActiveState=inactive", "error", "sudo systemctl start imud"),
        ("ActiveState=activating", "warning", "again in a minute"),
        ("NRestarts=3", "warning", "restarted imud.service 3 times"),
        ("NeedDaemonReload=yes", "warning", "daemon-reload"),
    ]:
        key = changed.partition("=")[0]
        machine.unit(*(line for line in ACTIVE if not line.startswith(f"{key}=")), changed)
        wrong = [found for found in machine.told(SERVICE) if found[0] != "ok"]
        assert len(wrong) == 1
        assert wrong[0][0] == severity
        assert words in wrong[0][1]
    machine.unit("UnitFileState=enabled", "ActiveState=failed", "Result=exit-code", "ExecMainStatus=78")
    assert "with `imud check`" in machine.told(SERVICE)[-1][1]


def test_no_systemd_and_no_unit(machine: Machine) -> None:
    assert machine.find(SERVICE)[0].severity == "not checked"
    machine.prints("systemctl show", "LoadState=not-found\n")
    assert machine.find(SERVICE)[0].severity == "warning"


@pytest.mark.parametrize(
    ("answer", "severity"),
    [
        ([device("bow")], "ok"), (LinkMissing("no daemon"), "error"), (LinkDenied("group imud?"), "not checked"),
        (ServerError("another protocol"), "error"), (TimeoutError("waited in vain"), "error"),
    ],
)  # fmt: skip
def test_answers_of_the_socket(machine: Machine, answer: Exception, severity: str) -> None:
    machine.status = answer
    assert [finding.severity for finding in machine.find(SOCKET)] == [severity]


def test_use_of_the_kernel_in_c(machine: Machine) -> None:
    kernel = DoctorCheck("k", c_kernel)
    assert machine.find(kernel) == []  # no daemon
    machine.status = []
    machine.tells(kernel, "ok", "uses its C kernel")
    machine.c_kernel = CKernelStatus(False, "IMUD_KERNEL=0 switches it off")
    machine.tells(kernel, "note", "IMUD_KERNEL=0", "C compiler")
    machine.c_kernel = None  # a daemon of an older version
    assert machine.find(kernel) == []


def test_a_file_newer_than_the_last_reload(machine: Machine) -> None:
    machine.configure(BOW)
    machine.unit(*ACTIVE, "StateChangeTimestampMonotonic=5000000")
    machine.boot_utc_ns = 1_000 * 10**9  # the reload was at 1005 s
    file = machine.root / "etc/imud.yaml"
    os.utime(file, (1004, 1004))
    assert machine.find(STALE)[0].severity == "ok"
    os.utime(file, (1007, 1007))
    assert machine.told(STALE) == [
        ("warning", "/etc/imud.yaml changed after the last reload of the daemon → `sudo systemctl reload imud`")
    ]


def test_a_daemon_with_other_devices(machine: Machine) -> None:
    assert machine.find(STALE)[0].severity == "not checked"
    machine.configure(BOW)
    assert machine.find(STALE)[0].severity == "not checked"
    machine.configure(BOW)
    machine.status = [device("stern")]
    machine.tells(STALE, "warning", "uses the devices stern, /etc/imud.yaml contains bow")
    machine.status = [device("bow")]
    assert machine.find(STALE)[0].severity == "ok"


def test_states_come_with_the_reason_of_the_daemon(machine: Machine) -> None:
    assert machine.find(STATES)[0].severity == "not checked"
    down = device("b", state=DeviceState.MISSING, problem="/dev/ttyUSB1 is not there")
    machine.status = [device("a"), down, device("c", problem="can0 is error-passive")]
    found = machine.told(STATES)
    assert [severity for severity, _ in found] == ["ok", "error", "error"]
    assert "b: /dev/ttyUSB1 is not there" in found[1][1]
