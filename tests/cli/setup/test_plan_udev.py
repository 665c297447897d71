"""udev rules of adapters from simulated /sys trees."""

from typing import NoReturn

import pytest

from imud.cli.setup.plan import RULES, UsbAdapter, modem_manager_runs, rules, usb_adapter
from tests.cli.setup.conftest import LivingMachine

WHICH = 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6001", ATTRS{serial}=="A1"'
LATENCY = f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", {WHICH}, ATTR{{latency_timer}}="1"'
MODEM = f'ACTION!="remove", SUBSYSTEM=="tty", {WHICH}, ENV{{ID_MM_DEVICE_IGNORE}}="1", ENV{{ID_MM_PORT_IGNORE}}="1"'
FTDI = UsbAdapter("ttyUSB0", "ftdi_sio", "0403", "6001", "A1")
OTHER = UsbAdapter("ttyUSB1", "cp210x", "10c4", "ea60", "")


def lines(machine: LivingMachine, *adapters: UsbAdapter) -> list[str]:
    change = rules(machine.surroundings(), adapters)
    return [] if change is None else change.content.decode().splitlines()[1:]


def test_an_adapter_is_found_and_gets_a_latency_timer(machine: LivingMachine) -> None:
    machine.usb_port("ttyUSB0")
    machine.uart("ttyAMA0")
    at = machine.surroundings()
    assert usb_adapter(at, "/dev/ttyUSB0") == FTDI
    assert usb_adapter(at, "/dev/ttyAMA0") is None
    assert lines(machine, FTDI, OTHER) == [LATENCY]


@pytest.mark.parametrize(
    ("states", "ignores"),
    [(["enabled", "inactive"], True), (["disabled", "active"], True), (["disabled", "inactive"], False)],
)
def test_modem_manager_ignores_all_where_it_may_run(machine: LivingMachine, states: list[str], ignores: bool) -> None:
    machine.units["ModemManager.service"] = states
    other = 'ATTRS{idVendor}=="10c4", ATTRS{idProduct}=="ea60"'
    both = [LATENCY, MODEM, MODEM.replace(WHICH, other)] if ignores else [LATENCY]
    assert lines(machine, FTDI, OTHER) == both


def test_a_host_without_systemctl_has_no_modem_manager(machine: LivingMachine) -> None:
    def missing(_words: object) -> NoReturn:
        raise FileNotFoundError(2, "No such file or directory")

    at = machine.surroundings()
    at.run = missing
    assert not modem_manager_runs(at)


def test_lines_that_are_there_stay_and_are_not_proposed_again(machine: LivingMachine) -> None:
    machine.write(RULES, f"# mine\n{LATENCY}\n")
    assert lines(machine, FTDI) == []
    second = FTDI._replace(serial="A2", node="ttyUSB3")
    change = rules(machine.surroundings(), [FTDI, second])
    assert change is not None
    assert change.content.decode().splitlines() == ["# mine", LATENCY, LATENCY.replace('"A1"', '"A2"')]
    assert "--sysname-match=ttyUSB3" in change.then[1]


def test_what_means_something_in_a_pattern_matches_any_character(machine: LivingMachine) -> None:
    (line,) = lines(machine, FTDI._replace(serial='A"*[1]|$x\n'))
    assert 'ATTRS{serial}=="A???1???x?"' in line
