"""Attached devices, and the configured devices among them."""

import os
import threading
from functools import partial
from pathlib import Path
from random import Random
from types import SimpleNamespace

import pytest

from imud.cli.setup import hardware as finders
from imud.cli.setup.changes import CommandChange, FileChange
from imud.cli.setup.hardware import FINDERS, Attached, Wanted, free_console, look, raise_can
from imud.contracts.driver import StreamDriver
from imud.drivers import DRIVERS
from imud.links.i2c import I2cLink, I2cOptions
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.ports.in_process_bus import InProcessI2c
from tests.cli.setup.conftest import Attachments, LivingMachine
from tests.support.metrics import device
from tests.support.pty_port import BAUD, PtyPort, slave, wired

USB0, USB1 = "/dev/serial/by-id/usb-A", "/dev/serial/by-id/usb-B"


@pytest.fixture
def gateway(machine: LivingMachine) -> LivingMachine:
    machine.usb_port("ttyUSB0", "usb-A", serial="A")
    machine.usb_port("ttyUSB1", "usb-B", serial="B")
    machine.configure()
    return machine


def found(machine: LivingMachine, attachments: Attachments, wanted: Wanted = Wanted()) -> list[Attached]:  # noqa: B008
    return look(machine.surroundings(), wanted, attachments.finders())


def test_only_free_ports_that_are_named_are_listened_to(gateway: LivingMachine, attachments: Attachments) -> None:
    gateway.can("can0", up=True)
    found(gateway, attachments, Wanted(("/dev/ttyUSB1",)))
    assert attachments.listened == [USB1]
    attachments.listened.clear()
    found(gateway, attachments, Wanted(("can0", USB0), active=("/dev/ttyUSB0",)))
    assert (attachments.listened, attachments.active) == ([USB0, "can0"], {USB0})
    gateway.hold("ttyUSB0", "ModemManager")
    assert "run imud setup again" in found(gateway, attachments)[0].problem


def test_a_port_that_is_asked_by_modbus_is_not_listened_to(gateway: LivingMachine, attachments: Attachments) -> None:
    keys = [{"driver": "hipnuc-modbus", "rs485": {"line": USB0, "baud": 115200, "address": at}} for at in (80, 81)]
    attachments.lines[USB0] = [Attached(USB0, USB0, driver="hipnuc-modbus", keys=one) for one in keys]
    here = found(gateway, attachments, Wanted(rs485=((USB0, 0),)))
    assert attachments.listened == [USB1]
    assert [(one.keys, one.configured) for one in here if one.driver] == [(one, "") for one in keys]
    gateway.configure(f"deck: {{driver: hipnuc-modbus, rs485: {{line: {USB0}, address: 80}}}}")
    here = found(gateway, attachments, Wanted(rs485=((USB0, 0),)))
    assert [one.configured for one in here if one.driver] == ["deck", ""]


def test_a_configured_port_is_shown_with_what_the_daemon_says(gateway: LivingMachine, attachments: Attachments) -> None:
    gateway.configure("bow: {uart: {port: /dev/serial/by-id/usb-A}}", "mast: {uart: {port: /dev/ttyUSB1}}")
    gateway.units["imud.service"] = ["enabled", "active"]
    gateway.status = [device("bow"), device("mast", state="searching", problem="nothing is heard")]
    bow, mast = found(gateway, attachments)
    assert (bow.configured, bow.driver, bow.problem) == ("bow", "hipnuc-uart", "")
    assert (mast.configured, mast.driver, mast.problem) == ("mast", "", "nothing is heard")
    assert attachments.listened == []


def test_devices_of_a_bus_are_told_apart(machine: LivingMachine, attachments: Attachments) -> None:
    machine.can("can0", up=True)
    attachments.hears("can0", "hipnuc-canopen", "node 8", 500_000)
    attachments.hears("can0", "imu61x-can", "base_id 101", 500_000)
    node8 = "driver: hipnuc-canopen, options: {node: 8}"
    for configured, names in [
        ([f"a: {{{node8}, socketcan: {{interface: can0}}}}"], ["a", ""]),
        (["a: {driver: hipnuc-canopen, options: {node: 7}, socketcan: {interface: can0}}"], ["", ""]),
        ([f"a: {{{node8}, socketcan: {{interface: can1}}}}"], ["", ""]),
        (["a: {driver: auto, socketcan: {interface: can0}}"], ["a", ""]),
        (["a: {driver: auto, socketcan: {interface: can0}}", f"b: {{{node8}, socketcan: {{interface: can0}}}}"],
         ["b", "a"]),
        ([f"deck: {{driver: auto, rs485: {{line: {USB0}, address: 80}}}}"], ["", ""]),  # a device of another bus
    ]:  # fmt: skip
        machine.configure(*configured)
        here = found(machine, attachments)
        assert [one.configured for one in here] == names, configured
        keys = {"driver": "imu61x-can", "options": {"base_id": 101}, "socketcan": {"interface": "can0"}}
        assert here[1].keys == keys


def test_a_bus_that_is_asked_for_and_one_that_is_down(machine: LivingMachine, attachments: Attachments) -> None:
    machine.configure("keel: {driver: imu61x-i2c, i2c: {bus: 1}}")
    keys = {"driver": "imu61x-i2c", "i2c": {"bus": 1, "address": 0x18}}
    attachments.buses["i2c1"] = [Attached("/dev/i2c-1", "/dev/i2c-1", driver="imu61x-i2c", keys=keys)]
    (here,) = found(machine, attachments, Wanted(buses=(("i2c", "1"),)))
    assert here.configured == "keel"
    machine.can("can0")
    machine.can("can1")
    problem = "the interface is down; bring it up with --can {0}=BITRATE"
    for wanted, names in ((Wanted(("can0",)), ["can0"]), (Wanted(), ["can0", "can1"])):
        assert [one.problem for one in found(machine, attachments, wanted)] == list(map(problem.format, names))
    assert attachments.listened == []


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


def test_a_port_is_listened_to() -> None:
    driver = DRIVERS["hipnuc-uart"]
    assert isinstance(driver, StreamDriver)
    port = PtyPort()
    frame = driver.example_frame(Random(1))
    stop = threading.Event()

    def feed() -> None:
        while not stop.wait(0.01):
            os.write(port.master, frame)

    feeder = threading.Thread(target=feed)
    feeder.start()
    try:
        (report,) = FINDERS.listen([port.path], set())
    finally:
        stop.set()
        feeder.join()
    os.close(port.master)
    os.close(port.slave)
    assert (report.port, report.driver, report.problem) == (port.path, "hipnuc-uart", "")


def test_a_line_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finders, "SLAVES", range(2, 4))
    monkeypatch.setattr(finders, "FACTORY_ID", 2)
    monkeypatch.setattr(finders, "REPLY_MS", 400)
    with wired(tmp_path, slave(2)) as (path, _):
        (found,) = FINDERS.scan_rs485(str(path), BAUD)
    assert found.keys == {"driver": "hipnuc-modbus", "rs485": {"line": str(path), "baud": BAUD, "address": 2}}
    assert found.title == "HI14R2N-485-000"
    (absent,) = FINDERS.scan_rs485(str(tmp_path / "none"), 0)
    assert "does not exist" in absent.problem


def on_bus(monkeypatch: pytest.MonkeyPatch, bus: InProcessI2c) -> None:
    make = partial(I2cLink, open_bus=bus.open, ioctl=bus.ioctl)
    monkeypatch.setattr(finders, "LINKS", {"i2c": SimpleNamespace(settings=I2cOptions, make_polled=make)})


def test_a_bus_is_asked_at_every_address_and_one_without_a_sensor_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, bus in [("i2c", "250"), ("i2c", "900"), ("spi", "/dev/spidev250.0")]:
        (found,) = FINDERS.ask_bus(kind, bus)
        assert found.problem
    (found,) = FINDERS.ask_bus("i2c", "256")
    assert found.problem == "bus: expected a whole number from 0 to 255, got 256"
    on_bus(monkeypatch, InProcessI2c({0x19: Imu61xRegisters(lambda: 0, product="IMU612")}))
    (found,) = FINDERS.ask_bus("i2c", "1")
    assert found.keys == {"driver": "imu61x-i2c", "i2c": {"bus": 1, "address": 0x19}}
    assert (found.node, found.title, found.device) == ("/dev/i2c-1", "IMU612", "address 0x19")
    on_bus(monkeypatch, InProcessI2c({}))
    (found,) = FINDERS.ask_bus("i2c", "1")
    assert (found.driver, "no acknowledgement at address 0x18" in found.problem) == ("", True)


NETWORK = "/etc/systemd/network/80-imud-can0.network"


@pytest.fixture
def bus(machine: LivingMachine) -> LivingMachine:
    machine.can("can0")
    machine.units["systemd-networkd.service"] = ["enabled", "active"]
    return machine


def commands(changes: object) -> list[str]:
    assert isinstance(changes, list)
    return [" ".join(one.words) for one in changes if isinstance(one, CommandChange)]


def test_only_the_consoles_of_the_port_leave_the_command_line(machine: LivingMachine) -> None:
    for before, after in [
        ("console=serial0,115200 console=tty1 root=/dev/x\n", "console=tty1 root=/dev/x\n"),
        ("root=/dev/x console=ttyAMA0\n", "root=/dev/x\n"),
        ("console=tty1 root=/dev/x console=ttyAMA1,9600\n", "console=tty1 root=/dev/x console=ttyAMA1,9600\n"),
        ("root=/dev/x  quiet", "root=/dev/x  quiet"),
    ]:
        assert finders.without_console(before, {"ttyAMA0", "serial0"}) == after
    machine.uart("ttyAMA0", console=True)
    machine.write("/boot/cmdline.txt", "console=ttyAMA0,115200 root=/dev/x\n")
    changes, notes = free_console(machine.surroundings(), "/dev/ttyAMA0")
    assert [one.path for one in changes if isinstance(one, FileChange)] == ["/boot/cmdline.txt"]
    assert "reboot the host" in notes[0]


def test_an_alias_of_another_port_keeps_its_console(machine: LivingMachine) -> None:
    machine.uart("ttyAMA0")
    machine.uart("ttyS0")
    (machine.root / "dev/serial0").symlink_to("ttyS0")
    machine.write("/boot/cmdline.txt", "console=serial0,115200 root=/dev/x\n")
    assert free_console(machine.surroundings(), "/dev/ttyAMA0") == ([], [])


def test_elsewhere_the_boot_loader_is_left_alone_and_the_login_ends(machine: LivingMachine) -> None:
    machine.uart("ttyS0", console=True)
    changes, notes = free_console(machine.surroundings(), "/dev/ttyS0")
    assert commands(changes) == ["systemctl mask --now serial-getty@ttyS0.service"]
    assert "remove `console=ttyS0` from the kernel command line" in notes[0]
    machine.units["serial-getty@ttyS0.service"] = ["masked", "inactive"]
    assert free_console(machine.surroundings(), "/dev/ttyS0")[0] == []


def test_a_can_interface_comes_up_by_networkd_and_a_virtual_one_without_a_bit_rate(bus: LivingMachine) -> None:
    changes, notes = raise_can(bus.surroundings(), "can0", 250_000)
    assert isinstance(changes[0], FileChange)
    assert (changes[0].path, changes[0].then) == (NETWORK, (("networkctl", "reload"),))
    assert b"BitRate=250000\nRestartSec=100ms\n" in changes[0].content
    assert (commands(changes), notes) == (["networkctl reconfigure can0"], [])
    bus.write(NETWORK, changes[0].content.decode())
    assert raise_can(bus.surroundings(), "can0", 250_000) == ([], [])
    bus.can("vcan0")
    (bus.root / "sys/devices/virtual/net/vcan0").mkdir(parents=True)
    changes, _ = raise_can(bus.surroundings(), "vcan0", 500_000)
    assert isinstance(changes[0], FileChange)
    assert changes[0].content == finders.network_file("vcan0", 0)
    assert b"[CAN]" not in changes[0].content


def test_networkd_is_enabled_beside_others_but_not_where_it_would_use_more(bus: LivingMachine) -> None:
    for unit, name in (("NetworkManager.service", "NetworkManager"), ("networking.service", "ifupdown")):
        bus.units = {"systemd-networkd.service": ["disabled", "inactive"], unit: ["enabled", "active"]}
        changes, notes = raise_can(bus.surroundings(), "can0", 500_000)
        assert commands(changes)[0] == "systemctl enable --now systemd-networkd.service"
        assert commands(changes)[1] == "systemctl disable systemd-networkd-wait-online.service"
        assert [one.optional for one in changes if isinstance(one, CommandChange)] == [False, True, False]
        assert notes[0].startswith(f"{name} manages the network")
    del bus.units["networking.service"]
    bus.write("/etc/systemd/network/10-eth.network", "[Match]\nName=eth*\n")
    changes, notes = raise_can(bus.surroundings(), "can0", 500_000)
    assert [type(one) for one in changes] == [FileChange]
    assert "would also use /etc/systemd/network/10-eth.network" in notes[0]


def test_without_networkd_or_interface_and_beside_another_file_nothing_is_changed(bus: LivingMachine) -> None:
    bus.write("/etc/systemd/network/can.network", "[Match]\nName=vcan* can*\n")
    changes, notes = raise_can(bus.surroundings(), "can0", 500_000)
    assert changes == []
    assert "/etc/systemd/network/can.network configures" in notes[0]
    (bus.root / "etc/systemd/network/can.network").unlink()
    notes = raise_can(bus.surroundings(), "can1", 500_000)[1]
    assert notes == ["can1 does not exist; CAN interfaces of this host: can0"]
    del bus.units["systemd-networkd.service"]
    changes, notes = raise_can(bus.surroundings(), "can0", 500_000)
    assert (changes, "not installed" in notes[0]) == ([], True)
