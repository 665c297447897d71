"""`imud modbus` on a simulated line: who is there, and who is called what afterwards."""

import json
from pathlib import Path

import pytest

from imud.cli import main
from imud.contracts.driver import Identity
from imud.contracts.session import says_nothing
from imud.sim.hipnuc.modbus import SlaveSettings
from tests.support.pty_port import BAUD, serial_of, slave, wired

ON = ("--baud", str(BAUD), "--reply-ms", "30")
PATIENT = ("--baud", str(BAUD), "--reply-ms", "400")
"""For a scan, where each missing reply takes time: the line is moved along by a thread that the machine may hold up."""


@pytest.fixture(autouse=True)
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated modules need no time for a new address."""
    monkeypatch.setattr("imud.cli.modbus.line.SETTLE_S", 0.0)


def scanned(path: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, list[dict[str, object]]]:
    capsys.readouterr()
    status = main(["modbus", "scan", str(path), "--json", *more])
    return status, [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_scan_lists_who_answers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with wired(tmp_path, slave(2), slave(7, firmware=152), slave(5, dead=True)) as (path, _):
        status, found = scanned(path, capsys, *PATIENT, "--addresses", "2-7")
        assert status == 0
        assert [(one["address"], one["firmware"]) for one in found] == [(2, "1.6.9"), (7, "1.5.2")]
        assert found[0] == {
            "baud": BAUD, "address": 2, "product": "HI14R2N-485-000", "serial_number": serial_of(2).hex().upper(),
            "firmware": "1.6.9",
        }  # fmt: skip
        assert main(["modbus", "scan", str(path), *PATIENT, "--addresses", "7"]) == 0
        out = capsys.readouterr().out
        assert "ADDRESS" in out
        assert serial_of(7).hex().upper() in out
        assert main(["modbus", "scan", str(path), *ON, "--addresses", "8"]) == 1
        assert "no module answers" in capsys.readouterr().out


def test_scan_asks_again_what_did_not_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One answer is lost, one damaged, and one lost twice on a line where others answer."""
    modules = slave(1), slave(2, mute=1), slave(3, bad_crc=1), slave(4, mute=2)
    with wired(tmp_path, *modules) as (path, _):
        status, found = scanned(path, capsys, *PATIENT, "--addresses", "1-4")
        assert status == 0
        assert [(one["address"], one.get("problem", "")) for one in found] == [(n, "") for n in (1, 2, 3, 4)]


def test_a_module_alone_on_its_line_is_asked_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with wired(tmp_path, slave(2, mute=1)) as (path, _):
        status, found = scanned(path, capsys, *PATIENT, "--addresses", "2")
        assert (status, [one["address"] for one in found]) == (0, [2])


def test_scan_at_every_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with wired(tmp_path, slave(3, baud=19200)) as (path, _):
        status, found = scanned(path, capsys, "--baud", "all", "--reply-ms", "200", "--addresses", "3")
        assert status == 0
        assert [(one["baud"], one["address"]) for one in found if "problem" not in one] == [(19200, 3)]


@pytest.mark.manual("B 4.6 address by serial number")
def test_two_modules_of_one_address_are_told_and_parted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    twins = slave(80, serial=0x0F), slave(80, serial=0xF0)
    with wired(tmp_path, *twins) as (path, line):
        status, found = scanned(path, capsys, *PATIENT, "--addresses", "80")
        assert status == 1
        assert "two modules with this address" in str(found[0]["problem"])
        serial = serial_of(0xF0).hex()
        assert main(["modbus", "assign", str(path), *ON, "--serial", serial, "--id", "6"]) == 0
        assert serial.upper() in capsys.readouterr().out
        assert [one.settings.slave for one in line.slaves] == [80, 6]
        assert [one.flash.slave for one in line.slaves] == [80, 6]
        status, found = scanned(path, capsys, *PATIENT, "--addresses", "80")
        assert status == 0


@pytest.mark.manual("B 4.6 random addresses")
def test_random_addresses_part_them_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    twins = [slave(80, serial=number) for number in (1, 2, 3)]
    with wired(tmp_path, *twins) as (path, line):
        assert (
            main(["modbus", "assign", str(path), *PATIENT, "--random", "1-9"]) == 0
        )  # by the seed, three different ones
        out = capsys.readouterr().out
        assert all(serial_of(number).hex().upper() in out for number in (1, 2, 3))
        kept = [one.flash.slave for one in line.slaves]
        assert len(set(kept)) == 3
        assert set(kept) <= set(range(1, 10))


def test_by_address_and_not_saved(tmp_path: Path) -> None:
    with wired(tmp_path, slave(1), slave(2)) as (path, line):
        assert main(["modbus", "assign", str(path), *ON, "--from", "1", "--id", "9", "--no-save"]) == 0
        assert line.slaves[0].settings.slave == 9
        assert line.slaves[0].flash == SlaveSettings(1, BAUD)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--from", "1", "--id", "2"), "address 2 is taken by HI14R2N-485-000"),
        (("--from", "5", "--id", "6"), "no module answers at address 5"),
        (("--from", "1", "--id", "200"), "1 … 128"),
        (("--from", "0", "--id", "9"), "1 … 247"),
        (("--from", "1"), "--id"),
        (("--random", "1-9", "--id", "1"), "--id"),
        (("--random", "9"), "lowest below the highest"),
        (("--serial", serial_of(9).hex(), "--id", "9"), "no module answers at address 9"),
        (("--serial", serial_of(9).hex(), "--id", "2"), "address 2 is taken"),
        (("--serial", "12", "--id", "9"), "16 hexadecimal digits"),
        (("--from", "1", "--id", "9", "--reply-ms", "0"), "--reply-ms"),
        (("--from", "1", "--id", "9", "--baud", "12345"), "--baud"),
    ],
)
def test_what_is_refused_changes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], why: str
) -> None:
    with wired(tmp_path, slave(1), slave(2)) as (path, line):
        assert main(["modbus", "assign", str(path), *ON, *words]) == 2
        assert why in capsys.readouterr().err
        assert [one.settings.slave for one in line.slaves] == [1, 2]


def test_another_module_that_wakes_up_at_the_new_address_is_not_taken_for_the_wanted_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asleep = slave(2, mute=4)  # three requests whether the address is free, and the one to all
    with wired(tmp_path, asleep) as (path, _):
        assert main(["modbus", "assign", str(path), *ON, "--serial", serial_of(9).hex(), "--id", "2"]) == 2
        assert f"expected serial number {serial_of(9).hex().upper()} at address 2" in capsys.readouterr().err
        assert asleep.flash == asleep.settings


@pytest.mark.parametrize("text", ["0-5", "5-1", "1-248", "x", "1-x", ""])
def test_addresses_that_are_none(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["modbus", "scan", "/dev/null", "--addresses", text])
    assert "expected" in capsys.readouterr().err


def test_port_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["modbus", "scan", str(tmp_path / "none")]) == 2
    assert "is not there" in capsys.readouterr().err


def test_what_a_module_says_of_itself_cannot_write_to_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = Identity("HI\x1b[2J14\n", "\x9b1A", "1.6.9")
    monkeypatch.setattr("imud.cli.modbus.line.probe", lambda _settings: says_nothing(said))
    with wired(tmp_path, slave(2)) as (path, _):
        status, (found,) = scanned(path, capsys, *ON, "--addresses", "2")
        assert (status, found["product"], found["serial_number"]) == (0, "HI\\x1b[2J14\\n", "\\x9b1A")
