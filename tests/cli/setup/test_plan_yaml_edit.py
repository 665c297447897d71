"""Adding devices to a configuration keeps the existing text and produces a valid file."""

import pytest

from imud import config
from imud.cli.setup.plan import device_names, is_example, with_devices
from imud.config.yaml import read_yaml
from imud.model.errors import ImudError
from tests.support.files import ROOT

NEW = {"imu": {"driver": "auto", "uart": {"port": "/dev/serial/by-id/usb-A"}}}
BLOCK = "  imu:\n    driver: auto\n    uart:\n      port: /dev/serial/by-id/usb-A\n"
EXAMPLE = (ROOT / "etc/imud.yaml").read_bytes()


def test_without_a_file_one_is_made_and_disabled_devices_have_names() -> None:
    text = with_devices(None, NEW).decode()
    assert text.endswith("devices:\n" + BLOCK)
    assert [one.name for one in config.parse(text, "new").devices] == ["imu"]
    assert device_names(b"devices:\n  bow: {enabled: false, uart: {port: /dev/ttyS0}}\n") == ["bow"]
    assert device_names(None) == []


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
        made = with_devices(before.encode(), NEW).decode()
        assert after is None or made == after
        assert made.count("\r\n") in (0, made.count("\n"))
        old, new = read_yaml(before.encode()).data, read_yaml(made.encode()).data
        assert isinstance(old, dict)
        assert new == {**old, "devices": {**(old.get("devices") or {}), **NEW}}
    for before in ["devices: {bow: {uart: {port: /dev/ttyS0}}}\n", "{devices: {}}\n", "- a\n"]:
        with pytest.raises(ImudError, match="cannot add the devices") as refused:
            with_devices(before.encode(), NEW)
        assert BLOCK.rstrip() in str(refused.value)


def test_the_example_of_the_package_is_known_and_only_its_device_is_replaced() -> None:
    assert is_example(EXAMPLE)
    assert not is_example(EXAMPLE + b"  bow: {uart: {port: /dev/ttyS9}}\n")
    made = with_devices(EXAMPLE, {"mast": {"driver": "imu61x-can", "socketcan": {"interface": "can0"}}}, replace="imu")
    assert device_names(made) == ["mast"]
    kept = made.decode().splitlines()
    lost = [line for line in EXAMPLE.decode().splitlines() if line not in kept]
    assert lost[0] == "  imu:"
    assert len(lost) == 8  # key, link and port of the example, and the comments between them
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
        made = with_devices(None, {"imu": {"uart": {"port": text}}}).decode()
        assert f"port: {written}\n" in made
        assert read_yaml(made.encode()).data == {"devices": {"imu": {"uart": {"port": text}}}}
