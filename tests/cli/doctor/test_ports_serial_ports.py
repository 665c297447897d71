"""Checks of serial ports with a simulated /dev, /sys and /proc."""

import os

import pytest

from imud.cli.doctor.ports import latency_timer, modem_manager, ports_present, ports_taken
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import DeviceState
from tests.support.metrics import device
from tests.support.surroundings import Machine

PRESENT, TAKEN = DoctorCheck("p", ports_present), DoctorCheck("t", ports_taken)
MODEM, LATENCY = DoctorCheck("m", modem_manager), DoctorCheck("l", latency_timer)


@pytest.fixture
def bow(machine: Machine) -> Machine:
    machine.configure("bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}}")
    return machine


def hold(machine: Machine, pid: int, name: str, *, command: str = "") -> None:
    machine.write(f"/proc/{pid}/comm", name + "\n")
    machine.write(f"/proc/{pid}/cmdline", command.replace(" ", "\0"))
    (machine.root / f"proc/{pid}/fd").mkdir()
    (machine.root / f"proc/{pid}/fd/3").symlink_to(os.path.realpath(machine.root / "dev/ttyUSB0"))


def test_a_port_that_is_absent_and_one_with_a_stable_name(bow: Machine) -> None:
    assert bow.told(PRESENT)[0][1].startswith("/dev/ttyUSB0 does not exist; ports of this host: none → is the cable")
    bow.port("ttyUSB1")
    bow.tells(
        PRESENT,
        "error",
        "ports of this host: /dev/ttyUSB1 → is the cable plugged in, does the device use another of these ports?",
    )
    bow.port("ttyUSB0")
    assert bow.find(PRESENT)[0].severity == "ok"
    folder = bow.root / "dev/serial/by-id"
    folder.mkdir(parents=True)
    (folder / "usb-FTDI_1").symlink_to("../../ttyUSB0")
    assert bow.told(PRESENT) == [
        ("note", "/dev/ttyUSB0 can get another number when the adapter is plugged in again → "
         "use the name /dev/serial/by-id/usb-FTDI_1 in the configuration")
    ]  # fmt: skip


def test_without_serial_devices_the_ports_are_listed(machine: Machine) -> None:
    machine.port("ttyUSB1")
    assert "ports of this host: /dev/ttyUSB1" in machine.told(PRESENT)[0][1]


def test_another_program_and_the_daemon_on_a_port(bow: Machine) -> None:
    assert bow.find(TAKEN) == []  # the port does not exist
    bow.port("ttyUSB0")
    bow.uid = 0
    hold(bow, 10, "python3", command="/usr/bin/python3 /usr/bin/imud run")
    assert bow.find(TAKEN)[0].severity == "ok"
    hold(bow, 11, "minicom")
    bow.tells(TAKEN, "error", "/dev/ttyUSB0 is open in another program: minicom (pid 11)")


def test_a_user_cannot_say_that_a_port_is_free(bow: Machine) -> None:
    bow.port("ttyUSB0")
    bow.tells(TAKEN, "not checked", "sudo imud doctor")
    bow.status = [device("bow")]  # the device runs: imud uses the port exclusively
    assert bow.find(TAKEN)[0].severity == "ok"
    problem = "/dev/ttyUSB0 is in use by gpsd (pid 3): stop that first"
    bow.status = [device("bow", state=DeviceState.FAILED, problem=problem)]
    assert bow.told(TAKEN) == [("error", f"{problem} → `sudo imud doctor` shows the program")]


def test_a_console_and_latency_timers(bow: Machine) -> None:
    bow.port("ttyUSB0")
    bow.uid = 0
    bow.write("/sys/class/tty/console/active", "tty0 ttyUSB0\n")
    severity, text = bow.told(TAKEN)[0]
    assert severity == "error"
    assert "console=ttyUSB0" in text
    bow.port("ttyUSB0")
    assert bow.find(LATENCY) == []  # an adapter without a latency timer
    bow.write("/sys/class/tty/ttyUSB0/device/latency_timer", "16\n")
    bow.tells(LATENCY, "warning", "up to 16 ms", 'ATTR{latency_timer}="1"')
    bow.write("/sys/class/tty/ttyUSB0/device/latency_timer", "1\n")
    assert bow.find(LATENCY)[0].severity == "ok"


def test_modem_manager_concerns_usb_ports_only(bow: Machine) -> None:
    bow.prints("systemctl is-active ModemManager", "active\n")
    assert bow.find(MODEM)[0].severity == "warning"
    bow.prints("systemctl is-active ModemManager", "", 1, "System has not been booted with systemd")
    assert bow.find(MODEM)[0].severity == "not checked"
    bow.prints("systemctl is-active ModemManager", "inactive\n", 3)
    assert bow.find(MODEM)[0].severity == "ok"
    bow.configure("bow: {driver: hipnuc-uart, uart: {port: /dev/ttyAMA0, baud: 115200}}")
    assert bow.find(MODEM) == []
