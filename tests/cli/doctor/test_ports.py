"""Checks of the access rights of nodes: mode, group, DeviceAllow= of the unit."""

import os

import pytest

from imud.cli.doctor.ports import nodes, rights, unit_rules
from imud.cli.doctor.surroundings import DoctorCheck
from tests.support.surroundings import Machine

RIGHTS, RULES = DoctorCheck("r", rights), DoctorCheck("u", unit_rules)
BOW = "bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}}"
ROOT = os.geteuid() == 0
PORT_GID = 4500 if ROOT else os.getegid()  # Group of the port. Only root can change the group of a file to any group.


@pytest.fixture
def bow(machine: Machine) -> Machine:
    """A host with a port of the group `port`. User 4000 does not own the port."""
    machine.configure(BOW)
    node = machine.port("ttyUSB0")
    if ROOT:
        os.chown(node, 0, PORT_GID)
    machine.write(
        "/etc/passwd", "root:x:0:0::/root:/bin/sh\nimud:x:4000:4001::/:/bin/false\nann:x:4002:4003::/:/bin/sh\n"
    )
    machine.write("/etc/group", f"port:x:{PORT_GID}:\nimud:x:4001:\nann:x:4003:\n")
    machine.uid, machine.gids = 4002, frozenset({4003})
    return machine


def test_a_service_with_the_group_and_one_without(bow: Machine) -> None:
    bow.unit("User=imud", "Group=imud", "SupplementaryGroups=i2c port spi")
    assert bow.told(RIGHTS) == [("ok", "user imud can open /dev/ttyUSB0 → ")]
    bow.unit("User=imud", "Group=imud", "SupplementaryGroups=i2c spi")
    bow.tells(RIGHTS, "error", "EACCES", "`sudo usermod --append --groups port imud`, then restart imud")


def test_a_node_of_group_root_needs_a_udev_rule(bow: Machine) -> None:
    if not ROOT:
        pytest.skip("only root can make a file of root's group")
    os.chown(bow.root / "dev/ttyUSB0", 0, 0)
    ((_, text),) = bow.told(RIGHTS)
    assert 'udev rule SUBSYSTEM=="tty", KERNEL=="ttyUSB*", GROUP="dialout", MODE="0660" in' in text


@pytest.mark.parametrize(
    ("node", "rule"),
    [
        ("ttyS0", 'SUBSYSTEM=="tty", KERNEL=="ttyS*", GROUP="dialout"'),
        ("ttymxc2", 'SUBSYSTEM=="tty", KERNEL=="ttymxc*", GROUP="dialout"'),
        ("tty7", 'SUBSYSTEM=="tty", KERNEL=="tty7", GROUP="dialout"'),
        ("pts/5", 'SUBSYSTEM=="tty", KERNEL=="5", GROUP="dialout"'),
        ("spidev0.0", 'SUBSYSTEM=="spidev", KERNEL=="spidev*", GROUP="spi"'),
    ],
)
def test_the_rule_is_for_nodes_of_the_kind_only(node: str, rule: str, bow: Machine) -> None:
    """A wider rule would close /dev/tty, which has the same subsystem, for all users."""
    bow.configure(f"bow: {{driver: hipnuc-uart, uart: {{port: /dev/{node}}}}}")
    bow.port(node, mode=0o600)
    ((_, text),) = bow.told(RIGHTS)
    assert rule in text


def test_a_user_who_joined_the_group_after_login(bow: Machine) -> None:
    bow.write("/etc/group", f"port:x:{PORT_GID}:ann\n")
    bow.tells(RIGHTS, "error", "log out and log in again")
    bow.gids = frozenset({4003, PORT_GID})
    assert bow.find(RIGHTS)[0].severity == "ok"


def test_the_mode_counts_too(bow: Machine) -> None:
    bow.gids = frozenset({PORT_GID})
    (bow.root / "dev/ttyUSB0").chmod(0o640)
    assert bow.find(RIGHTS)[0].severity == "error"
    assert "usermod" not in bow.find(RIGHTS)[0].advice  # a member of the group cannot open the node either
    (bow.root / "dev/ttyUSB0").chmod(0o606)
    assert bow.find(RIGHTS)[0].severity == "error"  # only the permissions of the group apply
    bow.gids = frozenset({4003})
    assert bow.find(RIGHTS)[0].severity == "ok"


def test_root_may_an_unknown_user_is_not_judged_and_a_unit_can_have_no_rules(bow: Machine) -> None:
    bow.unit("User=")
    assert bow.find(RIGHTS)[0].severity == "ok"
    bow.unit("User=dynamic")
    assert bow.find(RIGHTS)[0].severity == "not checked"
    bow.unit("DevicePolicy=auto")
    assert bow.find(RULES)[0].severity == "ok"


@pytest.mark.parametrize(
    ("line", "severity", "words"),
    [
        ("DeviceAllow=char-ttyUSB rw", "ok", "allows"), ("DeviceAllow=char-tty* rw", "ok", "allows"),
        ("DeviceAllow=/dev/ttyUSB0 rw", "ok", "allows"), ("DeviceAllow=char-ttyACM rw", "error", "EPERM"),
        ("DeviceAllow=/dev/ttyUSB1 rw", "error", "EPERM"),
        ("DeviceAllow=char-ttyUSB r", "error", "`DeviceAllow=char-ttyUSB rw`"),
        ("DevicePolicy=closed", "error", "EPERM"),
    ],
)  # fmt: skip
def test_rules_of_the_unit(bow: Machine, line: str, severity: str, words: str) -> None:
    bow.write("/proc/devices", "Character devices:\n  4 ttyS\n188 ttyUSB\n\nBlock devices:\n  8 sd\n")
    bow.unit(line)
    bow.tells(RULES, severity, words)


def test_a_class_that_the_kernel_does_not_have_yet(bow: Machine) -> None:
    bow.write("/proc/devices", "Character devices:\n  4 ttyS\n")
    bow.unit("DeviceAllow=char-ttyUSB rw")
    bow.tells(RULES, "warning", "/etc/modules-load.d")


def test_every_node_of_the_configuration_once(machine: Machine) -> None:
    machine.configure(
        "a: {driver: hipnuc-modbus, rs485: {line: /dev/ttyS1, address: 80}}",
        "b: {driver: hipnuc-modbus, rs485: {line: /dev/ttyS1, address: 81}}",
        "c: {driver: imu61x-i2c, i2c: {bus: 3}}",
        "d: {driver: imu61x-spi, spi: {port: /dev/spidev0.0}}",
        "e: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}, lines: {sout: {chip: gpiochip0, line: 4}}}",
    )
    at = machine.surroundings()
    assert at.config_problem == ""
    assert nodes(at) == ["/dev/ttyS1", "/dev/i2c-3", "/dev/spidev0.0", "/dev/ttyUSB0", "/dev/gpiochip0"]
