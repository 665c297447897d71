"""Checks of serial ports, and of the access rights of nodes: mode, group, DeviceAllow= of the unit."""

import os

import pytest

from imud.cli.doctor.ports import latency_timer, modem_manager, nodes, ports_present, ports_taken, rights, unit_rules
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import DeviceState
from tests.support.metrics import device
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
    users = ("root:x:0:0::/root:/bin/sh", "imud:x:4000:4001::/:/bin/false", "ann:x:4002:4003::/:/bin/sh")
    machine.write("/etc/passwd", "\n".join(users) + "\n")
    machine.write("/etc/group", f"port:x:{PORT_GID}:\nimud:x:4001:\nann:x:4003:\n")
    machine.uid, machine.gids = 4002, frozenset({4003})
    return machine


def test_users_of_a_service(bow: Machine) -> None:
    bow.unit("User=imud", "Group=imud", "SupplementaryGroups=i2c port spi")
    assert bow.told(RIGHTS) == [("ok", "user imud can open /dev/ttyUSB0 → ")]
    bow.unit("User=imud", "Group=imud", "SupplementaryGroups=i2c spi")
    bow.tells(RIGHTS, "error", "EACCES", "`sudo usermod --append --groups port imud`, then restart imud")
    bow.unit("User=")
    assert bow.find(RIGHTS)[0].severity == "ok"
    bow.unit("User=dynamic")
    assert bow.find(RIGHTS)[0].severity == "not checked"
    bow.unit("DevicePolicy=auto")
    assert bow.find(RULES)[0].severity == "ok"


def test_a_node_of_group_root_needs_a_udev_rule(bow: Machine) -> None:
    if not ROOT:
        pytest.skip("only root can make a file of root's group")
    os.chown(bow.root / "dev/ttyUSB0", 0, 0)
    ((_, text),) = bow.told(RIGHTS)
    assert 'udev rule SUBSYSTEM=="tty", KERNEL=="ttyUSB*", GROUP="dialout", MODE="0660" in' in text
    os.chown(bow.root / "dev/ttyUSB0", bow.uid, 0)
    for mode, severity in ((0o600, "ok"), (0o466, "error"), (0o266, "error")):  # only the permissions of the owner
        (bow.root / "dev/ttyUSB0").chmod(mode)
        assert bow.find(RIGHTS)[0].severity == severity


def test_the_rule_is_for_nodes_of_the_kind_only(bow: Machine) -> None:
    """A wider rule would close /dev/tty, which has the same subsystem, for all users."""
    for node, rule in [
        ("ttyS0", 'SUBSYSTEM=="tty", KERNEL=="ttyS*", GROUP="dialout"'),
        ("ttymxc2", 'SUBSYSTEM=="tty", KERNEL=="ttymxc*", GROUP="dialout"'),
        ("tty7", 'SUBSYSTEM=="tty", KERNEL=="tty7", GROUP="dialout"'),
        ("pts/5", 'SUBSYSTEM=="tty", KERNEL=="5", GROUP="dialout"'),
        ("spidev0.0", 'SUBSYSTEM=="spidev", KERNEL=="spidev*", GROUP="spi"'),
    ]:
        bow.configure(f"bow: {{driver: hipnuc-uart, uart: {{port: /dev/{node}}}}}")
        bow.port(node, mode=0o600)
        ((severity, text),) = bow.told(RIGHTS)
        assert (severity, rule in text) == ("error", True), text


def test_a_user_who_joined_the_group_after_login_and_the_mode_and_rules_of_the_unit(bow: Machine) -> None:
    bow.write("/etc/group", f"port:x:{PORT_GID}:ann\n")
    bow.tells(RIGHTS, "error", "log out and log in again")
    bow.gids = frozenset({4003, PORT_GID})
    assert bow.find(RIGHTS)[0].severity == "ok"
    (bow.root / "dev/ttyUSB0").chmod(0o640)
    assert bow.find(RIGHTS)[0].severity == "error"
    assert "usermod" not in bow.find(RIGHTS)[0].advice  # a member of the group cannot open the node either
    (bow.root / "dev/ttyUSB0").chmod(0o606)
    assert bow.find(RIGHTS)[0].severity == "error"  # only the permissions of the group apply
    bow.gids = frozenset({4003})
    assert bow.find(RIGHTS)[0].severity == "ok"
    for line, severity, words in [
        ("DeviceAllow=char-ttyUSB rw", "ok", "allows"), ("DeviceAllow=char-tty* rw", "ok", "allows"),
        ("DeviceAllow=/dev/ttyUSB0 rw", "ok", "allows"), ("DeviceAllow=char-ttyACM rw", "error", "EPERM"),
        ("DeviceAllow=/dev/ttyUSB1 rw", "error", "EPERM"),
        ("DeviceAllow=char-ttyUSB r", "error", "`DeviceAllow=char-ttyUSB rw`"),
        ("DevicePolicy=closed", "error", "EPERM"),
    ]:  # fmt: skip
        bow.write("/proc/devices", "Character devices:\n  4 ttyS\n188 ttyUSB\n\nBlock devices:\n  8 sd\n")
        bow.unit(line)
        bow.tells(RULES, severity, words)
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


PRESENT, TAKEN = DoctorCheck("p", ports_present), DoctorCheck("t", ports_taken)
MODEM, LATENCY = DoctorCheck("m", modem_manager), DoctorCheck("l", latency_timer)


def test_a_port_that_is_absent_and_one_with_a_stable_name(machine: Machine) -> None:
    machine.configure(BOW)
    assert machine.told(PRESENT)[0][1].startswith(
        "/dev/ttyUSB0 does not exist; ports of this host: none → is the cable"
    )
    machine.port("ttyUSB1")
    question = "→ is the cable plugged in, does the device use another of these ports?"
    machine.tells(PRESENT, "error", f"ports of this host: /dev/ttyUSB1 {question}")
    machine.configure()
    assert "ports of this host: /dev/ttyUSB1" in machine.told(PRESENT)[0][1], "without serial devices, too"
    machine.configure(BOW)
    machine.port("ttyUSB0")
    assert machine.find(PRESENT)[0].severity == "ok"
    folder = machine.root / "dev/serial/by-id"
    folder.mkdir(parents=True)
    (folder / "usb-FTDI_1").symlink_to("../../ttyUSB0")
    assert machine.told(PRESENT) == [
        ("note", "/dev/ttyUSB0 can get another number when the adapter is plugged in again → "
         "use the name /dev/serial/by-id/usb-FTDI_1 in the configuration")
    ]  # fmt: skip
    for name in ("serial0", "ttyAMA10"):
        machine.configure(BOW.replace("ttyUSB0", name))
        machine.tells(PRESENT, "error", f"/dev/{name} does not exist", "→ enable the UART: `enable_uart=1` in /boot")
        machine.port(name)
        machine.tells(PRESENT, "ok", f"/dev/{name} exists")


def test_who_uses_a_port(machine: Machine) -> None:
    machine.configure(BOW)
    assert machine.find(TAKEN) == []  # the port does not exist
    machine.port("ttyUSB0")
    machine.tells(TAKEN, "not checked", "sudo imud doctor")  # a user cannot see all programs
    machine.status = [device("bow")]  # the device runs: imud uses the port exclusively
    assert machine.find(TAKEN)[0].severity == "ok"
    problem = "/dev/ttyUSB0 is in use by gpsd (pid 3): stop that first"
    machine.status = [device("bow", state=DeviceState.FAILED, problem=problem)]
    assert machine.told(TAKEN) == [("error", f"{problem} → `sudo imud doctor` shows the program")]
    machine.uid, machine.status = 0, []
    machine.hold("ttyUSB0", "python3", command="/usr/bin/python3 /usr/bin/imud run")
    assert machine.find(TAKEN)[0].severity == "ok"
    machine.hold("ttyUSB0", "minicom", 11)
    machine.tells(TAKEN, "error", "/dev/ttyUSB0 is open in another program: minicom (pid 11)")


def test_a_console_and_latency_timers_and_modem_manager_concerns_usb_ports_only(machine: Machine) -> None:
    machine.configure(BOW)
    machine.port("ttyUSB0")
    machine.uid = 0
    machine.write("/sys/class/tty/console/active", "tty0 ttyUSB0\n")
    severity, text = machine.told(TAKEN)[0]
    assert severity == "error"
    assert "console=ttyUSB0" in text
    machine.port("ttyUSB0")
    assert machine.find(LATENCY) == []  # an adapter without a latency timer
    machine.write("/sys/class/tty/ttyUSB0/device/latency_timer", "2\n")
    machine.tells(LATENCY, "warning", "up to 2 ms", 'ATTR{latency_timer}="1"')
    machine.write("/sys/class/tty/ttyUSB0/device/latency_timer", "1\n")
    assert machine.find(LATENCY)[0].severity == "ok"
    machine.configure(BOW)
    machine.prints("systemctl is-active ModemManager", "active\n")
    assert machine.find(MODEM)[0].severity == "warning"
    machine.prints("systemctl is-active ModemManager", "", 1, "System has not been booted with systemd")
    assert machine.find(MODEM)[0].severity == "not checked"
    machine.prints("systemctl is-active ModemManager", "inactive\n", 3)
    assert machine.find(MODEM)[0].severity == "ok"
    machine.configure("bow: {driver: hipnuc-uart, uart: {port: /dev/ttyAMA0, baud: 115200}}")
    assert machine.find(MODEM) == []
