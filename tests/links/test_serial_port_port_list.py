"""Lists of ports from simulated /dev and /sys trees."""

from pathlib import Path

import pytest

from imud.links.serial_port import SerialPort, list_ports


@pytest.fixture
def dev(tmp_path: Path) -> Path:
    for folder in ("dev/serial/by-id", "dev/serial/by-path", "sys/class/tty"):
        (tmp_path / folder).mkdir(parents=True)
    return tmp_path / "dev"


@pytest.fixture
def sys(dev: Path) -> Path:
    return dev.with_name("sys")


def native(dev: Path, sys: Path, name: str, kind: str) -> None:
    """Create a port of the 8250 or PL011 driver with its `type`."""
    (dev / name).touch()
    (sys / "class" / "tty" / name).mkdir()
    (sys / "class" / "tty" / name / "type").write_text(f"{kind}\n")


def usb(dev: Path, sys: Path, name: str, **texts: str) -> None:
    """Create a USB adapter like /sys: the tty's device is below the interface, which is below the USB device."""
    (dev / name).touch()
    device = sys / "devices" / "usb1" / f"1-{name}"
    port = device / "1.0" / name
    port.mkdir(parents=True)
    for key, text in texts.items():
        (device / key).write_text(f"{text}\n")
    (sys / "class" / "tty" / name).mkdir()
    (sys / "class" / "tty" / name / "device").symlink_to(port)


def test_an_adapter_is_listed_by_its_lasting_name(dev: Path, sys: Path) -> None:
    usb(dev, sys, "ttyUSB0", manufacturer="FTDI", product="FT232R USB UART", serial="A1")
    (dev / "serial" / "by-id" / "usb-FTDI").symlink_to("../../ttyUSB0")
    (dev / "serial" / "by-path" / "pci-0").symlink_to("../../ttyUSB0")
    expected = SerialPort(f"{dev}/serial/by-id/usb-FTDI", f"{dev}/ttyUSB0", "FTDI FT232R USB UART A1")
    assert list_ports(dev, sys) == [expected]


def test_without_by_id_the_path_and_then_the_node_is_the_name(dev: Path, sys: Path) -> None:
    usb(dev, sys, "ttyUSB0", product="adapter")
    usb(dev, sys, "ttyUSB1")
    (dev / "serial" / "by-path" / "pci-0").symlink_to("../../ttyUSB0")
    assert list_ports(dev, sys) == [
        SerialPort(f"{dev}/serial/by-path/pci-0", f"{dev}/ttyUSB0", "adapter"),
        SerialPort(f"{dev}/ttyUSB1", f"{dev}/ttyUSB1", ""),
    ]


def test_equal_adapters_without_serial_numbers_are_named_by_their_sockets(dev: Path, sys: Path) -> None:
    """Both adapters have the same by-id name, which refers to the adapter that was plugged in last."""
    for name in ("ttyUSB0", "ttyUSB1"):
        usb(dev, sys, name, product="CH340")
        (dev / "serial" / "by-path" / f"pci-{name[-1]}").symlink_to(f"../../{name}")
    (dev / "serial" / "by-id" / "usb-1a86_CH340").symlink_to("../../ttyUSB1")
    assert [port.path for port in list_ports(dev, sys)] == [f"{dev}/serial/by-path/pci-{n}" for n in (0, 1)]


def test_ports_of_one_adapter_keep_their_names(dev: Path, sys: Path) -> None:
    for number in (0, 1):
        usb(dev, sys, f"ttyUSB{number}", product="FT2232H", serial="A1")
        (dev / "serial" / "by-id" / f"usb-FT2232H-if0{number}").symlink_to(f"../../ttyUSB{number}")
        (dev / "serial" / "by-path" / f"pci-{number}").symlink_to(f"../../ttyUSB{number}")
    assert [port.path for port in list_ports(dev, sys)] == [f"{dev}/serial/by-id/usb-FT2232H-if0{n}" for n in (0, 1)]


def test_ports_without_hardware_and_other_terminals_are_left_out(dev: Path, sys: Path) -> None:
    native(dev, sys, "ttyS0", "4")
    native(dev, sys, "ttyS4", "0")
    native(dev, sys, "ttyAMA0", "32")
    for name in ("tty0", "tty63", "ttyprintk"):
        native(dev, sys, name, "4")
    assert [port.node for port in list_ports(dev, sys)] == [f"{dev}/ttyAMA0", f"{dev}/ttyS0"]
    usb(dev, sys, "ttyUSB0")
    (dev / "ttyUSB0").unlink()
    assert [port.node for port in list_ports(dev, sys)] == [f"{dev}/ttyAMA0", f"{dev}/ttyS0"]


def test_the_order_is_the_natural_one(dev: Path, sys: Path) -> None:
    for number in (10, 2, 1):
        usb(dev, sys, f"ttyUSB{number}")
    assert [port.node[-2:] for port in list_ports(dev, sys)] == ["B1", "B2", "10"]


def test_this_machine_and_one_without_ports_can_be_listed(tmp_path: Path) -> None:
    assert list_ports(tmp_path / "dev", tmp_path / "sys") == []
    assert all(Path(port.node).exists() for port in list_ports())
