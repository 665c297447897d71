"""`imud modbus` with a simulated RS-485 bus in virtual time, and with a real port."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from imud.contracts.driver import Identity
from imud.contracts.script import Transfer, says_nothing
from imud.formats.modbus import BROADCAST, ReplyFinder, framed
from imud.links.rs485 import LineCounters, Rs485Options
from imud.model.errors import DeviceRefused, TransferError, Trouble
from imud.model.units import NS_PER_MS, uart_byte_ns
from imud.sim.hipnuc.modbus import Slave
from tests.cli.conftest import Cli
from tests.support.pty_port import LINE_BAUD, ModbusBench, modbus_slave, serial_of, slave, wait_for_reply, wired

REPLY_MS = 30
ON = ("--baud", LINE_BAUD, "--reply-ms", REPLY_MS)


class Bus(ModbusBench):
    def __init__(self, *slaves: Slave) -> None:
        super().__init__(*slaves)
        self.heard = LineCounters()
        self.reply_ms = 0
        self.is_open = False
        self.paused_s: list[float] = []

    def opened(self, settings: Rs485Options) -> "Bus":
        assert isinstance(settings.baud, int)
        assert settings.line == "/dev/ttyUSB0"
        self.baud, self.reply_ms = settings.baud, settings.reply_ms
        return self

    def open(self) -> None:
        assert not self.is_open
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def select(self, target: int) -> None:
        self.at = target

    def _ask(self, address: int, transfer: Transfer) -> bytes:
        assert self.is_open
        (request,) = transfer.sends
        frame = framed(address, request)
        self.sent.append((address, request))
        self.line.receive(frame, self.now_ns)
        finder = ReplyFinder(frame, transfer.read_bytes, echoes=False)
        wire_ns = (len(frame) + transfer.read_bytes) * uart_byte_ns(self.baud)
        end_ns = self.now_ns + wire_ns + max(self.reply_ms, transfer.reply_ms) * NS_PER_MS
        reply, self.now_ns = wait_for_reply(self.line, finder, self.baud, self.now_ns, end_ns)
        if reply is not None:
            return reply
        if address == BROADCAST:
            return b""
        self.heard.strange += finder.strange + len(finder.rest())
        if finder.looks_damaged:
            return finder.rest()
        raise TransferError(Trouble.DISTURBED, f"no reply from address {address}")

    def slaves(self) -> list[int]:
        return [one.settings.slave for one in self.line.slaves]


class Commands:
    def __init__(self, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
        self._cli, self._monkeypatch = cli, monkeypatch
        self.bus = Bus()

    def __call__(self, *words: object, status: int = 0) -> str:
        self._monkeypatch.setattr("imud.cli.modbus.Rs485Link", self.bus.opened)
        self._monkeypatch.setattr("imud.cli.modbus.sleep", self.bus.paused_s.append)
        printed = self._cli("modbus", words[0], "/dev/ttyUSB0", *words[1:], status=status)
        assert not self.bus.is_open
        return printed.err if status == 2 else printed.out

    def scan(self, addresses: str, *words: object, status: int = 0) -> list[dict[str, Any]]:
        lines = self("scan", "--addresses", addresses, "--json", *(words or ON), status=status)
        return [json.loads(line) for line in lines.splitlines()]


@pytest.fixture
def modbus(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> Commands:
    return Commands(cli, monkeypatch)


def serial(number: int) -> str:
    return serial_of(number).hex().upper()


def test_scan_lists_the_modules_in_the_order_of_their_addresses(modbus: Commands) -> None:
    modbus.bus = Bus(modbus_slave(80), modbus_slave(2), modbus_slave(7, firmware=152), modbus_slave(5, dead=True))
    found = modbus.scan("2-80")
    assert [(one["address"], one["firmware"]) for one in found] == [(2, "1.6.9"), (7, "1.5.2"), (80, "1.6.9")]
    assert found[0] == {
        "baud": LINE_BAUD, "address": 2, "product": "HI14R2N-485-000", "serial_number": serial(2), "firmware": "1.6.9",
    }  # fmt: skip
    assert modbus.bus.sent[0][0] == 80, "the address of the factory comes first"
    assert modbus.bus.reply_ms == REPLY_MS
    lines = modbus("scan", *ON, "--addresses", "7").splitlines()
    assert lines[0].split() == ["BAUD", "ADDRESS", "PRODUCT", "SERIAL", "NUMBER", "FIRMWARE"]
    assert lines[1].split() == [str(LINE_BAUD), "7", "HI14R2N-485-000", serial(7), "1.5.2"]
    assert "no device replies" in modbus("scan", *ON, "--addresses", "8", status=1)


def test_scan_asks_again_for_a_missing_reply_and_at_every_rate(modbus: Commands) -> None:
    """One reply is lost, one is damaged, and one is lost twice on a bus with other devices."""
    modbus.bus = Bus(modbus_slave(1), modbus_slave(2, mute=1), modbus_slave(3, bad_crc=1), modbus_slave(4, mute=2))
    assert [(one["address"], one.get("problem", "")) for one in modbus.scan("1-5")] == [(n, "") for n in (1, 2, 3, 4)]
    assert [address for address, _ in modbus.bus.sent].count(5) == 3
    modbus.bus = Bus(modbus_slave(2, mute=1))
    assert [one["address"] for one in modbus.scan("2")] == [2], "the only module of a bus"
    modbus.bus = Bus(modbus_slave(2, mute=2))
    assert modbus.scan("2", status=1) == [], "the third request needs a module that replied"
    modbus.bus = Bus(slave(3, baud=19200))
    found = modbus.scan("3", "--baud", "all")
    assert [(one["baud"], one["address"]) for one in found if "problem" not in one] == [(19200, 3)]


@pytest.mark.manual("B 4.6 address by serial number")
def test_two_modules_with_one_address_get_different_addresses(modbus: Commands) -> None:
    modbus.bus = Bus(modbus_slave(80, serial=0x0F), modbus_slave(80, serial=0xF0))
    (found,) = modbus.scan("80", status=1)
    assert "two devices have this address" in found["problem"]
    assert serial(0xF0) in modbus("assign", *ON, "--serial", serial(0xF0).lower(), "--id", "6")
    assert modbus.bus.paused_s == [0.3], "the modules need time to use the address"
    assert modbus.bus.slaves() == [one.flash.slave for one in modbus.bus.line.slaves] == [80, 6]
    assert len(modbus.scan("80")) == 1


@pytest.mark.manual("B 4.6 random addresses")
def test_random_addresses(modbus: Commands) -> None:
    modbus.bus = Bus(*(modbus_slave(80, serial=number) for number in (1, 2, 3)))
    out = modbus("assign", *ON, "--random", "1-9")  # the seed gives three different addresses
    assert all(serial(number) in out for number in (1, 2, 3))
    kept = {one.flash.slave for one in modbus.bus.line.slaves}
    assert len(kept) == 3
    assert kept <= set(range(1, 10))
    modbus.bus = Bus(modbus_slave(80, serial=1), modbus_slave(80, serial=2, bad_crc=99))
    out = modbus("assign", *ON, "--random", "1-9", status=1)
    assert [one.flash.slave == one.settings.slave for one in modbus.bus.line.slaves] == [True, False], out


def test_an_address_is_changed_and_saved_unless_not_wanted(modbus: Commands) -> None:
    modbus.bus = Bus(modbus_slave(1, mute=2), modbus_slave(2))  # two lost replies
    modbus("assign", *ON, "--from", "1", "--id", "9", "--no-save")
    assert (modbus.bus.slaves(), modbus.bus.line.slaves[0].flash.slave) == ([9, 2], 1)
    modbus("assign", *ON, "--from", "2", "--id", "3")
    assert modbus.bus.line.slaves[1].flash.slave == 3


def test_a_refused_assignment_changes_nothing(modbus: Commands) -> None:
    for words, why in [
        (("--from", "1", "--id", "2"), "address 2 is used by HI14R2N-485-000"),
        (("--from", "5", "--id", "6"), "no device replies at address 5"),
        (("--from", "1", "--id", "200"), "1 … 128"), (("--from", "0", "--id", "9"), "1 … 247"),
        (("--from", "1"), "--id: expected the new address"),
        (("--random", "1-9", "--id", "1"), "--id: expected the new address"),
        (("--random", "9"), "lowest below the highest"),
        (("--serial", serial(9), "--id", "9"), "no device replies at the new address 9"),
        (("--serial", serial(9), "--id", "2"), "address 2 is used"),
        (("--serial", "12", "--id", "9"), "16 hexadecimal digits"),
        (("--from", "1", "--id", "9", "--reply-ms", "0"), "--reply-ms: expected 1 to 1000, got 0"),
        (("--from", "1", "--id", "9", "--reply-ms", "1001"), "--reply-ms: expected 1 to 1000, got 1001"),
        (("--from", "1", "--id", "9", "--baud", "12345"), "--baud: expected one of"),
    ]:  # fmt: skip
        modbus.bus = Bus(modbus_slave(1), modbus_slave(2))
        assert why in modbus("assign", *ON, *words, status=2), words
        assert modbus.bus.slaves() == [1, 2]
    asleep = modbus_slave(2, mute=4)  # three requests that check the new address, then the broadcast
    modbus.bus = Bus(asleep)
    said = modbus("assign", *ON, "--serial", serial(9), "--id", "2", status=2)
    assert f"expected serial number {serial(9)} at address 2" in said
    assert asleep.flash == asleep.settings, "another device at the new address is not the wanted device"


def test_invalid_addresses_and_identities(cli: Cli, modbus: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("0-5", "5-1", "1-248", "x", "1-x", ""):
        cli.refuses("expected", "modbus", "scan", "/dev/null", "--addresses", text)
    said = Identity("HI\x1b[2J14\n", "\x9b1A", "1.6.9")
    monkeypatch.setattr("imud.cli.modbus.probe", lambda _settings: says_nothing(said))
    modbus.bus = Bus(modbus_slave(2))
    (found,) = modbus.scan("2")
    assert (found["product"], found["serial_number"]) == ("HI\\x1b[2J14\\n", "\\x9b1A")
    monkeypatch.setattr("imud.cli.modbus.probe", Mock(side_effect=DeviceRefused("exception 4")))
    problem = "address 2: exception 4; do two devices have this address?"
    assert problem in modbus("assign", *ON, "--from", "2", "--id", "9", status=2)


@pytest.mark.live
def test_a_real_port(tmp_path: Path, cli: Cli) -> None:
    with wired(tmp_path, slave(2)) as (path, line):
        words = ("modbus", "scan", path, "--baud", line.baud, "--reply-ms", "1000", "--addresses", "2")
        assert "HI14R2N-485-000" in cli(*words).out
    cli.refuses("does not exist", "modbus", "scan", tmp_path / "none")
