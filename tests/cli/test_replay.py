"""`imud replay` of a capture to its end."""

import itertools
import json
from pathlib import Path

import pytest

from imud.formats.capture import RECORD
from imud.model.units import NS_PER_MS
from tests.cli.conftest import Cli
from tests.support.files import hi91, imu61x_log


def capture(file: Path, count: int) -> Path:
    file.write_bytes(b"".join(hi91(10 * i) for i in range(count)))
    return file


def test_every_sample_is_printed_and_the_account_is_given(tmp_path: Path, cli: Cli) -> None:
    file = capture(tmp_path / "c.raw", 50)
    printed = cli("replay", "--json", "--baud", "115200", file)
    samples = [json.loads(line) for line in printed.out.splitlines()]
    assert [s["seq"] for s in samples] == list(range(1, 51))
    assert [s["t_dev_ns"] for s in samples] == [10_000_000 * i for i in range(50)]
    times = [s["t_ns"] for s in samples]
    assert times == sorted(set(times))
    assert "samples   50; lost 0" in printed.err
    assert "balanced" in printed.err


def test_a_stamped_capture_has_its_own_rate_and_no_figures_of_how_fast_it_was_read(tmp_path: Path, cli: Cli) -> None:
    file = tmp_path / "stamped"
    frames = capture(tmp_path / "raw", 100).read_bytes()
    size = len(frames) // 100
    records = [RECORD.pack(n * 10 * NS_PER_MS, size) + frames[n * size : (n + 1) * size] for n in range(100)]
    for header, words in ((b"baud=921600", "at 921600 baud"), (b"", "at 115200 baud")):
        file.write_bytes(b"#imud-capture 1 driver=hipnuc-uart " + header + b"\n" + b"".join(records))
        said = cli("replay", file).err
        assert words in said
        assert "Hz by the device's clock" in said
        assert "Hz seen" not in said
        assert "latency" not in said


def test_a_capture_without_samples_and_none(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "noise").write_bytes(b"\x00" * 500)
    assert "samples   0" in cli("replay", tmp_path / "noise", status=1).err
    cli.refuses("none", "replay", str(tmp_path / "none"))


def test_a_damaged_capture_is_status_1_and_one_that_is_cut_short_is_not(tmp_path: Path, cli: Cli) -> None:
    file = tmp_path / "stamped"
    records = b"".join(RECORD.pack(n * 10 * NS_PER_MS, len(hi91(0))) + hi91(10 * n) for n in range(50))
    for content, status, words in (
        (records[:-20], 0, "are an incomplete record"),
        (records + records, 1, "damaged at byte"),  # the time steps back
    ):
        file.write_bytes(b"#imud-capture 1 driver=hipnuc-uart baud=115200\n" + content)
        cli("replay", file, status=status)
        printed = cli("export", "--to", "csv", file, status=status)
        assert words in printed.err
        assert len(printed.out.splitlines()) == 1 + 50 - (status == 0)


def test_log_of_a_can_bus(tmp_path: Path, cli: Cli) -> None:
    log = tmp_path / "drive.log"
    log.write_text(imu61x_log([*range(65500, 65580), *range(65583, 65600)]))
    printed = cli("replay", "--json", "--driver", "imu61x-can", log)
    samples = [json.loads(line) for line in printed.out.splitlines()]
    assert [s["seq"] for s in samples] == list(range(1, 98))
    steps = [b["t_ns"] - a["t_ns"] for a, b in itertools.pairwise(samples)]
    assert sum(abs(step - 10_000_000) < 100_000 for step in steps[5:]) == len(steps[5:]) - 1
    assert "samples   97; lost 3 (device 3," in printed.err
    assert "balanced" in printed.err


@pytest.mark.parametrize("content", [b"", b"Z\xa5 no log", b"(1.0) can0 123##1001122\n"])
def test_file_that_is_no_can_log_is_an_error(content: bytes, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "x").write_bytes(content)
    cli.refuses("candump -L", "replay", "--driver", "imu61x-can", str(tmp_path / "x"))
