"""`imud info`: start, size, devices, rates, losses and integrity of a recording."""

import json
from pathlib import Path

import pytest

from imud.cli.record import Contents
from imud.formats.records import CheckRecord, Kind, PathRecord, encode_object, records_of
from imud.model.errors import ImudError
from imud.model.ledger import LEDGER_FIELDS
from imud.model.units import NS_PER_S
from tests.cli.conftest import Cli
from tests.cli.recorded_daemon import run_recorded


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    _, _, (made,) = run_recorded(tmp_path_factory.mktemp("info"))
    return made


def test_whole_damaged_cut_and_foreign_files(file: Path, cli: Cli, tmp_path: Path) -> None:
    page = cli("info", file).out
    assert "integrity  complete" in page
    assert "dropped    0 records" in page
    assert "bow: " in page
    assert "driver imu61x-can" in page
    assert "bytes per sample" in page
    assert all(len(line) <= 80 for line in page.splitlines())
    told = json.loads(cli("info", "--json", file).out)
    assert [device["name"] for device in told["devices"]] == ["bow", "mast"]
    bow, mast = told["devices"]
    assert (bow["samples"], bow["reads"], bow["lost"]) == (300, 300, 0)
    assert bow["input_bytes"] == 300 * (82 + 17)
    assert mast["samples"] > 190
    assert (told["stored_bytes"], told["problems"], told["file_number"]) == (file.stat().st_size, [], 0)
    data = bytearray(file.read_bytes())
    (tmp_path / "cut").write_bytes(data[:-3])
    assert "no regular end" in " ".join(cli("info", tmp_path / "cut").out.split())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged").write_bytes(data + file.read_bytes())
    assert "are damaged" in cli("info", tmp_path / "damaged", status=1).out
    data = bytearray(file.read_bytes())
    data[100] ^= 1
    (tmp_path / "damaged").write_bytes(data)
    page = " ".join(cli("info", tmp_path / "damaged", status=1).out.split())
    assert "start unknown: the block with the start time and the device names is damaged or missing" in page
    assert "duration unknown" in page
    assert "missing blocks according to their numbers: 1" in page
    (tmp_path / "a.csv").write_text("t_ns,accel\n" * 50)
    cli.refuses("not a recording of imud", "info", str(tmp_path / "a.csv"))
    cli.refuses("No such file", "info", str(tmp_path / "none"))


def test_a_device_that_was_removed_and_added_counts_from_the_begin_again() -> None:
    contents = Contents()

    def add(kind: Kind, value: object) -> None:
        contents.add(next(records_of(encode_object(kind, 0, value))))

    def check(t_s: int, seq: int, lost: int) -> None:
        ledger = dict.fromkeys(LEDGER_FIELDS, 0) | {"samples": seq, "lost_crc": lost}
        add(Kind.CHECK, CheckRecord(t_s * NS_PER_S, seq, 0, 0, ledger))

    check(10, 5000, 7)
    check(12, 5200, 9)
    add(Kind.PATH, PathRecord("hipnuc-uart", {}, 0, {"samples": 5250}, b""))  # the port opens again
    check(14, 5400, 9)
    check(20, 50, 1)  # a reload adds the device again
    check(21, 150, 4)
    add(Kind.PATH, PathRecord("hipnuc-uart", {}, 0, {"samples": 0}, b""))  # a second reload
    check(30, 200, 0)
    check(32, 400, 5)
    without = {"t_ns": 0, "seq": 0, "sample_t_ns": 0, "sample_t_err_ns": 0, "ledger": {"lost_crc": 0}}
    with pytest.raises(ImudError, match="record of kind 10: expected a ledger with lost_gap_device"):
        add(Kind.CHECK, without)
    device = contents.devices[0]
    assert (device.samples, device.lost) == (400 + 100 + 200, 2 + 3 + 5)
    assert device.rate_hz == pytest.approx(700 / (4 + 1 + 2))
