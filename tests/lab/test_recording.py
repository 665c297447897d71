"""Recordings of real links, replayed: all members of all samples, and all ledgers, are equal to the live run.

The test uses all kinds of links together (tests/lab/chaos/far_side.py): a HiPNUC device on a pseudo-terminal with SOUT
on gpio-sim, IMU61x devices on a 16550A, vcan, an SJA1000 pair, i2c-dev and spidev, and Modbus. The client reads samples
from the socket, and from shared memory before its connection. It does not use the recording.
"""

import errno
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from time import monotonic_ns, sleep

import msgspec
import pytest

from imud.cli.replay import play_to_end
from imud.contracts.lines import DeviceLines, ReadyOptions
from imud.contracts.status import DeviceState
from imud.model.event import Event, EventKind
from imud.model.ledger import lost
from imud.model.sample import Sample, Sync
from imud.recording.player import Player
from tests.lab.bus import Bus
from tests.lab.chaos.daemon import Life, Snapshot
from tests.lab.chaos.far_side import FarSide
from tests.lab.gpio_chip import GpioChip
from tests.lab.imu61x_bus import LIMIT_S, on_i2c
from tests.lab.imu_process import running_imu, tty
from tests.lab.test_imu61x_lines import FALLBACK_HZ, Stepped, first
from tests.lab.tool import tool
from tests.lab.wire import I2cTransfer
from tests.support.daemon_process import RunningDaemon, running_daemon, wait_until, write_config
from tests.support.device_rig import DeviceRigs, device_config, running

pytestmark = pytest.mark.timeout(900)

SLOW_S = 150.0
RUN_S = 12.0
REQUEST_S = 5
LEAST = 30
"""Minimum number of samples of each device in RUN_S. The slowest device, at 5 Hz, sends twice this number."""
BEFORE_MOST = 5
"""Maximum number of samples of a device before its recording starts."""
DISK = "2m"
EDGES = 10


# --- all links --------------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_every_link_is_replayed_as_it_ran(tmp_path: Path) -> None:
    directory, asked_for = tmp_path / "recordings", tmp_path / "asked.imudrec"
    far = FarSide(tmp_path, 15)
    with ExitStack() as until_end:
        with far:
            recorder = {"enabled": True, "directory": str(directory)}
            more = {"log_level": "info", "metrics": {"enabled": False}, "recorder": recorder}
            file = write_config(tmp_path, far.devices(), **more)
            life = until_end.enter_context(living(tmp_path, file))
            life.wait_running()
            record(life, asked_for)
            sleep(RUN_S)
        at_end = at_rest(life)  # all devices are removed: the ledgers no longer change
        life.terminate()
    live = received(life)
    assert life.recorder.dropped == []
    (recording,) = directory.glob("*.imudrec")
    again = replayed(recording)
    for name, samples in live.items():
        begin = again[name][0].seq - samples[0].seq
        assert 0 <= begin < BEFORE_MOST, name
        assert len(again[name]) >= LEAST, name
        assert again[name] == samples[begin:], differing(again[name], samples[begin:])
        assert ledgers(recording)[name] == at_end.devices[name].ledger, name
    assert {sample.sync for sample in live["serial"]} >= {Sync.EDGE}
    part = replayed(asked_for)
    assert set(part) == {"serial", "vcan"}
    for name, samples in part.items():
        assert len(samples) >= LEAST, name
        begin = samples[0].seq - live[name][0].seq
        assert samples == live[name][begin : begin + len(samples)], name


@contextmanager
def living(folder: Path, file: Path) -> Iterator[Life]:
    life = Life(folder, file)
    try:
        yield life
    finally:
        if life.process.poll() is None:
            life.destroy()


def record(life: Life, file: Path) -> None:
    devices = ("--device", "serial", "--device", "vcan")
    command = ("-m", "imud", "record", "--socket", str(life.socket), *devices, "--for", f"{REQUEST_S}s", str(file))
    subprocess.run([sys.executable, *command], check=True, timeout=SLOW_S)


def received(life: Life) -> dict[str, list[Sample]]:
    found: dict[str, list[Sample]] = {}
    for name, samples in life.recorder.samples().items():
        by_seq = {sample.seq: sample for sample in (*life.recorder.before[name], *samples)}
        found[name] = [by_seq[seq] for seq in sorted(by_seq)]
    return found


def at_rest(life: Life) -> Snapshot:
    found: list[Snapshot] = []

    def none_runs() -> bool:
        found.append(life.snapshot())
        return all(status.state is not DeviceState.RUNNING for status in found[-1].devices.values())

    wait_until(none_runs, "the end of all samples", SLOW_S)
    sleep(1)
    again = life.snapshot()
    moved = [n for n, status in again.devices.items() if status.ledger != found[-1].devices[n].ledger]
    assert not moved, f"{moved} still change"
    return again


def replayed(file: Path) -> dict[str, list[Sample]]:
    command = [sys.executable, "-m", "imud", "replay", "--json", str(file)]
    done = subprocess.run(command, capture_output=True, timeout=SLOW_S, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert b"equal to the live run" in done.stderr
    found: dict[str, list[Sample]] = {}
    for line in done.stdout.splitlines():
        sample = msgspec.json.decode(line, type=Sample)
        found.setdefault(sample.device, []).append(sample)
    return found


def ledgers(file: Path) -> Mapping[str, Mapping[str, int]]:
    player = Player(lambda _batch: None)
    with file.open("rb") as opened:
        play_to_end(opened, file.name, player)
    return {device.described.name: device.ledger.snapshot() for device in player.devices.values()}


def differing(found: list[Sample], live: list[Sample]) -> str:
    pairs = [(a, b) for a, b in zip(found, live, strict=False) if a != b]
    return f"{len(found)} and {len(live)} samples, {len(pairs)} of them differ: {pairs[:1]}"


# --- a data-ready line ------------------------------------------------------------------------------------------------


async def test_samples_of_a_data_ready_line_are_replayed(i2c: Bus[I2cTransfer], gpio_chip: GpioChip) -> None:
    """First single edges, then many edges together, so that reads miss some. The rigs compare at the end."""
    it = Stepped(gpio_chip)
    i2c.attach(0x18, on_i2c(it.device))
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 0, "rate_hz": FALLBACK_HZ})
    rigs = DeviceRigs()
    rigs.recording = True
    lines = DeviceLines(data_ready=ReadyOptions(line="SOUT"))
    async with running(replace(config, lines=lines), rigs=rigs) as (rig,):
        await first(rig)
        for number in range(1, EDGES + 1):
            it.renew()
            await rig.until(lambda number=number: len(rig.samples) > number, "its sample", LIMIT_S)  # type: ignore[misc]  # binds it
        for _ in range(EDGES):
            it.renew()
        await rig.until(lambda: len(rig.samples) > EDGES + 1, "a sample of many edges", LIMIT_S)
        assert rig.samples[EDGES].edge_seq == EDGES
        assert rig.recorded


# --- the flight recorder, and a full disk -----------------------------------------------------------------------------


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    tool("mount", "-t", "tmpfs", "-o", f"size={DISK}", "imud-disk", str(folder))
    yield folder
    tool("umount", str(folder))


def fill(file: Path) -> None:
    with file.open("wb", buffering=0) as out, suppress(OSError):
        while True:
            out.write(bytes(4096))
    with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)):
        file.with_suffix(".more").write_bytes(bytes(4096))
    file.with_suffix(".more").unlink()


@contextmanager
def recording_daemon(folder: Path, disk: Path) -> Iterator[RunningDaemon]:
    flight = {"enabled": True, "minutes": 0.2, "after_s": 2, "memory_mb": 4, "line": {"line": "PPS"}}
    recorder = {"enabled": True, "directory": str(disk), "file_mb": 1, "keep_gb": 0.01, "flight": flight}
    device = {"driver": "hipnuc-uart", "uart": {"port": str(tty(folder)), "baud": 115200}}
    metrics = {"enabled": False}
    with running_daemon(
        folder, {"bow": device}, limit_s=SLOW_S, python=(), log_level="info", metrics=metrics, recorder=recorder
    ) as made:
        yield made


def told(events: Iterator[Event], words: str) -> Event:
    return next(event for event in events if event.kind is EventKind.RECORDER and words in event.message)


def test_an_edge_saves_a_snapshot_and_a_full_disk_stops_recording_only(
    gpio_chip: GpioChip, tmp_path: Path, disk: Path
) -> None:
    with (
        running_imu(tmp_path, gpio_chip, {}, "--rate", "20"),
        recording_daemon(tmp_path, disk) as made,
        closing(made.client()) as reader,
        closing(made.client()) as listener,
    ):
        events = listener.events(timeout_s=SLOW_S)
        watch = reader.watch(["bow"], timeout_s=SLOW_S)
        wait_until(lambda: "imud flight recorder" in tool("gpioinfo", gpio_chip.path.name), "its line", SLOW_S)
        live = [next(watch)]
        sleep(3)
        pressed_ns = monotonic_ns()
        gpio_chip.drive("PPS", True)
        saved = told(events, "saved ")
        gpio_chip.drive("PPS", False)
        fill(disk / "filler")
        full = told(events, "cannot record to")
        gpio_chip.drive("PPS", True)
        not_saved = told(events, "cannot save the snapshot")
        end_ns = monotonic_ns()
        while live[-1].t_ns < end_ns:
            live.append(next(watch))
        ledger = made.statuses()["bow"].ledger
        assert watch.dropped == {}
    assert "the line of the flight recorder became active" in saved.message
    assert os.strerror(errno.ENOSPC) in full.message
    assert os.strerror(errno.ENOSPC) in not_saved.message
    assert [sample.seq for sample in live] == list(range(live[0].seq, live[0].seq + len(live)))
    assert lost(ledger) == ledger["lost_unknown"] == 0
    snapshot = Path(str(saved.detail["file"]))
    assert snapshot.stat().st_size == saved.detail["bytes"]
    assert len(list(disk.glob("*-snapshot.imudrec"))) == 1, "a part of a snapshot is left"
    compare_part(live, replayed(snapshot)["bow"], pressed_ns)
    (always,) = set(disk.glob("*.imudrec")) - {snapshot}
    compare_part(live, replayed(always)["bow"], pressed_ns)


def compare_part(live: list[Sample], again: list[Sample], during_ns: int) -> None:
    known = {sample.seq: sample for sample in live}
    both = [sample for sample in again if sample.seq in known]
    assert both == [known[sample.seq] for sample in both]
    assert both[0].t_ns < during_ns - 10**9
    assert both[-1].t_ns > during_ns + 10**9
