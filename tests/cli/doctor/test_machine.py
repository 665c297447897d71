"""Checks of the clock, the storage, the power supply and the processors of a simulated host."""

import msgspec
import pytest

from imud.cli.doctor.machine import host_clock, power, processor, storage
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import PollingStatus
from imud.utc.system_clock import KernelClock
from tests.support.metrics import device
from tests.support.surroundings import Machine

CLOCK, STORAGE, POWER, PROCESSOR = (
    DoctorCheck("c", host_clock), DoctorCheck("s", storage), DoctorCheck("p", power), DoctorCheck("u", processor),
)  # fmt: skip


def test_clock_and_storage(machine: Machine) -> None:
    for clock, severity in [
        (KernelClock(True, 100_000, 1000), "ok"),
        (KernelClock(True, 100_001, 1000), "note"),
        (KernelClock(False, 0, 0), "warning"),
    ]:
        machine.clock = clock
        assert [finding.severity for finding in machine.find(CLOCK)] == [severity]
    for worst_s, severity in [(0.05, "ok"), (0.2, "warning"), (1.0, "error")]:
        machine.write("/srv/imud/x")
        machine.configure(more="state_dir: /srv/imud\n")
        machine.write(
            "/proc/mounts", "/dev/sda1 / ext4 rw 0 0\n/dev/mmcblk0p2 /srv ext4 rw 0 0\n/dev/sdb /srv/im ext4 rw 0 0\n"
        )
        machine.sync_s = [0.01, worst_s, 0.02]
        machine.tells(STORAGE, severity, f"to /srv/imud (/dev/mmcblk0p2) took up to {worst_s * 1000:.0f} ms")


def test_storage_that_is_not_there_or_may_not_be_written(machine: Machine) -> None:
    assert machine.find(STORAGE)[0].severity == "not checked"
    machine.write("/var/lib/imud/x")
    at = machine.surroundings()

    def refuse(_folder: object) -> float:
        raise PermissionError(13, "Permission denied")

    at.sync_s = refuse
    (finding,) = storage(at)
    assert finding.severity == "not checked"
    assert "sudo imud doctor" in finding.advice


@pytest.mark.parametrize(
    ("word", "severities"),
    [
        ("0", ["ok"]), ("50005", ["error", "warning"]), ("50000", ["warning", "note"]), ("80008", ["warning"]),
        ("20000", ["note"]),
    ],
)  # fmt: skip
def test_power_of_a_raspberry_pi(machine: Machine, word: str, severities: list[str]) -> None:
    machine.write("/proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0")
    machine.write("/sys/devices/platform/soc/soc:firmware/get_throttled", word + "\n")
    assert [finding.severity for finding in machine.find(POWER)] == severities


def test_vcgencmd_is_asked_where_sysfs_has_nothing(machine: Machine) -> None:
    assert machine.find(POWER) == []  # not a Raspberry Pi
    machine.write("/proc/device-tree/model", "Raspberry Pi 3 Model B\0")
    assert machine.find(POWER)[0].severity == "not checked"
    machine.prints("vcgencmd get_throttled", "throttled=0x1\n")
    assert machine.find(POWER)[0].severity == "error"
    machine.prints("vcgencmd get_throttled", "", 255, "Can't open device file")
    assert machine.find(POWER)[0].severity == "not checked"
    machine.prints("vcgencmd get_throttled", "throttled=strange\n")
    assert machine.find(POWER)[0].severity == "not checked"


@pytest.mark.parametrize(
    ("load", "pressure", "severity"),
    [("3.0", "20.00", "ok"), ("3.1", "19.00", "warning"), ("0.1", "20.01", "warning"), ("0.1", None, "ok")],
)
def test_load_of_two_processors(machine: Machine, load: str, pressure: str | None, severity: str) -> None:
    for name in ("cpu0", "cpu1", "cpufreq"):
        machine.write(f"/sys/devices/system/cpu/{name}/x")
    machine.write("/proc/loadavg", f"9.00 {load} 9.00 1/200 999\n")
    if pressure is not None:
        machine.write("/proc/pressure/cpu", f"some avg10=0.00 avg60={pressure} avg300=0.00 total=1\nfull avg10=0.00\n")
    machine.tells(PROCESSOR, severity, "on 2 processors")


def test_samples_lost_and_reads_late_by_a_busy_machine(machine: Machine) -> None:
    assert machine.find(PROCESSOR)[0].severity == "not checked"
    machine.write("/proc/loadavg", "0.00 0.00 0.00 1/200 999\n")
    busy = device("a")
    busy = msgspec.structs.replace(busy, ledger=busy.ledger | {"samples": 100_000, "lost_queue": 11})
    late = device("b", polling=PollingStatus(polls=1000, late=51, late_worst_ns=3_000_000))
    late = msgspec.structs.replace(late, ledger=late.ledger | {"lost_queue": 0})
    good = msgspec.structs.replace(late, polling=PollingStatus(polls=1000, late=50))
    level = msgspec.structs.replace(busy, ledger=busy.ledger | {"lost_queue": 10})
    machine.status = [busy, late, good, level]
    found = machine.told(PROCESSOR)
    assert [severity for severity, _ in found] == ["ok", "warning", "warning"]
    assert "a: 11 samples lost" in found[1][1]
    assert "b: 51 of 1000 reads were late, by up to 3.0 ms" in found[2][1]
