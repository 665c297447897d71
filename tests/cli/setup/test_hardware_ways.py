"""Changes of consoles on UARTs and of CAN interfaces on simulated hosts."""

import pytest

from imud.cli.setup.changes import CommandChange, FileChange
from imud.cli.setup.hardware import free_console, network_file, raise_can, without_console
from tests.cli.setup.conftest import LivingMachine

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
        assert without_console(before, {"ttyAMA0", "serial0"}) == after
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


def test_a_can_interface_comes_up_by_networkd(bus: LivingMachine) -> None:
    changes, notes = raise_can(bus.surroundings(), "can0", 250_000)
    assert isinstance(changes[0], FileChange)
    assert (changes[0].path, changes[0].then) == (NETWORK, (("networkctl", "reload"),))
    assert b"BitRate=250000\nRestartSec=100ms\n" in changes[0].content
    assert commands(changes) == ["networkctl reconfigure can0"]
    assert notes == []
    bus.write(NETWORK, changes[0].content.decode())
    assert raise_can(bus.surroundings(), "can0", 250_000) == ([], [])


@pytest.mark.parametrize(
    ("unit", "name"), [("NetworkManager.service", "NetworkManager"), ("networking.service", "ifupdown")]
)
def test_networkd_is_enabled_beside_others_and_that_is_said(bus: LivingMachine, unit: str, name: str) -> None:
    bus.units |= {"systemd-networkd.service": ["disabled", "inactive"], unit: ["enabled", "active"]}
    changes, notes = raise_can(bus.surroundings(), "can0", 500_000)
    assert commands(changes)[0] == "systemctl enable --now systemd-networkd.service"
    assert commands(changes)[1] == "systemctl disable systemd-networkd-wait-online.service"
    assert [one.optional for one in changes if isinstance(one, CommandChange)] == [False, True, False]
    assert notes[0].startswith(f"{name} manages the network")


def test_networkd_is_not_enabled_where_it_would_use_more(bus: LivingMachine) -> None:
    bus.units["systemd-networkd.service"] = ["disabled", "inactive"]
    bus.write("/etc/systemd/network/10-eth.network", "[Match]\nName=eth*\n")
    changes, notes = raise_can(bus.surroundings(), "can0", 500_000)
    assert [type(one) for one in changes] == [FileChange]
    assert "would also use /etc/systemd/network/10-eth.network" in notes[0]


def test_a_file_of_the_administrator_is_left(bus: LivingMachine) -> None:
    bus.write("/etc/systemd/network/can.network", "[Match]\nName=vcan* can*\n")
    changes, notes = raise_can(bus.surroundings(), "can0", 500_000)
    assert changes == []
    assert "/etc/systemd/network/can.network configures" in notes[0]


def test_without_networkd_or_interface_nothing_is_changed(bus: LivingMachine) -> None:
    assert raise_can(bus.surroundings(), "can1", 500_000)[1] == [
        "can1 does not exist; CAN interfaces of this host: can0"
    ]
    del bus.units["systemd-networkd.service"]
    changes, notes = raise_can(bus.surroundings(), "can0", 500_000)
    assert (changes, "not installed" in notes[0]) == ([], True)


def test_a_virtual_interface_has_no_bit_rate(bus: LivingMachine) -> None:
    bus.can("vcan0")
    (bus.root / "sys/devices/virtual/net/vcan0").mkdir(parents=True)
    changes, _ = raise_can(bus.surroundings(), "vcan0", 500_000)
    assert isinstance(changes[0], FileChange)
    assert changes[0].content == network_file("vcan0", 0)
    assert b"[CAN]" not in changes[0].content
