"""`imud check`. The tests of the process `imud run` are in tests/test_daemon.py."""

import os
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from unittest.mock import AsyncMock, Mock, patch

import pytest

from imud import config
from imud.cli.run import state_dir
from imud.links import can_backends
from imud.model.errors import ImudError, ServerError
from tests.cli.conftest import Cli
from tests.support.files import ROOT
from tests.support.surroundings import pipe


def test_check_accepts_the_shipped_file_and_names_a_mistake_or_a_missing_file(tmp_path: Path, cli: Cli) -> None:
    shipped = ROOT / "etc" / "imud.yaml"
    assert "valid" in cli("check", shipped).out
    for size, status in ((1 << 20, 0), ((1 << 20) + 1, 2)):
        with patch("sys.stdin", Mock(buffer=BytesIO(b"devices: {}\n#".ljust(size, b"x")))):
            assert ("expected at most 1048576 bytes" in cli("check", "-", status=status).err) is (status == 2)
    bad = tmp_path / "bad.yaml"
    bad.write_text("devices:\n  bow:\n    uart:\n      port: /dev/ttyUSB0\n      baut: 9600\n")
    error = cli("check", bad, status=2).err
    assert error.startswith(f"{bad}:5:7: devices.bow.uart.baut: expected a key that imud knows")
    assert "did you mean baud?" in error
    for words, hint, status in [(["check"], "is the path right?", 2), (["run", "--config"], "--config", 78)]:
        error = cli(*words, tmp_path / "none", status=status).err
        assert error.startswith(f"cannot read {tmp_path}/none: No such file or directory; ")
        assert hint in error


@pytest.mark.live
def test_what_is_wrong_has_its_priority_in_the_journal(tmp_path: Path) -> None:
    """Otherwise `journalctl --priority=err` does not show why the service does not start."""
    bad = tmp_path / "bad.yaml"
    bad.write_text("device: {}\nlog_level: loud\n")
    with pipe() as (reader, writer):
        status = os.fstat(writer)
        journal = {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
        command = [sys.executable, "-m", "imud", "run", "--config", str(bad)]
        done = subprocess.run(command, stderr=writer, env=os.environ | journal, cwd=ROOT, timeout=60, check=False)
        lines = os.read(reader, 1 << 16).decode().splitlines()
    assert (done.returncode, len(lines)) == (78, 3)
    assert all(line.startswith(f"<2>{bad}:") for line in lines)


RMC = "devices: {a: {driver: hipnuc-uart, uart: {port: /dev/x}, rmc: {source: gpsd, host: '%s'}}}"


def test_an_invalid_address_is_named(tmp_path: Path, cli: Cli) -> None:
    file = tmp_path / "imud.yaml"
    for text, place in [
        ("metrics: {address: 127.0.0.300}", "1:20: metrics.address: expected an IP address such as 127.0.0.1 or ::1, "),
        ("metrics: {address: not an address}", "1:20: metrics.address: expected an IP address"),
        ("metrics: {address: '::1'}", ""), ("metrics: {address: localhost}", ""),
        ("metrics: {address: gateway}", "1:20: metrics.address: expected an IP address"),
        *((RMC % host, "") for host in ("10.1.2.3", "gps.local")),
        *((RMC % host, "1:84: devices.a.rmc.host: expected") for host in ("10.1.2.300", "a b", "")),
        ("socket: {path: /%s}" % ("x" * 99), "1:16: socket.path: expected at most 99 bytes, got 100"),
        ("socket: {path: /%s}" % ("x" * 98), ""),
        ("socket: {path: imud.sock}", '1:16: socket.path: expected an absolute path, got "imud.sock"'),
    ]:  # fmt: skip
        file.write_text(text + ("" if "devices" in text else "\ndevices: {}\n"))
        assert cli("check", file, status=2 if place else 0).err.startswith(f"{file}:{place}" if place else ""), text


def test_check_has_notes(tmp_path: Path, cli: Cli) -> None:
    """A misspelled name is accepted with a note, because the device may be added later."""
    there, file = tmp_path / "a.cap", tmp_path / "imud.yaml"
    there.touch()
    file.write_text(
        f"devices:\n  a: {{driver: hipnuc-uart, replay: {{path: {there}, speed: maximum}}}}\n"
        f"  b: {{driver: hipnuc-uart, replay: {{path: {there}2}}}}\n"
    )
    notes = cli("check", file).out.splitlines()[1:]
    assert notes == [f"{file}:3: note: b: {there}2 does not exist; imud waits for the file"]
    for more, count in (("", 1), (", enabled: false", 0)):
        file.write_text(f"devices: {{}}\nshm: {{directory: {tmp_path}/none/imud{more}}}\n")
        notes = [line for line in cli("check", file).out.splitlines()[1:] if "in memory" not in line]
        assert [line.endswith("; ignore this note if another user runs the daemon") for line in notes] == [True] * count
    file.write_text(
        "devices: {bow: {uart: {port: /dev/a}}, mast: {enabled: false, uart: {port: /dev/b}}}\n"
        "recorder: {devices: [bow, mast, bwo]}\nnmea0183: {device: masd}\n"
        "mqtt: {devices: {'*': {rate_hz: 1}, bow: {rate_hz: 1}, keel: {rate_hz: 1}}}\n"
    )
    notes = [line.removeprefix(f"{file}: note: ") for line in cli("check", file).out.splitlines()[1:]]
    assert notes == [
        'recorder.devices: expected a device that imud knows, got "bwo"; did you mean bow? known: bow, mast',
        'nmea0183.device: expected a device that imud knows, got "masd"; did you mean mast? known: bow, mast',
        'mqtt.devices: expected a device that imud knows, got "keel"; known: bow, mast',
    ]
    file.write_text(
        "devices:\n  bow:\n    driver: hipnuc-uart\n    uart: {port: /dev/ttyUSB0, baud: 921600}\n"
        "    settings: {output: {hi91: 50, hi92: 50}}\n  stern:\n    uart: {port: /dev/ttyUSB1}\n"
    )
    good, note = cli("check", file).out.splitlines()
    assert good == f"{file}: valid; devices: bow, stern"
    assert note.startswith(f"{file}:2: note: bow: HI92 next to HI91 is time-stamped by its arrival")


def test_check_reports_wrong_host_values(tmp_path: Path, cli: Cli) -> None:
    """A wrong value is an error with its line. A value that can become right is a note, with the exit status 0."""
    file = tmp_path / "imud.yaml"
    file.write_text("devices: {}\nmetrics: {address: 192.0.2.77}\n")
    note = cli("check", file).out.splitlines()[1]
    assert note.startswith(f"{file}:2:20: note: metrics.address: expected an address of this host, got 192.0.2.77")
    file.write_text("devices: {bow: {uart:\n  {port: /dev/null}}}\nmetrics: {address: 192.0.2.77}\n")
    error, note = cli("check", file, status=2).err.splitlines()
    assert error.startswith(f"{file}:2:10: devices.bow.uart.port: expected a serial port, got /dev/null")
    assert note.startswith(f"{file}:3:20: note: metrics.address: ")
    with patch("sys.stdin", Mock(buffer=BytesIO(b"devices: {}\nstate_dir: /dev/null\n"))):
        assert cli("check", "-", status=2).err.startswith("standard input:2:12: state_dir: expected a directory, got")


@pytest.mark.parametrize(
    ("addresses", "ports", "is_refused"),
    [
        (("127.0.0.1", "127.0.0.1"), (9321, 9321), True),
        (("0.0.0.0", "127.0.0.1"), (9321, 9321), True),
        (("127.0.0.1", "0.0.0.0"), (9321, 9321), True),
        (("127.0.0.1", "localhost"), (9321, 9321), True),
        (("::", "127.0.0.1"), (9321, 9321), True),
        (("127.0.0.1", "::"), (9321, 9321), True),
        (("::ffff:127.0.0.1", "127.0.0.1"), (9321, 9321), True),
        (("::", "::1"), (9321, 9321), True),
        (("0.0.0.0", "::1"), (9321, 9321), False),
        (("127.0.0.1", "127.0.0.2"), (9321, 9321), False),
        (("127.0.0.1", "127.0.0.1"), (9322, 9321), False),
        (("127.0.0.1", "127.0.0.1"), (0, 0), False),
        (("127.0.0.1", "127.0.0.1"), ("null", 9321), False),
    ],
)
def test_two_outputs_on_one_port(
    tmp_path: Path, cli: Cli, addresses: tuple[str, str], ports: tuple[object, int], is_refused: bool
) -> None:
    file = tmp_path / "imud.yaml"
    text = (
        f"devices: {{}}\nmetrics: {{address: '{addresses[1]}', port: {ports[1]}, enabled: %s}}\n"
        f"nmea0183: {{enabled: true, tcp_address: '{addresses[0]}', tcp_port: {ports[0]}}}\n"
    )
    file.write_text(text % "true")
    error = cli("check", file, status=2 if is_refused else 0).err
    message = "nmea0183.tcp_port: expected a TCP port that no other output uses, got 9321, the value of metrics.port"
    assert (f"{message}; try 9322" in error) is is_refused
    file.write_text(text % "false")
    assert cli("check", file).err == ""


# Values that the types of the options refuse, with a part of the key
WRONG_TYPES = (
    ("metrics: {port: 65536}", "metrics.port"), ("metrics: {port: -1}", "metrics.port"),
    ("metrics: {address: ''}", "metrics.address"), ("ros2: {address: '::1'}", "ros2.address"),
    ("ros2: {address: ''}", "ros2.address"), ("ros2: {domain_id: 233}", "ros2.domain_id"),
    ("nmea0183: {tcp_port: 70000}", "nmea0183.tcp_port"), ("nmea0183: {udp: ['127.0.0.1:0']}", "nmea0183"),
    ("nmea0183: {serial_port: ''}", "nmea0183.serial_port"), ("nmea0183: {sentences: {HDT: -1}}", "nmea0183"),
    ("signalk: {url: 'https://', ca_file: a}", "signalk.url"), ("signalk: {rate_hz: -1}", "signalk.rate_hz"),
    ("signalk: {url: 'https://a:1', ca_file: ''}", "signalk.ca_file"),
    ("influx: {to: {'http:///write?db=imud': {}}}", "influx.to"), ("influx: {to: {'udp://127.0.0.1:0': {}}}", "influx"),
    ("influx: {to: {'http://h:65536/write': {}}}", "influx.to"), ("influx: {rate_hz: 0}", "influx.rate_hz"),
    ("influx: {to: {'http://h/write': {token_file: ''}}}", "influx.to"),
    ("mqtt: {site: 'a/b'}", "mqtt.site"), ("mqtt: {site: '+'}", "mqtt.site"), ("mqtt: {gateway: '#'}", "mqtt.gateway"),
    ("mqtt: {brokers: ['mqtt://']}", "mqtt"), ("mqtt: {brokers: ['mqtt://h:0']}", "mqtt"),
    ("mqtt: {ca_file: ''}", "mqtt.ca_file"), ("mqtt: {spool_directory: ''}", "mqtt.spool_directory"),
    ("state_dir: ''", "state_dir"), ("shm: {directory: ''}", "shm.directory"), ("shm: {directory: a}", "shm.directory"),
    ("shm: {mode: 0o666}", "shm"), ("shm: {slots: 100}", "shm"), ("recorder: {directory: ''}", "recorder.directory"),
    ("recorder: {directory: /a, flight: {directory: /a/../a}}", "recorder"), ("socket: {path: /a/}", "socket.path"),
    ("socket: {path: /%s}" % ("x" * 107), "socket.path"),
)  # fmt: skip


@pytest.mark.parametrize(("text", "key"), WRONG_TYPES)
def test_values_that_no_host_accepts(tmp_path: Path, cli: Cli, text: str, key: str) -> None:
    file = tmp_path / "imud.yaml"
    file.write_text(f"devices: {{}}\n{text}\n")
    error = cli("check", file, status=2).err
    assert f": {key}" in error
    assert "expected" in error


def test_exit_statuses_and_state_directory(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "imud.yaml").write_text(f"devices: {{}}\nstate_dir: {tmp_path}\n")
    for error, status, said in [
        (ServerError("the socket is in use"), 75, "<2>the socket is in use\n"),
        (ImudError("no such thing"), 2, "imud run: no such thing\n"),
        (ValueError("a bug"), 1, "<2>imud stops because of an internal error"), (None, 0, ""),
    ]:  # fmt: skip
        serve = AsyncMock(side_effect=error)
        with pipe() as (reader, writer), monkeypatch.context() as patch:
            patch.setattr("imud.cli.run.serve", serve)
            patch.setattr("imud.cli.run.STDERR", writer)
            patch.setenv("JOURNAL_STREAM", f"{os.fstat(writer).st_dev}:{os.fstat(writer).st_ino}")
            printed = cli("run", "--config", tmp_path / "imud.yaml", status=status).err
            os.write(writer, b"\n")
            logged = os.read(reader, 65536).decode()
        assert said in printed + logged
        settings, file, _ = serve.call_args.args
        assert (settings.state_dir, file) == (str(tmp_path), tmp_path / "imud.yaml")
    settings = config.parse("state_dir: /srv/imud\ndevices: {}\n", "imud.yaml")
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert state_dir(settings) == Path("/srv/imud")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/imud:/var/lib/other")
    assert state_dir(settings) == Path("/var/lib/imud")


CAN = "devices: {a: {driver: hipnuc-canopen, socketcan: {interface: '%s', backend: %s}}}\n"


@pytest.mark.parametrize(
    ("interface", "backend", "problem"),
    [
        ("0", "socketcand", "backend: expected a backend of python-can (canalystii, "),
        ("0", "vector", "got vector, which needs Windows"),
        ("0", "slcn", "did you mean slcan?"),
        ("a/b", "socketcan", "interface: expected the name of a network interface, at most 15 bytes"),
        ("x" * 40, "socketcan", "interface: expected the name of a network interface, at most 15 bytes"),
        ("lo", "socketcan", "interface: expected a CAN interface, got lo"),
        ("/dev/ttyACM0", "slcan", ""),
        ("can0", "socketcan", ""),
    ],
)
def test_check_of_can_keys(tmp_path: Path, cli: Cli, interface: str, backend: str, problem: str) -> None:
    file = tmp_path / "imud.yaml"
    file.write_text(CAN % (interface, backend))
    result = cli("check", file, status=2 if problem else 0)
    assert problem in result.err
    assert (f"devices.a.socketcan.{'interface' if 'interface' in problem else 'backend'}" in result.err) is bool(
        problem
    )
    assert "note" not in result.out


@pytest.mark.parametrize(
    ("interface", "problem", "note"),
    [
        ("lo", "interface: expected a CAN interface, got lo", ""),
        ("a b", "interface: expected the name of a network interface", ""),
        ("x" * 16, "interface: expected the name of a network interface", ""),
        ("nosuch", "", "nmea2000.interface: nosuch does not exist: expected a CAN interface"),
    ],
)
def test_check_of_nmea2000_interface(tmp_path: Path, cli: Cli, interface: str, problem: str, note: str) -> None:
    file = tmp_path / "imud.yaml"
    file.write_text(f"nmea2000: {{enabled: true, interface: '{interface}'}}\n" + CAN % ("can0", "socketcan"))
    result = cli("check", file, status=2 if problem else 0)
    assert problem in result.err
    assert note in result.out
    file.write_text("nmea2000: {enabled: false, interface: nosuch}\n" + CAN % ("can0", "socketcan"))
    assert "nosuch" not in cli("check", file).out


def test_check_notes_missing_library_of_backend(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "imud.yaml"
    for backend, library in (("kvaser", "libcanlib"), ("canalystii", "Python module canalystii")):
        file.write_text(CAN % ("0", backend))
        for is_installed in (False, True):
            monkeypatch.setattr(can_backends, "find_library", lambda _name, is_present=is_installed: is_present or None)
            monkeypatch.setattr(can_backends, "find_spec", lambda _name, is_present=is_installed: is_present or None)
            assert (library in cli("check", file).out) is not is_installed
