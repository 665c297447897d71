"""Values of a configuration that do not fit the host."""

import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from imud import config
from imud.config.host_values import CHECKS, Host, HostFinding, _file_system_of, _subsystem, findings, named_objects
from imud.config.yaml import path_text
from imud.host.certificates import certificate_validities
from imud.model.host_object import HostObject
from tests.fleet.authority import Authority
from tests.support.files import ROOT

DAY_S: Final = 86_400


class Place:
    """A folder with objects of every kind that a value can name by mistake."""

    def __init__(self, folder: Path, authority: Authority) -> None:
        self.folder = folder
        os.mkfifo(folder / "fifo")
        (folder / "dir").mkdir()
        (folder / "text").write_text("not a certificate\n")
        (folder / "empty").touch()
        (folder / "binary").write_bytes(b"\xff\xfe\n")
        (folder / "big").write_bytes(b"")
        os.truncate(folder / "big", 1 << 30)
        (folder / "loop").symlink_to(folder / "loop")
        (folder / "script").write_text("#!/bin/sh\n")
        self.listener = socket.socket(socket.AF_UNIX)
        self.listener.bind(str(folder / "socket"))
        for name in ("ca.pem", "gateway.pem", "gateway.key", "broker.key"):
            shutil.copy(authority[name], folder / name)
        damaged_pem = (folder / "ca.pem").read_text().replace("MII", "AAA", 1)
        (folder / "damaged.pem").write_text(damaged_pem)
        self.now_s = certificate_validities((folder / "ca.pem").read_bytes())[0].start.timestamp()

    def findings(self, text: str, later_s: float = 60.0, sys: Path = Path("/sys")) -> list[HostFinding]:
        """Return the findings of a configuration in which `@` is the folder."""
        parsed = config.parse(text.replace("@", str(self.folder)), "imud.yaml")
        host = Host(self.now_s + later_s, sys)
        return list(findings(parsed, host))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    authority = Authority(tmp_path_factory.mktemp("authority"))
    objects = Place(tmp_path_factory.mktemp("objects"), authority)
    yield objects
    objects.listener.close()


# Configuration with a wrong value, its key, and a part of the message. `@` is the folder of `Place`.
MQTT = "devices: {}\nmqtt: {enabled: true, %s}\n"
SIGNALK = "devices: {}\nsignalk: {enabled: true, url: 'https://localhost:3443', ca_file: '%s'}\n"
INFLUX = "devices: {}\ninflux: {enabled: true, to: {'%s': {%s}}}\n"
UART = "devices: {bow: {uart: {port: '%s'}}}\n"
LINE = "devices: {bow: {driver: hipnuc-uart, uart: {port: /dev/ttyX}, lines: {sout: {line: 1, chip: '%s'}}}}\n"
CHRONY = "devices: {bow: {driver: hipnuc-uart, uart: {port: /dev/ttyX}, lines: {pps: {line: GPIO1, chrony: '%s'}}}}\n"
RMC = "devices: {bow: {driver: hipnuc-uart, uart: {port: /dev/ttyX}, rmc: {source: nmea, port: '%s'}}}\n"
RULE = "devices: {}\nrules: {enabled: true, rules: {lean: {measure: tilt_deg, above: 10, %s}}}\n"
ERRORS: Final = (
    # certificates, keys and secrets
    (SIGNALK % "@/fifo", "signalk.ca_file", "is a FIFO, expected a regular file"),
    (SIGNALK % "@/dir", "signalk.ca_file", "Is a directory"),
    (SIGNALK % "/dev/zero", "signalk.ca_file", "is a character device"),
    (SIGNALK % "@/socket", "signalk.ca_file", "is a socket"),
    (SIGNALK % "@/text", "signalk.ca_file", "with no certificate; copy"),
    (SIGNALK % "@/empty", "signalk.ca_file", "with no certificate; copy"),
    (SIGNALK % "@/gateway.key", "signalk.ca_file", "with no certificate; copy"),
    (SIGNALK % "@/damaged.pem", "signalk.ca_file", "with no valid certificate; copy"),
    (SIGNALK % "@/big", "signalk.ca_file", "of at most 1048576 bytes"),
    (SIGNALK % "@/loop", "signalk.ca_file", "Too many levels of symbolic links"),
    (MQTT % "ca_file: '@/text'", "mqtt.ca_file", "with no certificate"),
    (MQTT % "cert_file: '@/text', key_file: '@/gateway.key'", "mqtt.cert_file", "with no certificate"),
    (MQTT % "cert_file: '@/gateway.pem', key_file: '@/broker.key'", "mqtt.cert_file", "KEY_VALUES_MISMATCH"),
    (MQTT % "cert_file: '@/gateway.pem'", "mqtt.cert_file", "the key in @/gateway.pem"),
    (MQTT % "cert_file: '@/gateway.pem', key_file: '@/ca.pem'", "mqtt.key_file", "without a key"),
    (MQTT % "cert_file: '@/gateway.pem', key_file: '@/fifo'", "mqtt.key_file", "is a FIFO"),
    (MQTT % "user: a, password_file: '@/dir'", "mqtt.password_file", "Is a directory"),
    (MQTT % "user: a, password_file: '@/fifo'", "mqtt.password_file", "is a FIFO"),
    (MQTT % "user: a, password_file: '@/empty'", "mqtt.password_file", "an empty line"),
    (INFLUX % ("http://localhost:8086/write", "token_file: '@/binary'"), "token_file", "other bytes"),
    (INFLUX % ("http://localhost:8086/write", "token_file: '@/big'"), "token_file", "of at most 4096 bytes"),
    (INFLUX % ("https://localhost:8086/write", "ca_file: '@/text'"), "ca_file", "with no certificate"),
    # files and directories
    (INFLUX % ("file://@/dir", ""), "influx.to", "which is a directory"),
    (INFLUX % ("file://@/fifo", ""), "influx.to", "which is a FIFO"),
    (INFLUX % ("file:///dev/null", ""), "influx.to", "which is a character device"),
    (INFLUX % ("file://@/text/influx.lp", ""), "influx.to", "which leads through a file"),
    (MQTT % "spool_directory: '@/text'", "mqtt.spool_directory", "which is a regular file"),
    (MQTT % "spool_directory: '@/text/spool'", "mqtt.spool_directory", "which leads through a file"),
    ("devices: {}\nstate_dir: '@/text'\n", "state_dir", "which is a regular file"),
    ("devices: {}\nstate_dir: '@/fifo'\n", "state_dir", "which is a FIFO"),
    ("devices: {}\nstate_dir: '@/loop/state'\n", "state_dir", "Too many levels of symbolic links"),
    ("devices: {}\nshm: {directory: '@/text'}\n", "shm.directory", "which is a regular file"),
    ("devices: {}\nrecorder: {enabled: true, directory: '@/socket'}\n", "recorder.directory", "which is a socket"),
    (
        "devices: {}\nrecorder: {flight: {enabled: true, directory: '@/text'}}\n", "recorder.flight.directory",
        "which is a regular file",
    ),
    ("devices: {}\nsocket: {path: '@/text'}\n", "socket.path", "which is a regular file"),
    ("devices: {}\nsocket: {path: '@/dir'}\n", "socket.path", "which is a directory"),
    (CHRONY % "@/text", "lines.pps.chrony", "which is a regular file"),
    (CHRONY % "chrony.sock", "lines.pps.chrony", "expected an absolute path"),
    # device nodes
    (UART % "/dev/null", "devices.bow.uart.port", "a device of the kind mem"),
    (UART % "@/text", "devices.bow.uart.port", "which is a regular file"),
    (UART % "@/fifo", "devices.bow.uart.port", "which is a FIFO"),
    (UART % "/dev", "devices.bow.uart.port", "which is a directory"),
    (UART % "ttyUSB0", "devices.bow.uart.port", "try /dev/ttyUSB0"),
    (UART % "./ttyAMA0", "devices.bow.uart.port", "try /dev/ttyAMA0"),
    (RMC % "/dev/null", "devices.bow.rmc.port", "a device of the kind mem"),
    ("devices: {a: {driver: hipnuc-modbus, rs485: {line: /dev/null}}}\n", "devices.a.rs485.line", "kind mem"),
    ("devices: {a: {driver: imu61x-spi, spi: {port: /dev/null}}}\n", "devices.a.spi.port", "expected an SPI port"),
    ("devices: {a: {driver: imu61x-spi, spi: {port: spidev0.0}}}\n", "devices.a.spi.port", "try /dev/spidev0.0"),
    (LINE % "/dev/null", "lines.sout.chip", "expected a GPIO chip, got /dev/null, a device of the kind mem"),
    (LINE % "null", "lines.sout.chip", "expected a GPIO chip, got /dev/null"),
    (LINE % "@/text", "lines.sout.chip", "which is a regular file"),
    (
        "devices: {}\nrecorder: {flight: {enabled: true, line: {line: 1, chip: /dev/null}}}\n",
        "recorder.flight.line.chip", "expected a GPIO chip",
    ),
    (RULE % "line: {line: 1, chip: /dev/zero}", "rules.rules.lean.line.chip", "expected a GPIO chip"),
    (
        "devices: {a: {uart: {port: /dev/ttyX}}}\nnmea0183: {enabled: true, serial_port: /dev/null}\n",
        "nmea0183.serial_port", "expected a serial port",
    ),
    # addresses and programs
    ("devices: {}\nmetrics: {address: 224.0.0.1}\n", "metrics.address", "the address of a group"),
    ("devices: {}\nmetrics: {address: 'ff02::1'}\n", "metrics.address", "the address of a group"),
    ("devices: {}\nros2: {enabled: true, address: 239.255.0.1}\n", "ros2.address", "the address of a group"),
    ("devices: {}\nnmea0183: {enabled: true, tcp_address: 255.255.255.255}\n", "nmea0183.tcp_address", "a group"),
    (RULE % "command: ['@/dir']", "rules.rules.lean.command", "which is a directory"),
    (RULE % "end_command: ['@/fifo', x]", "rules.rules.lean.end_command", "which is a FIFO"),
)  # fmt: skip

WARNINGS: Final = (
    (SIGNALK % "@/none.pem", "signalk.ca_file", "which does not exist; create it"),
    (MQTT % "user: a, password_file: '@/none'", "mqtt.password_file", "which does not exist"),
    (MQTT % "user: a, password_file: relative", "mqtt.password_file", "which does not exist"),
    (MQTT % "spool_directory: spool", "mqtt.spool_directory", "expected an absolute path, because"),
    ("devices: {}\nstate_dir: state\n", "state_dir", "expected an absolute path, because"),
    (INFLUX % ("file://@/none/influx.lp", ""), "influx.to", "in an existing directory"),
    ("devices: {}\nmetrics: {address: 192.0.2.77}\n", "metrics.address", "expected an address of this host"),
    ("devices: {}\nmetrics: {address: '2001:db8::77'}\n", "metrics.address", "expected an address of this host"),
    ("devices: {}\nnmea0183: {enabled: true, tcp_address: 192.0.2.77}\n", "nmea0183.tcp_address", "an address of"),
    ("devices: {}\nros2: {enabled: true, address: 192.0.2.77}\n", "ros2.address", "expected an address of this host"),
    ("devices: {}\nsocket: {group: no-such-group}\n", "socket.group", "create it with `groupadd --system no-such-"),
    ("devices: {}\nsocket: {control_group: 'a b'}\n", "socket.control_group", "expected a group of this host"),
    ("devices: {}\nshm: {group: no-such-group}\n", "shm.group", "expected a group of this host"),
    (RULE % "command: [/no/such/program]", "rules.rules.lean.command", "which does not exist"),
    (RULE % "command: ['@/script']", "rules.rules.lean.command", "run `chmod +x"),
)

ACCEPTED: Final = (
    SIGNALK % "@/ca.pem",
    MQTT % "ca_file: '@/ca.pem', cert_file: '@/gateway.pem', key_file: '@/gateway.key', spool_directory: '@/dir/spool'",
    MQTT % "user: a, password_file: '@/text'",
    INFLUX % ("file://@/dir/influx.lp", ""),
    INFLUX % ("udp://127.0.0.1:8089", ""),
    UART % "/dev/ttyUSB99",
    UART % "/dev/serial/by-id/usb-adapter-if00-port0",
    LINE % "gpiochip0",
    LINE % "pinctrl-bcm2711",
    CHRONY % "@/socket",
    "devices: {}\nstate_dir: '@/dir/new/state'\n",
    "devices: {}\nsocket: {path: '@/socket', group: root}\n",
    "devices: {}\nsocket: {path: '@/new.sock'}\nmetrics: {address: '::'}\n",
    "devices: {}\nmetrics: {address: 0.0.0.0}\nros2: {enabled: true, address: 127.0.0.1}\n",
    "devices: {a: {driver: hipnuc-uart, replay: {path: '@/none.cap'}}}\n",
    RULE % "command: [/bin/sh, -c, 'true']",
    # disabled outputs and devices
    "devices: {}\nmqtt: {ca_file: '@/text'}\nros2: {address: 192.0.2.77}\n",
    "devices: {}\nmetrics: {enabled: false, address: 224.0.0.1}\n",
    "devices: {a: {enabled: false, uart: {port: /dev/null}}}\n",
    "devices: {}\nrecorder: {enabled: true, directory: '@/dir', flight: {directory: '@/text'}}\n",
)


@pytest.mark.parametrize(("text", "key", "message"), ERRORS)
def test_wrong_values_are_errors(place: Place, text: str, key: str, message: str) -> None:
    errors = [finding for finding in place.findings(text) if finding.is_error]
    assert [key in path_text(finding.path) for finding in errors] == [True], errors
    assert message.replace("@", str(place.folder)) in errors[0].message
    assert errors[0].message.startswith("expected ")


@pytest.mark.parametrize(("text", "key", "message"), WARNINGS)
def test_doubtful_values_are_warnings(place: Place, text: str, key: str, message: str) -> None:
    warnings = [finding for finding in place.findings(text) if "expires" not in finding.message]
    assert [(path_text(finding.path), finding.is_error) for finding in warnings if key in path_text(finding.path)] == [
        (path_text(warnings[0].path), False)
    ]
    assert message in warnings[0].message
    assert len(warnings) == 1


@pytest.mark.parametrize("text", ACCEPTED)
def test_usable_values_have_no_findings(place: Place, text: str) -> None:
    """The certificates of the test are valid for two days: a warning about their end does not count."""
    assert [finding for finding in place.findings(text) if "expires on" not in finding.message] == []


def test_expiry_of_certificates(place: Place) -> None:
    for later_s, is_error, message in (
        (-3 * DAY_S, False, "check the clock of this host"),
        (60, False, "expires on"),
        (3 * DAY_S, True, "which expired on"),
    ):
        text = MQTT % "ca_file: '@/ca.pem', cert_file: '@/gateway.pem', key_file: '@/gateway.key'"
        certificate_findings = place.findings(text, later_s)
        assert [path_text(finding.path) for finding in certificate_findings] == ["mqtt.ca_file", "mqtt.cert_file"]
        assert {finding.is_error for finding in certificate_findings} == {is_error}
        assert all(message in finding.message for finding in certificate_findings)


def test_device_nodes_of_other_kinds(place: Place, tmp_path: Path) -> None:
    """The test replaces /sys: /dev/null then is a device of each kind."""
    device_number = os.stat("/dev/null").st_rdev
    node = tmp_path / "dev" / "char" / f"{os.major(device_number)}:{os.minor(device_number)}"
    node.mkdir(parents=True)
    for kind, accepted in (
        ("tty", UART % "/dev/null"),
        ("spidev", "devices: {a: {driver: imu61x-spi, spi: {port: /dev/null}}}\n"),
        ("gpio", LINE % "/dev/null"),
        ("a-kind-without-a-name", None),
    ):
        (node / "subsystem").unlink(missing_ok=True)
        (node / "subsystem").symlink_to(f"../../class/{kind}")
        assert _subsystem(device_number, tmp_path) == kind
        for text in (UART % "/dev/null", LINE % "/dev/null"):
            node_findings = place.findings(text, sys=tmp_path)
            assert len(node_findings) == int(text != accepted)
            assert all(finding.is_error for finding in node_findings)


def test_pseudo_terminals_are_serial_ports(place: Place) -> None:
    controller, terminal = os.openpty()
    try:
        assert place.findings(UART % os.ttyname(terminal)) == []
    finally:
        os.close(controller)
        os.close(terminal)
    if os.path.exists("/dev/tty"):
        (finding,) = place.findings(UART % "/dev/tty")
        assert "a console" in finding.message


def test_file_system_of_a_new_directory(tmp_path: Path) -> None:
    mounts = tmp_path / "mounts"
    mounts.write_text("/dev/sda1 / ext4 rw 0 0\ntmpfs /run tmpfs rw 0 0\n/dev/sdb1 /run/media ext4 rw 0 0\n")
    for path, kind in (("/run/imud/shm", "tmpfs"), ("/run/media/x", "ext4"), ("/runner/x", "ext4"), ("/var", "ext4")):
        assert _file_system_of(path, mounts) == kind
    assert _file_system_of("/run", tmp_path / "none") == ""


def test_rings_on_a_disk_are_a_warning(place: Place, tmp_path: Path) -> None:
    mounts = tmp_path / "mounts"
    mounts.write_text(f"/dev/sda1 / ext4 rw 0 0\ntmpfs {tmp_path}/memory tmpfs rw 0 0\n")
    for folder, count in (("disk", 1), ("memory", 0)):
        parsed = config.parse(f"devices: {{}}\nshm: {{directory: {tmp_path}/{folder}/imud}}\n", "imud.yaml")
        ring_findings = list(findings(parsed, Host(place.now_s, mounts=mounts)))
        assert [(path_text(finding.path), finding.is_error) for finding in ring_findings] == [
            ("shm.directory", False)
        ] * count


def test_every_kind_has_a_check_and_a_key() -> None:
    assert set(CHECKS) == set(HostObject)
    shipped_config = config.load(ROOT / "etc" / "imud.yaml")
    assert {named.kind for named in named_objects(shipped_config)} >= {HostObject.SERIAL_PORT, HostObject.DIRECTORY}
