"""Conflicts between the devices of one file: each error has its place. The test uses the real registries."""

# ruff: noqa: E501 - a row of the table is a whole device and the whole message for it

import re
from pathlib import Path
from typing import Any

import pytest

from imud import config
from imud.config.model import Config, differences
from imud.config.reading import owner_of
from imud.config.schema import Tables
from imud.contracts.setting import OnDifference, declared_values
from imud.links import LINKS
from imud.model.errors import ConfigError
from tests.config.test_reading import PortSettings, fake_row
from tests.support.fake_drivers import FAKE_DRIVER, FAKE_MODULE_DRIVER

RAW = bytes(range(200))


def problems(*devices: str) -> list[str]:
    """Return the error lines of a file with these devices, without file name and column; empty for a valid file."""
    text = "devices:\n" + "".join(f"  {name}: {keys}\n" for name, _, keys in (one.partition(" ") for one in devices))
    try:
        config.parse(text, "f")
    except ConfigError as error:
        return [re.sub(r"^f:(\d+):\d+:", r"\1:", line) for line in str(error).splitlines()]
    return []


MODBUS = "{{driver: hipnuc-modbus, rs485: {{line: {}, address: {}, baud: {}}}}}"
CANOPEN = "{{driver: hipnuc-canopen, options: {{{}}}, socketcan: {{interface: {}}}}}"


@pytest.mark.parametrize(
    ("devices", "expected"),
    [
        (["a {uart: {port: /dev/x}}", "b {uart: {port: /dev/x}}"],
         "3: devices.b.uart.port: expected an unused port, got /dev/x; a (line 2) uses it"),
        (["a {uart: {port: /dev/x}}", "b " + MODBUS.format("/dev/x", 80, 9600)],
         "3: devices.b.rs485.line: expected an unused line, got /dev/x; a (line 2) uses it"),
        (["a " + MODBUS.format("/dev/x", 80, 9600), "b " + MODBUS.format("/dev/x", 80, 9600)],
         "3: devices.b.rs485.address: expected an unused address on /dev/x, got 80; a (line 2) uses it"),
        (["a " + MODBUS.format("/dev/x", 80, 9600), "b " + MODBUS.format("/dev/x", 81, 115200)],
         "3: devices.b.rs485.baud: expected the same baud for all devices of /dev/x, got 115200; a (line 2) has 9600"),
        (["a {driver: imu61x-i2c, i2c: {address: 0x18}}", "b {driver: imu61x-i2c, i2c: {address: 24}}"],
         "3: devices.b.i2c.address: expected an unused address on /dev/i2c-1, got 24; a (line 2) uses it"),
        (["a {spi: {port: /dev/spidev0.0}}", "b {spi: {port: /dev/../dev/spidev0.0}}"],
         "3: devices.b.spi.port: expected an unused port, got /dev/../dev/spidev0.0; a (line 2) uses it"),
        (["a " + CANOPEN.format("node: 8", "can0"), "b " + CANOPEN.format("", "can0")],
         "3: devices.b.options: expected no device on can0 with the frame 0x188 of a (line 2), got this device"),
        (
            ["a " + CANOPEN.format("node: 8, sync_hz: 100", "can0"), "b " + CANOPEN.format("node: 9, sync_hz: 50", "can0")],
            "3: devices.b.options: expected one device on can0 for which imud sends 0x080, got this device "
            "and a (line 2); remove the key here",
        ),
        (
            ["a {driver: hipnuc-nmea2000, socketcan: {interface: can0}}",
             "b {driver: hipnuc-nmea2000, options: {source: 35}, socketcan: {interface: can0}}"],
            "3: devices.b.options: expected no device on can0 with the frame 0x01F11223 of a (line 2), got this device",
        ),
        (
            ["a {driver: imu61x-can, options: {base_id: 0x101}, socketcan: {interface: can0}}",
             "b {driver: imu61x-can, options: {base_id: 0x105}, socketcan: {interface: can0}}"],
            "3: devices.b.options: expected no device on can0 with the frame 0x105 of a (line 2), got this device",
        ),
        (
            ["a {driver: imu61x-can, socketcan: {interface: c, backend: virtual}}",
             "b {driver: hipnuc-canopen, socketcan: {interface: c, backend: virtual, bitrate: 500000}}"],
            "3: devices.b.socketcan.bitrate: expected the same bitrate for all devices of c (virtual), got 500000; "
            "a (line 2) has 0",
        ),
        (["a {driver: imu61x-can, socketcan: {interface: /dev/ttyACM0, backend: slcan}}", "b {uart: {port: /dev/ttyACM0}}"],
         "3: devices.b.uart.port: expected an unused port, got /dev/ttyACM0; a (line 2) uses it"),
        (["a {driver: hipnuc-uart, uart: {port: /dev/x}, rmc: {source: nmea, port: /dev/x}}"],
         "2: devices.a.rmc.port: expected an unused port, got /dev/x; a (line 2) uses it"),
    ],
)  # fmt: skip
def test_what_two_devices_cannot_have_together(devices: list[str], expected: str) -> None:
    assert problems(*devices) == [expected]


@pytest.mark.parametrize(
    "devices",
    [
        ["a {uart: {port: /dev/x}}", "b {enabled: false, uart: {port: /dev/x}}"],
        ["a " + MODBUS.format("/dev/x", 80, 9600), "b " + MODBUS.format("/dev/x", 81, 9600)],
        ["a " + MODBUS.format("/dev/x", "auto", 9600), "b " + MODBUS.format("/dev/x", "auto", 9600)],
        ["a " + CANOPEN.format("node: 8", "can0"), "b " + CANOPEN.format("node: 8", "can1")],
        ["a " + CANOPEN.format("node: 8", "can0"), "b " + CANOPEN.format("node: 9", "can0")],
        ["a " + CANOPEN.format("", "can0"), "b {driver: imu61x-can, socketcan: {interface: can0}}"],
        ["a {driver: hipnuc-j1939, socketcan: {interface: c}}", "b {driver: hipnuc-nmea2000, socketcan: {interface: c}}"],
        ["a {socketcan: {interface: can0}}", "b {socketcan: {interface: can0}}"],
        ["a {spi: {port: /dev/spidev0.0}}", "b {spi: {port: /dev/spidev0.1, speed_hz: 200000}}"],
        ["a {i2c: {bus: 1}}", "b {i2c: {bus: 1}}"], ["a {memory: {}}", "b {memory: {}}"],
    ],
)  # fmt: skip
def test_what_they_can_have_together(devices: list[str]) -> None:
    assert problems(*devices) == []


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("{replay: {path: PATH}}", "PATH is a raw capture without times: use speed real with the key baud, or speed maximum"),
        ("{replay: {path: PATH, speed: real}}", "PATH does not contain its baud rate: speed real needs the key baud"),
        ("{replay: {path: PATH, speed: real, baud: 9600}}", ""), ("{replay: {path: PATH, speed: maximum}}", ""),
        ("{replay: {path: PATH.none}}", ""),
        ("{driver: imu61x-can, replay: {path: PATH}}", "PATH is not a CAN log: expected frames"),
        ("{driver: imu61x-can, replay: {path: PATH.log}}", ""),
    ],
)  # fmt: skip
def test_a_capture_must_have_what_its_replay_needs(device: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "raw"
    path.write_bytes(RAW)
    (tmp_path / "raw.log").write_text("(1.000000) can0 101#0011223344556677\n")
    found = problems("a " + device.replace("PATH", str(path)))
    assert len(found) == bool(message)
    assert not found or message.replace("PATH", str(path)) in found[0]


def test_a_full_bus_and_a_full_line_are_compared() -> None:
    nodes = [f"n{n} " + CANOPEN.format(f"node: {n}", "can0") for n in range(1, 128)]
    slaves = [f"s{n} " + MODBUS.format("/dev/x", n, 9600) for n in range(1, 130)]
    assert problems(*nodes, *slaves) == []
    assert len(problems(*nodes, *slaves[:-1], "last " + MODBUS.format("/dev/x", 1, 9600))) == 1


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize("link", [True, False])
@pytest.mark.parametrize(
    ("device", "line"),
    [
        ("{{uart: {{port: {}}}}}", 3), ("{{driver: hipnuc-modbus, rs485: {{line: {}, address: 80, baud: 9600}}}}", 3),
        ("{{driver: hipnuc-uart, rmc: {{source: nmea, port: {}}}, uart: {{port: /dev/x}}}}", 3),
    ],
)  # fmt: skip
def test_an_output_cannot_use_the_port_of_a_device(
    tmp_path: Path, device: str, line: int, link: bool, enabled: bool
) -> None:
    port, other = tmp_path / "port", tmp_path / "other"
    other.symlink_to(port)
    text = (
        f"nmea0183: {{enabled: {str(enabled).lower()}, sentences: {{XDR: 1}}, serial_port: {other if link else port}}}\n"
        f"devices:\n  a: {device.format(port)}\n"
    )
    if not enabled:
        config.parse(text, "f")
        return
    with pytest.raises(
        ConfigError, match=rf"f:1:\d+: nmea0183.serial_port: expected an unused .*; a \(line {line}\) uses"
    ):
        config.parse(text, "f")


@pytest.mark.parametrize("driver", ["hipnuc-j1939", "hipnuc-nmea2000"])
def test_nmea2000_does_not_share_the_interface_of_a_device_by_default(driver: str) -> None:
    text = "nmea2000: {{enabled: {}, interface: {}, share_interface: {}}}\ndevices:\n  a: {{driver: {}, socketcan: {{interface: can0}}}}\n"
    for enabled, interface, shared in (("true", "can1", "false"), ("true", "can0", "true"), ("false", "can0", "false")):
        config.parse(text.format(enabled, interface, shared, driver), "f")
    with pytest.raises(ConfigError) as caught:
        config.parse(text.format("true", "can0", "false", driver), "f")
    assert str(caught.value) == (
        "f:1:38: nmea2000.interface: expected an unused interface, got can0; a (line 3) uses it; use another interface, "
        "or set nmea2000.share_interface if all devices of this bus are on NMEA 2000"
    )


def test_two_names_of_one_port_are_one_port(tmp_path: Path) -> None:
    port, late = tmp_path / "port", tmp_path / "late"
    late.touch()
    first, second = config.parse(
        f"devices:\n  a: {{uart: {{port: {port}}}}}\n  b: {{uart: {{port: {late}}}}}\n", "f"
    ).devices
    assert owner_of(second, [first, second], LINKS) == ""
    late.unlink()
    late.symlink_to("port")  # udev creates this link when the adapter is plugged in
    assert owner_of(second, [first, second], LINKS) == "a"
    (found,) = problems(f"a {{uart: {{port: {port}}}}}", f"b {{uart: {{port: {late}}}}}")
    assert f"expected an unused port, got {late}; a (line 2) uses it" in found


TABLES = Tables({"fake-module": FAKE_MODULE_DRIVER, "fake-uart": FAKE_DRIVER}, {"wire": fake_row(PortSettings)}, {})
HEAD = "devices:\n  bow:\n    driver: {driver}\n    wire: {{port: x, baud: {baud}}}\n"


def parse(*lines: str, driver: str = "fake-module", baud: str = "115200") -> Config:
    text = HEAD.format(driver=driver, baud=baud) + "".join(f"    {line}\n" for line in lines)
    return config.parse(text, "f", TABLES)


def test_declared_values_and_their_changes() -> None:
    (device,) = parse(
        "settings: {mode: 9-axis, output: {a: 10}, offset_deg: 5}", "on_difference: apply_and_save"
    ).devices
    assert declared_values(device.declared) == {"mode": "9-axis", "output": {"a": 10}, "offset_deg": 5.0}
    assert device.on_difference is OnDifference.APPLY_AND_SAVE
    for values, baud in (("baud: 921600", "auto"), ("baud: 115200", "115200"), ("output: {a: 1000, b: 500}", "auto")):
        assert parse(f"settings: {{{values}}}", baud=baud).devices[0].declared is not None
    for lines in ([], ["settings:"], ["settings: {}"], ["settings: {mode: null}"]):
        (device,) = parse(*lines).devices
        assert (declared_values(device.declared), device.on_difference) == ({}, OnDifference.REPORT)
    old = parse("settings: {mode: 9-axis}")
    assert differences(old, parse("settings: {mode: 6-axis}")).devices_changed == ("bow",)
    assert differences(old, parse("settings: {mode: 9-axis}", "on_difference: apply")).devices_changed == ("bow",)
    assert str(differences(old, parse("settings: {mode: 9-axis}"))) == "nothing differs"


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ({"lines": ["settings: {mod: 9-axis}"]}, '5:16: devices.bow.settings.mod: expected a key that imud knows, got "mod"; did you mean mode? known: baud, mode, mounting, offset_deg, output, secret'),
        ({"lines": ["settings: {hours: 3}"]}, '5:16: devices.bow.settings.hours: expected a key that imud knows, got "hours"; known: baud, mode, mounting, offset_deg, output, secret'),
        ({"lines": ["settings: {offset_deg: 181}"]}, "5:28: devices.bow.settings.offset_deg: expected a number from -180 to 180, or null, got 181"),
        ({"lines": ["settings: 5"]}, "5:15: devices.bow.settings: expected keys and values, got 5"),
        ({"lines": ["settings: {mode: 9-axis}"], "driver": "auto"}, "5:5: devices.bow.settings: expected the name of a driver next to settings, got auto; drivers with settings: fake-module"),
        ({"lines": ["settings: {mode: 9-axis}"], "driver": "fake-uart"}, "5:5: devices.bow.settings: expected a driver with a table of settings, got fake-uart; drivers with settings: fake-module"),
        ({"lines": ["settings: {mode: 9-axis}", "identify: false"]}, "5:5: devices.bow.settings: expected identify: true, because imud reads the settings only then, got false"),
        ({"lines": ["settings: {output: {a: 1000, b: 500}}"]}, "5:15: devices.bow.settings: output: expected at most 1152 Hz in all at 115200 baud, got 1500 Hz"),
        ({"lines": ["settings: {baud: 921600}"]}, "5:22: devices.bow.settings.baud: expected 115200, the value that imud uses to open the device, got 921600; change it with `imud settings bow --set baud=… --save`, or use auto if the link supports it"),
        ({"lines": ["on_difference: repair"]}, '5:20: devices.bow.on_difference: expected one of "report", "apply", "apply_and_save", got "repair"'),
    ],
)  # fmt: skip
def test_errors_with_their_place(given: dict[str, Any], error: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(*given.pop("lines"), **given)
    assert str(caught.value).splitlines() == ["f:" + error]
