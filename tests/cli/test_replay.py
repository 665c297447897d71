"""`imud replay`: a capture through the whole path, to its end."""

import itertools
import json
from pathlib import Path

import pytest

from imud.cli import main
from imud.formats.capture import RECORD
from imud.units import NS_PER_MS
from tests.support.files import hi91


def capture(file: Path, count: int) -> Path:
    file.write_bytes(b"".join(hi91(10 * i) for i in range(count)))
    return file


def test_every_sample_is_printed_and_the_account_is_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = capture(tmp_path / "c.raw", 50)
    assert main(["replay", "--json", "--baud", "115200", str(file)]) == 0
    printed = capsys.readouterr()
    samples = [json.loads(line) for line in printed.out.splitlines()]
    assert [s["seq"] for s in samples] == list(range(1, 51))
    assert [s["t_dev_ns"] for s in samples] == [10_000_000 * i for i in range(50)]
    times = [s["t_ns"] for s in samples]
    assert times == sorted(set(times))
    assert "samples   50; lost 0" in printed.err
    assert "closed" in printed.err


def test_a_stamped_capture_has_its_own_rate_and_no_figures_of_how_fast_it_was_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "stamped"
    frames = capture(tmp_path / "raw", 100).read_bytes()
    size = len(frames) // 100
    records = [RECORD.pack(n * 10 * NS_PER_MS, size) + frames[n * size : (n + 1) * size] for n in range(100)]
    for header, words in ((b"baud=921600", "at 921600 baud"), (b"", "at 115200 baud")):
        file.write_bytes(b"#imud-capture 1 driver=hipnuc-uart " + header + b"\n" + b"".join(records))
        assert main(["replay", str(file)]) == 0
        said = capsys.readouterr().err
        assert words in said
        assert "Hz by the device's clock" in said
        assert "Hz seen" not in said
        assert "latency" not in said


def test_capture_without_samples_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "noise").write_bytes(b"\x00" * 500)
    assert main(["replay", str(tmp_path / "noise")]) == 1
    assert "samples   0" in capsys.readouterr().err


def test_a_damaged_capture_is_status_1_and_one_that_is_cut_short_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "stamped"
    records = b"".join(RECORD.pack(n * 10 * NS_PER_MS, len(hi91(0))) + hi91(10 * n) for n in range(50))
    for content, status, words in (
        (records[:-20], 0, "are a record cut short"),
        (records + records, 1, "damaged at byte"),  # the time goes back
    ):
        file.write_bytes(b"#imud-capture 1 driver=hipnuc-uart baud=115200\n" + content)
        assert main(["replay", str(file)]) == status
        capsys.readouterr()
        assert main(["export", "--to", "csv", str(file)]) == status
        printed = capsys.readouterr()
        assert words in printed.err
        assert len(printed.out.splitlines()) == 1 + 50 - (status == 0)


def test_missing_capture_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err


def test_log_of_a_can_bus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tests.support.files import imu61x_log

    log = tmp_path / "drive.log"
    log.write_text(imu61x_log([*range(65500, 65580), *range(65583, 65600)]))
    assert main(["replay", "--json", "--driver", "imu61x-can", str(log)]) == 0
    printed = capsys.readouterr()
    samples = [json.loads(line) for line in printed.out.splitlines()]
    assert [s["seq"] for s in samples] == list(range(1, 98))
    steps = [b["t_ns"] - a["t_ns"] for a, b in itertools.pairwise(samples)]
    assert sum(abs(step - 10_000_000) < 100_000 for step in steps[5:]) == len(steps[5:]) - 1
    assert "samples   97; lost 3 (device 3," in printed.err
    assert "closed" in printed.err


@pytest.mark.parametrize("content", [b"", b"Z\xa5 no log", b"(1.0) can0 123##1001122\n"])
def test_file_that_is_no_can_log_is_an_error(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x").write_bytes(content)
    assert main(["replay", "--driver", "imu61x-can", str(tmp_path / "x")]) == 2
    assert "candump -L" in capsys.readouterr().err
