"""Logs of candump, every CAN driver, every command that reads logs: steps of the clock, interfaces, conflicts."""

import json
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from random import Random

import pytest

from imud import drivers
from imud.contracts.driver import CanDriver, of_kind
from imud.drivers.imu61x.can import encode_set
from imud.formats.can import CanFrame
from tests.cli.conftest import Cli
from tests.support.files import BEGIN_NS, FRAME_NS, PERIOD_NS, candump_line

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
@pytest.mark.parametrize("step_ns", [-HOUR_NS, -50_000_000, 28 * HOUR_NS])
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
    assert (
        f"line {len(kept) + 1}: the time changes by {rise_ns / 1e9:+.3f} s (a step of the clock" in report + caplog.text
    )
    if command == "export":
        out = cli("export", "--to", "csv", "--driver", driver, tmp_path / "x.log").out.splitlines()[1:]
        times = [int(row.split(",")[2]) for row in out]
        assert len(times) == SETS
        assert max(b - a for a, b in pairwise(times)) < 2 * PERIOD_NS
        assert abs(times[-1] - times[0] - (SETS - 1) * PERIOD_NS) < 2 * PERIOD_NS


@every_command
@every_driver
def test_a_log_of_two_interfaces_needs_a_choice(driver: str, command: str, tmp_path: Path, cli: Cli) -> None:
    lines = [candump_line(f, bus) for one in sets(driver) for bus in ("can0", "vcan1") for f in one]
    (tmp_path / "x.log").write_text("".join(lines))
    assert "interfaces can0 and vcan1: select one" in run(cli, command, driver, tmp_path / "x.log", status=2)
    wrong = run(cli, command, driver, tmp_path / "x.log", "--interface", "can7", status=2)
    assert "interface can7: expected can0 or vcan1" in wrong
    if driver == "hipnuc-canopen":
        status = status_of(command, driver)
        report = run(cli, command, driver, tmp_path / "x.log", "--interface", "vcan1", status=status)
        assert f"{SETS} samples" in report or f"samples {SETS};" in report or '"frames_good":1200' in report


@pytest.mark.parametrize("command", COMMANDS)
def test_an_interface_is_for_logs_of_a_can_bus(command: str, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "x.raw").write_bytes(bytes(100))
    report = run(cli, command, "hipnuc-uart", tmp_path / "x.raw", "--interface", "can0", status=2)
    assert "--interface applies to logs of a CAN bus" in report


@pytest.mark.parametrize("second_ns", [3_300_000, 5_000_000])
@every_command
@every_driver
def test_two_devices_with_one_address_are_reported(
    driver: str, command: str, second_ns: int, tmp_path: Path, cli: Cli
) -> None:
    """The second device at opposite phases is visible only in the values or in INDEX."""
    both = [frame for phase_ns, index in ((0, 0), (second_ns, 5000)) for one in sets(driver, phase_ns, index)
            for frame in one]  # fmt: skip
    (tmp_path / "x.log").write_text("".join(map(candump_line, sorted(both, key=attrgetter("t_rx_ns")))))
    status = status_of(command, driver)
    report = run(cli, command, driver, tmp_path / "x.log", status=status)
    assert status == 2 or "do two devices on the bus have this" in report


def test_one_device_is_not_a_conflict_and_json_lines_are_complete(tmp_path: Path, cli: Cli) -> None:
    for driver in DRIVERS:
        (tmp_path / "x.log").write_text("".join(candump_line(f) for one in sets(driver) for f in one))
        printed = cli("decode", "--driver", driver, tmp_path / "x.log")
        assert len([json.loads(line) for line in printed.out.splitlines()]) == SETS
        assert "two devices" not in printed.err
