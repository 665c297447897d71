"""Attached devices, and the configured devices among them."""

import pytest

from imud.cli.setup.hardware import Attached, Wanted, look
from tests.cli.setup.conftest import Attachments, LivingMachine
from tests.support.metrics import device

USB0, USB1 = "/dev/serial/by-id/usb-A", "/dev/serial/by-id/usb-B"


@pytest.fixture
def gateway(machine: LivingMachine) -> LivingMachine:
    machine.usb_port("ttyUSB0", "usb-A", serial="A")
    machine.usb_port("ttyUSB1", "usb-B", serial="B")
    machine.configure()
    return machine


def found(machine: LivingMachine, attachments: Attachments, wanted: Wanted = Wanted()) -> list[Attached]:  # noqa: B008
    return look(machine.surroundings(), wanted, attachments.finders())


def test_only_what_is_named_is_listened_to(gateway: LivingMachine, attachments: Attachments) -> None:
    gateway.can("can0", up=True)
    found(gateway, attachments, Wanted(("/dev/ttyUSB1",)))
    assert attachments.listened == [USB1]
    attachments.listened.clear()
    found(gateway, attachments, Wanted(("can0", USB0), active=("/dev/ttyUSB0",)))
    assert (attachments.listened, attachments.active) == ([USB0, "can0"], {USB0})


def test_a_port_that_is_asked_by_modbus_is_not_listened_to(gateway: LivingMachine, attachments: Attachments) -> None:
    keys = {"driver": "hipnuc-modbus", "rs485": {"line": USB0, "baud": 115200, "address": 80}}
    attachments.lines[USB0] = [Attached(USB0, USB0, driver="hipnuc-modbus", device="address 80", keys=keys)]
    here = found(gateway, attachments, Wanted(rs485=((USB0, 0),)))
    assert attachments.listened == [USB1]
    assert [one.keys for one in here if one.driver] == [keys]


def test_modem_manager_lets_go_of_a_port(gateway: LivingMachine, attachments: Attachments) -> None:
    gateway.hold("ttyUSB0", "ModemManager")
    assert "run imud setup again" in found(gateway, attachments)[0].problem


def test_a_configured_port_is_shown_with_what_the_daemon_says(gateway: LivingMachine, attachments: Attachments) -> None:
    gateway.configure("bow: {uart: {port: /dev/serial/by-id/usb-A}}", "mast: {uart: {port: /dev/ttyUSB1}}")
    gateway.units["imud.service"] = ["enabled", "active"]
    gateway.status = [device("bow"), device("mast", state="searching", problem="nothing is heard")]
    bow, mast = found(gateway, attachments)
    assert (bow.configured, bow.driver, bow.problem) == ("bow", "hipnuc-uart", "")
    assert (mast.configured, mast.driver, mast.problem) == ("mast", "", "nothing is heard")
    assert attachments.listened == []


@pytest.mark.parametrize(
    ("configured", "names"),
    [
        (["a: {driver: hipnuc-canopen, options: {node: 8}, socketcan: {interface: can0}}"], ["a", ""]),
        (["a: {driver: hipnuc-canopen, options: {node: 7}, socketcan: {interface: can0}}"], ["", ""]),
        (["a: {driver: hipnuc-canopen, options: {node: 8}, socketcan: {interface: can1}}"], ["", ""]),
        (["a: {driver: auto, socketcan: {interface: can0}}"], ["a", ""]),
        (
            [
                "a: {driver: auto, socketcan: {interface: can0}}",
                "b: {driver: hipnuc-canopen, options: {node: 8}, socketcan: {interface: can0}}",
            ],
            ["b", "a"],
        ),
    ],
)
def test_devices_of_a_bus_are_told_apart(
    machine: LivingMachine, attachments: Attachments, configured: list[str], names: list[str]
) -> None:
    machine.can("can0", up=True)
    machine.configure(*configured)
    attachments.hears("can0", "hipnuc-canopen", "node 8", 500_000)
    attachments.hears("can0", "imu61x-can", "base_id 101", 500_000)
    here = found(machine, attachments)
    assert [one.configured for one in here] == names
    assert here[1].keys == {"driver": "imu61x-can", "options": {"base_id": 101}, "socketcan": {"interface": "can0"}}


def test_an_rs485_module_that_is_configured_is_known(gateway: LivingMachine, attachments: Attachments) -> None:
    gateway.configure(f"deck: {{driver: hipnuc-modbus, rs485: {{line: {USB0}, address: 80}}}}")
    keys = {"driver": "hipnuc-modbus", "rs485": {"line": USB0, "baud": 115200, "address": 80}}
    other = {"driver": "hipnuc-modbus", "rs485": {"line": USB0, "baud": 115200, "address": 81}}
    attachments.lines[USB0] = [
        Attached(USB0, USB0, driver="hipnuc-modbus", keys=one) for one in (keys, other)
    ]  # fmt: skip
    here = found(gateway, attachments, Wanted(rs485=((USB0, 0),)))
    assert [one.configured for one in here if one.driver] == ["deck", ""]


def test_devices_of_other_buses_are_not_the_configured_device(machine: LivingMachine, attachments: Attachments) -> None:
    machine.configure(f"deck: {{driver: auto, rs485: {{line: {USB0}, address: 80}}}}")
    machine.can("can0", up=True)
    attachments.hears("can0", "hipnuc-canopen", "node 8", 500_000)
    assert [one.configured for one in found(machine, attachments)] == [""]


def test_an_interface_that_is_down_is_not_listened_to(machine: LivingMachine, attachments: Attachments) -> None:
    machine.can("can0")
    machine.can("can1")
    problem = "the interface is down; bring it up with --can {0}=BITRATE"
    for wanted, names in ((Wanted(("can0",)), ["can0"]), (Wanted(), ["can0", "can1"])):
        assert [one.problem for one in found(machine, attachments, wanted)] == list(map(problem.format, names))
    assert attachments.listened == []


def test_a_bus_that_is_asked_for(machine: LivingMachine, attachments: Attachments) -> None:
    machine.configure("keel: {driver: imu61x-i2c, i2c: {bus: 1}}")
    keys = {"driver": "imu61x-i2c", "i2c": {"bus": 1, "address": 0x18}}
    attachments.buses["i2c1"] = [Attached("/dev/i2c-1", "/dev/i2c-1", driver="imu61x-i2c", keys=keys)]
    (here,) = found(machine, attachments, Wanted(buses=(("i2c", "1"),)))
    assert here.configured == "keel"


def test_what_is_named_and_not_there_is_said_to_be(gateway: LivingMachine, attachments: Attachments) -> None:
    """Otherwise a misspelled name looks like a host without ports."""
    gateway.write("/etc/passwd")
    wanted = Wanted((USB0, "ttyUSB1", "can7", "/etc/passwd"), active=("/dev/ttyUSB9",))
    problems = {one.place: one.problem for one in found(gateway, attachments, wanted)}
    missing = "no such port or interface: is the adapter plugged in, is the name correct?"
    assert problems == {
        USB0: "nothing is heard", "ttyUSB1": missing, "can7": missing, "/dev/ttyUSB9": missing,
        "/etc/passwd": "this is not a serial port of a hardware device",
    }  # fmt: skip
