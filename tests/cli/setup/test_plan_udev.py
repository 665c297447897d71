"""udev rules of adapters from simulated /sys trees."""

from unittest.mock import Mock

import pytest

from imud import config
from imud.cli.setup import plan
from imud.config.yaml import read_yaml
from imud.model.errors import ImudError
from tests.cli.setup.conftest import LivingMachine
from tests.support.files import ROOT

WHICH = 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6001", ATTRS{serial}=="A1"'
LATENCY = f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", {WHICH}, ATTR{{latency_timer}}="1"'
MODEM = f'ACTION!="remove", SUBSYSTEM=="tty", {WHICH}, ENV{{ID_MM_DEVICE_IGNORE}}="1", ENV{{ID_MM_PORT_IGNORE}}="1"'
FTDI = plan.UsbAdapter("ttyUSB0", "ftdi_sio", "0403", "6001", "A1")
OTHER = plan.UsbAdapter("ttyUSB1", "cp210x", "10c4", "ea60", "")


def lines(machine: LivingMachine, *adapters: plan.UsbAdapter) -> list[str]:
    change = plan.rules(machine.surroundings(), adapters)
    return [] if change is None else change.content.decode().splitlines()[1:]


def test_an_adapter_is_found_and_gets_a_latency_timer(machine: LivingMachine) -> None:
    machine.usb_port("ttyUSB0")
    machine.uart("ttyAMA0")
    at = machine.surroundings()
    assert plan.usb_adapter(at, "/dev/ttyUSB0") == FTDI
    assert plan.usb_adapter(at, "/dev/ttyAMA0") is None
    assert lines(machine, FTDI, OTHER) == [LATENCY]
    (line,) = lines(machine, FTDI._replace(serial='A"*[1]|$x\n'))
    assert 'ATTRS{serial}=="A???1???x?"' in line


def test_modem_manager_ignores_all_where_it_may_run(machine: LivingMachine) -> None:
    both = [LATENCY, MODEM, MODEM.replace(WHICH, 'ATTRS{idVendor}=="10c4", ATTRS{idProduct}=="ea60"')]
    for enabled, active, expected in [
        ("enabled", "inactive", both), ("disabled", "active", both), ("disabled", "inactive", [LATENCY]),
    ]:  # fmt: skip
        machine.units["ModemManager.service"] = [enabled, active]
        assert lines(machine, FTDI, OTHER) == expected
    at = machine.surroundings()
    at.run = Mock(side_effect=FileNotFoundError(2, "No such file or directory"))  # a host without systemctl
    assert not plan.modem_manager_runs(at)


def test_lines_that_are_there_stay_and_are_not_proposed_again(machine: LivingMachine) -> None:
    machine.write(plan.RULES, f"# mine\n{LATENCY}\n")
    assert lines(machine, FTDI) == []
    change = plan.rules(machine.surroundings(), [FTDI, FTDI._replace(serial="A2", node="ttyUSB3")])
    assert change is not None
    assert change.content.decode().splitlines() == ["# mine", LATENCY, LATENCY.replace('"A1"', '"A2"')]
    assert "--sysname-match=ttyUSB3" in change.then[1]


NEW = {"imu": {"driver": "auto", "uart": {"port": "/dev/serial/by-id/usb-A"}}}
BLOCK = "  imu:\n    driver: auto\n    uart:\n      port: /dev/serial/by-id/usb-A\n"
EXAMPLE = (ROOT / "etc/imud.yaml").read_bytes()


def test_without_a_file_one_is_made_and_disabled_devices_have_names() -> None:
    text = plan.with_devices(None, NEW).decode()
    assert text.endswith("devices:\n" + BLOCK)
    assert [one.name for one in config.parse(text, "new").devices] == ["imu"]
    assert plan.device_names(b"devices:\n  bow: {enabled: false, uart: {port: /dev/ttyS0}}\n") == ["bow"]
    assert plan.device_names(None) == []


def test_a_block_goes_behind_the_key_or_is_left_to_the_person() -> None:
    for before, after in [
        ("devices: {}\n", "devices:\n" + BLOCK),
        ("devices: {}  # none yet\n", "devices:  # none yet\n" + BLOCK),
        ("log_level: info\n", "log_level: info\n\ndevices:\n" + BLOCK),
        (
            "devices:\n  bow: {uart: {port: /dev/ttyS0}}\nsocket:\n",
            "devices:\n" + BLOCK + "\n  bow: {uart: {port: /dev/ttyS0}}\nsocket:\n",
        ),
        (
            "devices:  # all\n    # first\n    bow:\n        uart:\n            port: /dev/ttyS0\n",
            "devices:  # all\n    imu:\n      driver: auto\n      uart:\n        port: /dev/serial/by-id/usb-A\n\n"
            "    # first\n    bow:\n        uart:\n            port: /dev/ttyS0\n",
        ),
        ("devices:\r\n  bow: {uart: {port: /dev/ttyS0}}\r\n", None),
        ("\ufeffdevices: {}", "devices:\n" + BLOCK),
    ]:
        made = plan.with_devices(before.encode(), NEW).decode()
        assert after is None or made == after
        assert made.count("\r\n") in (0, made.count("\n"))
        old, new = read_yaml(before.encode()).data, read_yaml(made.encode()).data
        assert isinstance(old, dict)
        assert new == {**old, "devices": {**(old.get("devices") or {}), **NEW}}
    for before in ["devices: {bow: {uart: {port: /dev/ttyS0}}}\n", "{devices: {}}\n", "- a\n"]:
        with pytest.raises(ImudError, match="cannot add the devices") as refused:
            plan.with_devices(before.encode(), NEW)
        assert BLOCK.rstrip() in str(refused.value)


def test_the_example_of_the_package_is_known_and_only_its_device_is_replaced() -> None:
    assert plan.is_example(EXAMPLE)
    assert not plan.is_example(EXAMPLE + b"  bow: {uart: {port: /dev/ttyS9}}\n")
    mast = {"driver": "imu61x-can", "socketcan": {"interface": "can0"}}
    made = plan.with_devices(EXAMPLE, {"mast": mast}, replace="imu")
    assert plan.device_names(made) == ["mast"]
    before, rest = EXAMPLE.decode().split("  imu:\n")
    after = "".join(rest.splitlines(keepends=True)[7:])  # link and port of the example, and comments
    assert made.decode() == f"{before}  mast:\n    driver: imu61x-can\n    socketcan:\n      interface: can0\n{after}"
    assert config.parse(made, "made").devices[0].name == "mast"


def test_names_of_ports_stay_what_they_are() -> None:
    for text, written in [
        ("/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1", "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1"),
        ("/dev/serial/by-id/usb-A #1", '"/dev/serial/by-id/usb-A #1"'),
        ("/dev/serial/by-id/usb-\\x20", '"/dev/serial/by-id/usb-\\\\x20"'),
        ("no", '"no"'),
        ("12", '"12"'),
        ("a: b", '"a: b"'),
    ]:  # fmt: skip
        made = plan.with_devices(None, {"imu": {"uart": {"port": text}}}).decode()
        assert f"port: {written}\n" in made
        assert read_yaml(made.encode()).data == {"devices": {"imu": {"uart": {"port": text}}}}
