"""`imud replay` of a capture to its end."""

import itertools
import json
from argparse import Namespace
from io import BytesIO
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from random import Random
from unittest.mock import Mock, call, patch

import msgspec
import pytest

from imud import drivers
from imud.cli.replay import Printer, configuration, play_to_end
from imud.contracts.driver import CanDriver, of_kind
from imud.contracts.publisher import Batch
from imud.drivers.hipnuc.uart.codec import encode_frame
from imud.drivers.imu61x.can import encode_set
from imud.formats.can import CanFrame
from imud.formats.capture import RECORD
from imud.model.units import NS_PER_MS
from imud.recording.player import Player
from tests.cli.conftest import Cli
from tests.cli.recorded_daemon import FRAMES, run_recorded
from tests.support.files import BEGIN_NS, FRAME_NS, PERIOD_NS, candump_line, hi91, imu61x_log


def capture(file: Path, count: int) -> Path:
    file.write_bytes(b"".join(hi91(10 * i) for i in range(count)))
    return file


def test_every_sample_is_printed_and_the_report_names_unknown_times(tmp_path: Path, cli: Cli) -> None:
    file = capture(tmp_path / "c.raw", 50)
    printed = cli("replay", "--json", "--baud", "115200", file)
    samples = [json.loads(line) for line in printed.out.splitlines()]
    assert [s["seq"] for s in samples] == list(range(1, 51))
    assert [s["t_dev_ns"] for s in samples] == [10_000_000 * i for i in range(50)]
    times = [s["t_ns"] for s in samples]
    assert times == sorted(set(times))
    assert "samples   50; lost 0" in printed.err
    assert "all accounted for" in printed.err
    for socket, served in ((None, {"enabled": False}), (Path("/s"), {"enabled": True, "path": "/s"})):
        args = Namespace(driver="hipnuc-uart", option=[], socket=socket, file=file, speed="", baud=0, interface=None)
        assert json.loads(configuration(args))["socket"] == served
    printer = Printer(stop := Mock())
    with patch("builtins.print", side_effect=OSError(28, "No space left on device")) as print_:
        printer.close()
        printer.publish(Batch("bow", 0, []))
    assert (print_.call_args_list, stop.call_count) == ([call("", end="", flush=True)], 1)
    assert str(printer.problem) == "[Errno 28] No space left on device"
    (tmp_path / "noise").write_bytes(b"\x00" * 500)
    assert "samples   0" in cli("replay", tmp_path / "noise", status=1).err
    cli.refuses("none", "replay", str(tmp_path / "none"))
    words = " ".join(cli("replay", capture(tmp_path / "c.raw", 300)).err.split())
    assert "times unknown: a raw capture does not contain arrival times" in words
    assert [word for word in ("ppm", "Hz") if word in words] == []
    assert "samples 300; lost 0" in words


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


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.raw", hi91(0) + encode_frame(b"\x85" + bytes(9)) + hi91(10), "valid frames of unknown types (tag 0x85"),
        ("a.log", b"(1.0) can0 388#0000\n(1.1) can0 188#00000000E803\n", "1 frame of a wrong length, the last of CAN"),
    ],
)  # fmt: skip
def test_the_summary_names_unused_frames_beside_samples(
    tmp_path: Path, cli: Cli, name: str, content: bytes, words: str
) -> None:
    (tmp_path / name).write_bytes(content)
    driver = "hipnuc-canopen" if name == "a.log" else "hipnuc-uart"
    assert f"  unused    {words}" in cli("replay", "--driver", driver, tmp_path / name).err


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


def test_log_of_a_can_bus_and_a_file_that_is_no_log(tmp_path: Path, cli: Cli) -> None:
    log = tmp_path / "drive.log"
    log.write_text(imu61x_log([*range(65500, 65580), *range(65583, 65600)]))
    printed = cli("replay", "--json", "--driver", "imu61x-can", log)
    samples = [json.loads(line) for line in printed.out.splitlines()]
    assert [s["seq"] for s in samples] == list(range(1, 98))
    steps = [b["t_ns"] - a["t_ns"] for a, b in itertools.pairwise(samples)]
    assert sum(abs(step - 10_000_000) < 100_000 for step in steps[5:]) == len(steps[5:]) - 1
    assert "samples   97; lost 3 (device 3," in printed.err
    assert "all accounted for" in printed.err
    for content in (b"", b"Z\xa5 no log", b"(1.0) can0 123##G\n"):
        (tmp_path / "x").write_bytes(content)
        cli.refuses("candump -L", "replay", "--driver", "imu61x-can", str(tmp_path / "x"))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str], dict[str, dict[str, int]]]:
    daemon, collector, (file,) = run_recorded(tmp_path_factory.mktemp("recorded"))
    lines = [msgspec.json.encode(sample).decode() for sample in collector.samples]
    return file, lines, {status.name: status.ledger for status in daemon.status()}


Recorded = tuple[Path, list[str], dict[str, dict[str, int]]]


def test_the_samples_are_those_that_the_daemon_published(recorded: Recorded, cli: Cli) -> None:
    file, lines, ledgers = recorded
    printed = cli("replay", "--json", file)
    assert len(lines) > FRAMES
    assert printed.out.splitlines() == lines
    for name, ledger in ledgers.items():
        assert f"{name}: replayed" in printed.err
        assert f"samples   {ledger['samples']}; lost 0" in printed.err
        assert f"bytes     {ledger['bytes_in']}: all accounted for" in printed.err
    assert printed.err.count("equal to the live run") == 2
    assert "the file" not in printed.err


def test_options_of_captures_a_fresh_clock_and_dropped_records(recorded: Recorded, cli: Cli) -> None:
    for option in (["--driver", "hipnuc-uart"], ["--baud", "9600"], ["--speed", "real"], ["--option", "a=1"]):
        cli.refuses(f"{option[0]} applies to captures only", "replay", *option, str(recorded[0]))
    printed = cli("replay", "--json", "--fresh", recorded[0])
    assert (len(printed.out.splitlines()), printed.err.count("a new clock was requested")) == (len(recorded[1]), 2)
    assert cli("replay", recorded[0]).out == "", "samples need --json"
    for lost, status in ((0, 0), (3, 1)):
        player = Player(lambda _batch: None)
        player.lost = lost
        with recorded[0].open("rb") as file:
            report, got = play_to_end(file, "a", player)
        assert (got, "the recorder dropped 3 records" in report) == (status, lost == 3)


def test_cut_and_damaged_recordings(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    """A slow host writes several blocks, so the blocks before the cut can contain samples."""
    file, lines, _ = recorded
    printed: list[str] = []
    player = Player(lambda batch: printed.extend(msgspec.json.encode(sample).decode() for sample in batch.samples))
    report, status = play_to_end(BytesIO(file.read_bytes()[:-7]), "cut", player)
    assert (printed, status) == (lines[: len(printed)], 0 if printed else 1)
    assert "no regular end" in report
    assert "incomplete" in report
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged").write_bytes(data)
    assert "damaged" in cli("replay", tmp_path / "damaged", status=1).err
    file = tmp_path / "damaged.imudrec"
    file.write_bytes(bytes(8) + recorded[0].read_bytes()[8:])
    for command in (["replay"], ["export", "--to", "csv"]):
        report = cli(*command, file, status=1).err
        assert "bytes from byte 0 are damaged" in report
        assert "the capture" not in report
    (tmp_path / "a").write_bytes(b"\x89imudREC" + bytes(100))
    cli.refuses("at least one complete block", "replay", tmp_path / "a")


DRIVERS = {driver.name: driver for driver in of_kind(drivers.DRIVERS.values(), CanDriver)}
COMMANDS = ("decode", "replay", "export", "noise", "spectrum")
SETS = 300
HOUR_NS = 3600 * 10**9
every_driver = pytest.mark.parametrize("driver", DRIVERS)
every_command = pytest.mark.parametrize("command", COMMANDS)


def sets(driver: str, phase_ns: int = 0, first_index: int = 0) -> list[list[CanFrame]]:
    """Return the frames of SETS samples, each sample as a burst."""
    made = []
    for number in range(SETS):
        if driver == "imu61x-can":
            pairs = encode_set(index=first_index + number, accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0),
                               euler_rad=(0, 0, 0), temperature_c=20)  # fmt: skip
            frames = [CanFrame(can_id, False, data, 0) for can_id, data in pairs]
        else:
            frames = list(DRIVERS[driver].example_frames(Random(first_index)))
        begin_ns = BEGIN_NS + number * PERIOD_NS + phase_ns
        made.append([frame._replace(t_rx_ns=begin_ns + n * FRAME_NS) for n, frame in enumerate(frames)])
    return made


def status_of(command: str, driver: str) -> int:
    """Return the exit status of a command. Noise and vibration need three axes, and noise a sensor at rest."""
    if driver == "hipnuc-nmea2000" and command in ("noise", "spectrum"):
        return 2
    return int(command == "noise" and driver != "imu61x-can")


def run(cli: Cli, command: str, driver: str, log: Path, *options: str, status: int = 0) -> str:
    """Return the standard error, and the standard output without samples."""
    extra = {"export": ["--to", "csv"], "replay": ["--json"]}.get(command, [])
    printed = cli(command, *extra, "--driver", driver, *options, log, status=status)
    shown = "" if command in ("decode", "export", "replay") else printed.out
    return " ".join((shown + printed.err).split())


@every_command
@every_driver
@pytest.mark.parametrize("step_ns", [-HOUR_NS, -50_000_000, -4_000_000, 28 * HOUR_NS])
def test_a_step_of_the_clock_is_reported_and_removed(
    driver: str, command: str, step_ns: int, tmp_path: Path, cli: Cli, caplog: pytest.LogCaptureFixture
) -> None:
    frames = sets(driver)
    stepped = [f._replace(t_rx_ns=f.t_rx_ns + step_ns) for one in frames[SETS // 2 :] for f in one]
    kept = [frame for one in frames[: SETS // 2] for frame in one]
    (tmp_path / "x.log").write_text("".join(map(candump_line, kept + stepped)))
    report = run(cli, command, driver, tmp_path / "x.log", status=status_of(command, driver))
    if status_of(command, driver) == 2:
        return
    rise_ns = stepped[0].t_rx_ns - kept[-1].t_rx_ns
    words = f"line {len(kept) + 1}: the time changes by {rise_ns / 1e9:+.3f} s (a step of the clock"
    if rise_ns > 0 > step_ns:
        words = f"line {len(kept) + 1}: the time shifts by {step_ns / 1e9:+.3f} s (a step of the clock"
    assert words in report + caplog.text
    if command == "export" and "removed" in report + caplog.text:
        out = cli("export", "--to", "csv", "--driver", driver, tmp_path / "x.log").out.splitlines()[1:]
        times = [int(row.split(",")[2]) for row in out]
        assert len(times) == SETS
        assert max(b - a for a, b in pairwise(times)) < 2 * PERIOD_NS
        assert abs(times[-1] - times[0] - (SETS - 1) * PERIOD_NS) < 2 * PERIOD_NS


@every_command
@every_driver
def test_a_log_of_two_interfaces_needs_a_choice(driver: str, command: str, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "x.raw").write_bytes(bytes(100))
    report = run(cli, command, "hipnuc-uart", tmp_path / "x.raw", "--interface", "can0", status=2)
    assert "--interface applies to logs of a CAN bus" in report
    lines = [candump_line(f, bus) for one in sets(driver) for bus in ("can0", "vcan1") for f in one]
    (tmp_path / "x.log").write_text("".join(lines))
    assert "interfaces can0 and vcan1: select one" in run(cli, command, driver, tmp_path / "x.log", status=2)
    wrong = run(cli, command, driver, tmp_path / "x.log", "--interface", "can7", status=2)
    assert "interface can7: expected can0 or vcan1" in wrong
    if driver == "hipnuc-canopen":
        status = status_of(command, driver)
        report = run(cli, command, driver, tmp_path / "x.log", "--interface", "vcan1", status=status)
        options = ("--interface", "vcan1", "--option", "sync_hz=0.001")
        few = run(cli, command, driver, tmp_path / "x.log", *options, status=2)
        assert "--option sync_hz: expected 0, or" in few
        assert f"{SETS} samples" in report or f"samples {SETS};" in report or '"frames_good":1200' in report


@pytest.mark.parametrize("second_ns", [3_300_000, 5_000_000])
@every_command
@every_driver
def test_two_devices_of_one_address_are_told(
    driver: str, command: str, second_ns: int, tmp_path: Path, cli: Cli
) -> None:
    """The second device at opposite phases is visible only in the values or in INDEX."""
    both = [frame for phase_ns, index in ((0, 0), (second_ns, 5000)) for one in sets(driver, phase_ns, index)
            for frame in one]  # fmt: skip
    (tmp_path / "x.log").write_text("".join(map(candump_line, sorted(both, key=attrgetter("t_rx_ns")))))
    status = status_of(command, driver)
    report = run(cli, command, driver, tmp_path / "x.log", status=status)
    assert status == 2 or "do two or more devices on the bus have this" in report


@every_command
@pytest.mark.parametrize(
    ("driver", "words"),
    [("hipnuc-canopen", "imud ignores: node 9;"), ("hipnuc-j1939", "imud ignores: address 9;"),
     ("hipnuc-nmea2000", "imud uses source 35 and ignores source 36;")],
)  # fmt: skip
def test_a_second_device_with_an_address_of_its_own_is_named(
    driver: str, words: str, command: str, tmp_path: Path, cli: Cli
) -> None:
    lines = [candump_line(f._replace(can_id=f.can_id + add)) for one in sets(driver) for f in one for add in (0, 1)]
    (tmp_path / "x.log").write_text("".join(lines))
    status = status_of(command, driver)
    report = run(cli, command, driver, tmp_path / "x.log", status=status)
    assert status == 2 or words in report
    assert f'"frames_good":{len(lines) // 2}' in report or command != "decode"


def test_one_device_is_not_a_conflict_and_json_lines_are_complete(tmp_path: Path, cli: Cli) -> None:
    for driver in DRIVERS:
        (tmp_path / "x.log").write_text("".join(candump_line(f) for one in sets(driver) for f in one))
        printed = cli("decode", "--driver", driver, tmp_path / "x.log")
        assert len([json.loads(line) for line in printed.out.splitlines()]) == SETS
        assert "two devices" not in printed.err
