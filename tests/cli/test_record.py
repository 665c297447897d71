"""`imud record`: the recording replays like the live run, and errors during the recording.
`imud info`: start, size, devices, rates, losses and integrity of a recording.
Snapshots of the flight recorder replay like the live run, from the middle of the run."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import msgspec
import pytest

from imud.cli import record
from imud.cli.record import Contents, Copy, account, interrupts
from imud.formats import records
from imud.formats.records import CheckRecord, Kind, PathRecord, encode_object, records_of
from imud.model.errors import ImudError
from imud.model.ledger import LEDGER_FIELDS
from imud.model.units import NS_PER_S
from imud.publishers.recorder import flight
from tests.cli.conftest import Cli, imud_process
from tests.cli.recorded_daemon import FRAMES, run_recorded, stamped_capture
from tests.support.daemon_process import LIMIT_S, RunningDaemon, running_daemon, wait_until
from tests.support.files import ROOT
from tests.support.surroundings import pipe

pytestmark = pytest.mark.live


def played(folder: Path) -> dict[str, object]:
    capture = str(stamped_capture(folder / "capture"))
    return {"driver": "hipnuc-uart", "replay": {"path": capture, "speed": "recorded", "repeat": True}}


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    folder = tmp_path_factory.mktemp("daemon")
    device = played(folder)
    with running_daemon(folder, {"bow": device, "mast": device}) as made:
        for name in ("bow", "mast"):
            made.wait_for(name, "running")
        yield made


@pytest.fixture
def words(daemon: RunningDaemon) -> tuple[object, ...]:
    return "record", "--socket", daemon.socket


def replayed(file: Path, cli: Cli, *names: str) -> list[dict[str, Any]]:
    """Return the samples of a replay. The replay must be equal to the live run and contain only these devices."""
    printed = cli("replay", "--json", file)
    assert printed.err.count("equal to the live run") == len(names)
    assert "0 of 0" not in printed.err
    assert "the file" not in printed.err
    found = [json.loads(line) for line in printed.out.splitlines()]
    assert {one["device"] for one in found} == set(names)
    return found


def test_a_recording_replays_as_it_ran(
    daemon: RunningDaemon, words: tuple[object, ...], tmp_path: Path, cli: Cli
) -> None:
    before, file = daemon.statuses()["bow"].newest_seq, tmp_path / "a.imudrec"
    assert " samples of 1 device, no records dropped" in cli(*words, "--device", "bow", "--for", "2.2s", file).err
    samples = replayed(file, cli, "bow")
    assert samples[0]["seq"] > before
    assert json.loads(cli("info", "--json", file).out)["devices"][0]["samples"] == len(samples)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it(words: tuple[object, ...], tmp_path: Path, cli: Cli, number: signal.Signals) -> None:
    file = tmp_path / "b.imudrec"
    with imud_process(*words, file) as record:
        wait_until(lambda: file.exists() and file.stat().st_size > 20_000, "a second of records")
        assert "of 2 devices" in record.end(number).err
    replayed(file, cli, "bow", "mast")


def written_to(stdout: Any, *words: object) -> "subprocess.CompletedProcess[str]":
    argv = [sys.executable, "-m", "imud", *map(str, words), "-"]
    return subprocess.run(argv, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False)


def test_standard_output_and_full_or_closed_outputs(words: tuple[object, ...], tmp_path: Path, cli: Cli) -> None:
    with (tmp_path / "c.imudrec").open("wb") as out:
        done = written_to(out, *words, "--for", "1.2s", "--device", "mast")
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("standard output: ")
    replayed(tmp_path / "c.imudrec", cli, "mast")
    with open("/dev/full", "wb") as full:
        done = written_to(full, *words, "--for", "50s")
    assert done.returncode == 2
    assert "cannot write standard output: No space left on device; the data before is complete" in done.stderr
    with pipe() as (reader, writer):
        os.close(reader)
        done = written_to(writer, *words, "--for", "50s")
    assert done.returncode == 2
    said = "imud record: standard output: the reader closed the pipe; the recording ended before its planned end\n"
    assert done.stderr == said


def test_a_recording_or_file_that_cannot_be_made(words: tuple[object, ...], tmp_path: Path, cli: Cli) -> None:
    there = tmp_path / "there"
    there.write_bytes(b"mine")
    cli.refuses("exists; name a new file", *words, there)
    cli.refuses("No such file or directory", *words, tmp_path / "no" / "folder")
    cli.refuses('a device that imud knows, got "keel"; known: bow, mast', *words, "--device", "keel", tmp_path / "d")
    cli.refuses("the flight recorder is off", *words, "--snapshot", tmp_path / "e")
    for option in (("--for", "1s"), ("--device", "bow")):
        cli.refuses("omit --device and --for", *words, "--snapshot", *option)
    cli.refuses("expected a duration, for example 90s, 10min or 2h, got 'soon'", *words, "--for", "soon")
    assert (there.read_bytes(), sorted(tmp_path.iterdir())) == (b"mine", [there])


def test_a_daemon_that_stops_ends_it_and_says_so(tmp_path: Path, cli: Cli) -> None:
    file = tmp_path / "f.imudrec"
    with running_daemon(tmp_path, {"bow": played(tmp_path)}) as made:
        made.wait_for("bow", "running")
        with imud_process("record", "--socket", made.socket, file) as record:
            wait_until(lambda: file.exists() and file.stat().st_size > 10_000, "a second of records")
            made.process.terminate()
            assert "the recording ended before its planned end: imud stopped" in record.end(status=1).err
    replayed(file, cli, "bow")


def example(word: str, **options: Any) -> str:
    """Return the output of the program in docs/recording.md that contains this word."""
    codes = re.findall(r"```python\n(.*?)```", (ROOT / "docs/recording.md").read_text(), re.DOTALL)
    (code,) = (one for one in codes if word in one)
    return str(subprocess.check_output([sys.executable, "-c", code], text=True, timeout=LIMIT_S, **options))


def test_examples_of_the_page(daemon: RunningDaemon, words: tuple[object, ...], tmp_path: Path, cli: Cli) -> None:
    """The second program finds the HI91 frames in the order of time without imud."""
    assert example("imud.client", env=os.environ | {"IMUD_SOCKET": str(daemon.socket)}) == "b'\\x89imudREC'\n"
    cli(*words, "--for", "1s", "--device", "bow", tmp_path / "file")
    reads = [line.split() for line in example("zstd", cwd=tmp_path).splitlines()]
    assert reads
    assert [int(t_ns) for _, t_ns, _ in reads] == sorted(int(t_ns) for _, t_ns, _ in reads)
    assert b"\x5a\xa5\x4c\x00" in bytes.fromhex("".join(data for *_, data in reads)), "HI91 has 76 bytes"


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    _, _, (made,) = run_recorded(tmp_path_factory.mktemp("info"))
    return made


def test_whole_damaged_cut_and_foreign_files(file: Path, cli: Cli, tmp_path: Path) -> None:
    page = cli("info", file).out
    found = "integrity  complete", "dropped    0 records", "bow: ", "driver imu61x-can", "bytes per sample"
    assert [words for words in found if words not in page] == []
    assert all(len(line) <= 80 for line in page.splitlines())
    told = json.loads(cli("info", "--json", file).out)
    assert [device["name"] for device in told["devices"]] == ["bow", "mast"]
    bow, mast = told["devices"]
    assert (bow["samples"], bow["reads"], bow["lost"], bow["input_bytes"]) == (300, 300, 0, 300 * (82 + 17))
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


def test_each_run_in_joined_files_has_its_own_time_and_samples(file: Path, cli: Cli, tmp_path: Path) -> None:
    _, _, (other,) = run_recorded(tmp_path)
    joined = tmp_path / "joined"
    joined.write_bytes(other.read_bytes() + file.read_bytes())  # CLOCK_MONOTONIC steps backward, as in a new boot
    found, *parts = (json.loads(cli("info", "--json", one).out) for one in (joined, other, file))
    assert found["begun_utc_ns"] == parts[0]["begun_utc_ns"]
    assert found["duration_s"] == pytest.approx(sum(part["duration_s"] for part in parts))
    for one, *same in zip(*(part["devices"] for part in (found, *parts)), strict=True):
        assert one["samples"] == sum(part["samples"] for part in same)
    report = cli("replay", joined).err
    assert (report.count("equal to the live run"), report.count("  samples   300; lost 0")) == (4, 2)


def test_an_interrupt_a_silent_daemon_and_a_terminal(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    with interrupts(are_noted=True) as interrupt:
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        assert interrupt.asked
    times_s = iter((0.0, 100.0, 110.0, 110.1))  # start, request, two looks
    monkeypatch.setattr(record, "monotonic", lambda: next(times_s))
    monkeypatch.setattr("select.select", waited := Mock(return_value=([], [], [])))
    stream = Mock()
    copy = Copy(stream, BytesIO(), "a")
    looks = iter((False, True, False))
    copy.look = lambda: copy.stop() if next(looks) else None
    assert (copy.read(9), list(times_s), waited.call_args_list) == (b"", [], [call((stream,), (), (), 0.2)] * 3)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    cli.refuses("cannot write a recording to a terminal; name a file, or use a pipe", "record", "-")


def test_a_device_that_was_removed_and_added_counts_from_the_begin_again(capsys: pytest.CaptureFixture[str]) -> None:
    contents = Contents()

    def add(kind: Kind, value: object) -> None:
        contents.add(next(records_of(encode_object(kind, 0, value))))

    def check(t_s: int, seq: int, lost: int) -> None:
        ledger = dict.fromkeys(LEDGER_FIELDS, 0) | {"samples": seq, "lost_crc": lost}
        add(Kind.CHECK, CheckRecord(t_s * NS_PER_S, seq, 0, 0, ledger))

    add(Kind.PATH, PathRecord("hipnuc-uart", {}, 0, {"samples": 4950, "lost_crc": 6}, b""))  # before the first input
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
    for count in (3, 7):
        contents.add(next(records_of(records.encode_edges(0, "pps", [(5, True, 0)] * count))))
        contents.add(next(records_of(records.encode_lost(records.LostRecord(count, 99, 0)))))
    assert (contents.devices[0].edges, contents.dropped) == (10, 10)
    copy = Copy(BytesIO(), BytesIO(), "a")
    assert account(copy, (contents, Mock(problems=["cut"], ended=False)), "a", asked=False) == 1
    err = capsys.readouterr().err
    assert "a: 0.0 s, 0.00 MB, 0 samples of 0 devices, 10 records dropped\n" in err
    assert err.endswith("record: cut\nimud record: 10 records are missing because imud record was too slow\n")
    device = contents.devices[0]
    assert (device.samples, device.lost) == (450 + 100 + 400, 3 + 3 + 5)
    assert device.rate_hz == pytest.approx(700 / (4 + 1 + 2))


@pytest.mark.parametrize("place", ["memory", "directory"])
def test_the_snapshot_replays_as_it_ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli, place: str) -> None:
    monkeypatch.setattr(flight, "SEGMENT_NS_MIN", 300_000_000)
    monkeypatch.setattr(flight, "MEGABYTE", 28_000)  # the run makes 39,000: the recorder removes the oldest segments
    directory = f"directory: {tmp_path / 'flight'}, " if place == "directory" else ""
    recorder = f"flight: {{enabled: true, {directory}memory_mb: 1, minutes: 0.1, acceleration_m_s2: 5}}"
    _, collector, (file,) = run_recorded(tmp_path, recorder=recorder, speed="recorded", can_frames=FRAMES)
    printed = cli("replay", "--json", file)
    assert printed.err.count("equal to the live run") == 2
    assert "0 of 0 checks" not in printed.err
    for name in ("bow", "mast"):
        live = [msgspec.json.encode(one).decode() for one in collector.samples if one.device == name]
        again = [line for line in printed.out.splitlines() if f'"device":"{name}"' in line]
        assert 20 < len(again) < len(live)
        assert again == live[len(live) - len(again) :]
    assert "integrity  complete" in cli("info", file).out


def test_a_client_saves_the_last_minutes(tmp_path: Path, cli: Cli) -> None:
    recorder = {"directory": str(tmp_path / "recordings"), "flight": {"enabled": True}}
    file = tmp_path / "snapshot.imudrec"
    with running_daemon(tmp_path, {"bow": played(tmp_path)}, recorder=recorder) as daemon:
        wait_until(lambda: daemon.wait_for("bow", "running").newest_seq > 150, "150 samples")
        assert "samples of 1 device" in cli("record", "--socket", daemon.socket, "--snapshot", file).err
    printed = cli("replay", "--json", file)
    assert len(printed.out.splitlines()) > 150
    assert "equal to the live run" in printed.err
    assert list((tmp_path / "recordings").glob("*.imudrec")) == []
