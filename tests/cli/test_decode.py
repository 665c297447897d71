"""`imud decode` of captures, among them the example frame of the manual."""

import io
import json
import os
import sys
import threading
from math import pi
from pathlib import Path

import pytest

from imud.drivers.hipnuc.uart.codec import encode_frame
from imud.drivers.imu61x.uart.codec import DEVICE_SYNC, RAW_FRAME
from imud.drivers.imu61x.uart.codec import encode_frame as imu61x_frame
from tests.cli.conftest import Cli
from tests.support.files import hi91, imu61x_log

MANUAL_FRAME = bytes.fromhex(  # Frame of the manual, section 3.5
    "5AA54C0014BB910815 2309A2C447 08151C00 CCE861BE9A35563E65EA723F 31D07CBD75DDC5BB6BD724BC"
    "8988FC4001006A41AB2A70C2 96D45041ED03434141F4F4C2 CCCAF8BE736A19BEF0001C3D8D375C3F".replace(" ", "")
)
DECODE = ("decode", "--driver", "hipnuc-uart")


def lines(text: str) -> list[dict[str, object]]:
    return [json.loads(line) for line in text.splitlines()]


def test_one_object_per_message(tmp_path: Path, cli: Cli) -> None:
    damaged = bytearray(MANUAL_FRAME)
    damaged[40] ^= 0xFF
    capture = tmp_path / "capture.raw"
    capture.write_bytes(MANUAL_FRAME + b"OK\r\n" + bytes(damaged) + b"\x00")
    printed = cli(*DECODE, capture)
    sample, text, bad = lines(printed.out)
    assert sample["t_dev_ns"] == 1_840_392_000_000  # 1,840,392 ms in the table of the manual
    assert sample["accel_m_s2"] == pytest.approx([-0.220615 * 9.8, 0.209189 * 9.8, 0.948889 * 9.8], rel=1e-5)
    assert (sample["temperature_c"], sample["pressure_pa"]) == (35, pytest.approx(100676, abs=1))
    assert (sample["pps_age_ms"], text) == (0x1508, {"text": "OK"})
    assert bad == {"bad_frame": "crc", "raw": bytes(damaged).hex()}
    ledger = json.loads(printed.err)
    assert (ledger["bytes_in"], ledger["frames_in_samples"]) == (82 + 4 + 82 + 1, 1)


def test_device_time_continues_after_24_hours_and_not_after_a_restart(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "night").write_bytes(b"".join(hi91(ms) for ms in (86_399_990, 0, 10, 5)))
    times = [one["t_dev_ns"] for one in lines(cli(*DECODE, tmp_path / "night").out)]
    assert times == [86_399_990_000_000, 86_400_000_000_000, 86_400_010_000_000, 86_400_005_000_000]


def test_standard_input_and_files_without_a_message(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "noise").write_bytes(bytes(range(128, 256)) * 8)
    assert json.loads(cli(*DECODE, tmp_path / "noise", status=1).err)["bytes_in"] == 1024
    error = cli(*DECODE, tmp_path / "none", status=2).err
    assert error == f"imud decode: cannot open {tmp_path}/none: No such file or directory\n"
    cli.refuses("/dev/zero is a character device, expected a regular file", *DECODE, "/dev/zero")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(MANUAL_FRAME * 3)))
    assert len(lines(cli(*DECODE, "-").out)) == 3


def test_a_capture_without_samples_names_its_frames(tmp_path: Path, cli: Cli) -> None:
    """The number of named types has a limit."""
    unknown, file = encode_frame(b"\x77" + bytes(55)), tmp_path / "capture"
    found = "found valid frames of unknown types (tag 0x77: 3), but no sample; "
    for capture, status, words in [
        (unknown * 3, 1, found), (unknown + b"OK\r\n", 1, "`imud settings NAME --set output.hi91=100`"),
        (unknown + MANUAL_FRAME, 0, ""), (b"OK\r\n", 0, ""),  # a capture of replies
    ]:  # fmt: skip
        file.write_bytes(capture)
        err = cli(*DECODE, file, status=status).err
        assert words in err
        assert ("unknown types" in err) == bool(words)
        if status:
            assert "types (tag 0x77" in cli("replay", "--driver", DECODE[2], file, status=1).err
    log = tmp_path / "drive.log"
    log.write_text("".join(f"({one}.0) can0 0CFF{0x60 + one % 12:02X}08#00\n" for one in range(24)))
    err = cli("decode", "--driver", "hipnuc-j1939", log, status=1).err
    assert "found valid frames of unknown types (PGN 65376 (0xFF60): 2, " in err
    assert err.count("PGN 65") == 8
    assert "types (PGN 65376" in " ".join(cli("replay", "--driver", "hipnuc-j1939", log, status=1).err.split())


def test_raw_frames_with_a_layout_from_an_option(tmp_path: Path, cli: Cli) -> None:
    """2048 LSB/g and 16 LSB/(°/s): 1, -0.5, 2 g and 180, -90, 1 °/s."""
    file = tmp_path / "capture"
    file.write_bytes(imu61x_frame(DEVICE_SYNC, RAW_FRAME, bytes.fromhex("400B60FA1000 000800FC0010")))
    decode = ("decode", "--driver", "imu61x-uart", file)
    layout = '"type": "i16", "accel_at": 6, "gyro_at": 0, "accel_g_per_lsb": 4.8828125e-4, "gyro_deg_s_per_lsb": 0.0625'
    (sample,) = lines(cli(*decode, "--option", f"raw_frame={{{layout}}}").out)
    assert sample["accel_m_s2"] == pytest.approx([9.80665, -4.903325, 19.6133])
    assert sample["gyro_rad_s"] == pytest.approx([pi, -pi / 2, pi / 180])
    assert "t_dev_ns" not in sample
    words = "(raw data (identifier 0x0666, set options.raw_frame to the layout in the documents of the device"
    assert words in cli(*decode, status=1).err
    err = cli(*decode, "--option", f"raw_frame={{{layout.replace('6,', '5,')}}}", status=2).err
    assert "--option raw_frame: accel_at: expected 6 or more, the end of the field at gyro_at, got 5" in err


def test_log_of_a_can_bus(tmp_path: Path, cli: Cli) -> None:
    log = tmp_path / "drive.log"
    log.write_text(imu61x_log([65535, 65536]) + "(1.0) can0 7FF#00\nnoise\n")
    printed = cli("decode", "--driver", "imu61x-can", log)
    first, second = lines(printed.out)
    assert (first["index"], second["index"]) == (65535, 65536)
    assert "t_dev_ns" not in first
    assert first["accel_m_s2"] == pytest.approx([0, 0, 9.80665])
    problem, counted = printed.err.splitlines()
    assert "expected a candump log (candump -L), got 1 invalid lines" in problem
    ledger = json.loads(counted)
    assert (ledger["bytes_in"], ledger["bytes_skipped"], ledger["frames_in_samples"]) == (81, 1, 10)
    log.write_text("(1.0) can0 588#6017100000000000\n")  # a device confirms a written setting
    assert cli("decode", "--driver", "hipnuc-canopen", log).out == '{"reply":1416,"payload":"6017100000000000"}\n'


def test_a_fifo_is_read_and_needs_a_writer(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "fifo"
    os.mkfifo(path)
    monkeypatch.setattr("imud.cli.decode.FIFO_WAIT_MS", 1)
    cli.refuses(f"imud decode: {path} is a FIFO that no program writes to; to read", *DECODE, path)
    monkeypatch.setattr("imud.cli.decode.FIFO_WAIT_MS", 60_000)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(path, os.O_WRONLY)
    os.write(writer, hi91(1000) + hi91(1010))
    threading.Timer(0.0, os.close, (writer,)).start()
    assert len(cli(*DECODE, path).out.splitlines()) == 2
    os.close(reader)
