"""Checks of the clock, the storage, the power supply and the processors of a simulated host."""

from unittest.mock import Mock

import msgspec

from imud.cli.doctor.machine import host_clock, kernel_log, power, processor, storage
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import PollingStatus
from imud.utc.system_clock import KernelClock
from tests.support.metrics import device
from tests.support.surroundings import Machine

CLOCK, STORAGE, POWER = DoctorCheck("c", host_clock), DoctorCheck("s", storage), DoctorCheck("p", power)
PROCESSOR, LOG = DoctorCheck("u", processor), DoctorCheck("k", kernel_log)


def test_clock_storage_and_power_of_a_raspberry_pi(machine: Machine) -> None:
    assert machine.find(STORAGE)[0].severity == "not checked"
    machine.write("/var/lib/imud/x")
    at = machine.surroundings()
    at.sync_s = Mock(side_effect=PermissionError(13, "Permission denied"))
    (finding,) = storage(at)
    assert finding.severity == "not checked"
    assert "sudo imud doctor" in finding.advice
    at.sync_s = Mock(side_effect=OSError(30, "Read-only file system"))
    (finding,) = storage(at)
    assert (finding.severity, finding.advice) == ("error", "set state_dir to a directory that imud can write")
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
        mounts = ("/dev/sda1 /", "/dev/mmcblk0p2 /srv", "/dev/sdb /srv/im")
        machine.write("/proc/mounts", "".join(f"{mount} ext4 rw 0 0\n" for mount in mounts))
        machine.sync_s = [0.01, worst_s, 0.02]
        machine.tells(STORAGE, severity, f"to /srv/imud (/dev/mmcblk0p2) took up to {worst_s * 1000:.0f} ms")
    assert machine.find(POWER) == []  # not a Raspberry Pi
    machine.write("/proc/device-tree/model", "Raspberry Pi 3 Model B\0")
    assert machine.find(POWER)[0].severity == "not checked"
    machine.prints("vcgencmd get_throttled", "throttled=0x1\n")
    assert machine.find(POWER)[0].severity == "error"
    for reply in (("", 255, "Can't open device file"), ("throttled=strange\n",)):
        machine.prints("vcgencmd get_throttled", *reply)
        assert machine.find(POWER)[0].severity == "not checked"
    for word, severities in [
        ("0", ["ok"]), ("50005", ["error", "warning"]), ("50000", ["warning", "note"]), ("80008", ["warning"]),
        ("20000", ["note"]), ("1", ["error"]), ("10000", ["warning"]),
    ]:  # fmt: skip
        machine.write("/proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0")
        machine.write("/sys/devices/platform/soc/soc:firmware/get_throttled", word + "\n")
        assert [finding.severity for finding in machine.find(POWER)] == severities, word


def test_load_of_two_processors_lost_samples_and_late_reads(machine: Machine) -> None:
    assert machine.find(PROCESSOR)[0].severity == "not checked"
    for name in ("cpu0", "cpu1", "cpufreq"):
        machine.write(f"/sys/devices/system/cpu/{name}/x")
    for load, pressure, severity in [
        ("0.1", None, "ok"), ("3.1", "19.00", "warning"), ("0.1", "20.01", "warning"), ("3.0", "20.00", "ok"),
    ]:  # fmt: skip
        machine.write("/proc/loadavg", f"9.00 {load} 9.00 1/200 999\n")
        if pressure is not None:
            machine.write(
                "/proc/pressure/cpu", f"some avg10=0.00 avg60={pressure} avg300=0.00 total=1\nfull avg10=0.00\n"
            )
        machine.tells(PROCESSOR, severity, "on 2 processors")
    machine.write("/proc/loadavg", "0.00 0.00 0.00 1/200 999\n")
    busy = device("a")
    busy = msgspec.structs.replace(busy, ledger=busy.ledger | {"samples": 100_000, "lost_queue": 11})
    late = device("b", polling=PollingStatus(polls=1000, late=51, late_worst_ns=3_000_000))
    late = msgspec.structs.replace(late, ledger=late.ledger | {"lost_queue": 0})
    good = msgspec.structs.replace(late, polling=PollingStatus(polls=1000, late=50))
    machine.status = [busy, late, good, msgspec.structs.replace(busy, ledger=busy.ledger | {"lost_queue": 10})]
    found = machine.told(PROCESSOR)
    assert [severity for severity, _ in found] == ["ok", "warning", "warning"]
    assert "a: 11 samples lost" in found[1][1]
    assert "b: 51 of 1000 reads were late, by up to 3.0 ms" in found[2][1]


QUIET = (
    "usb 1-1: new full-speed USB device number 4 using xhci_hcd\nhub 1-0:1.0: USB hub found\n"
    "ftdi_sio ttyUSB0: FTDI USB Serial Device converter now disconnected from ttyUSB0\n"
    "mmc0: new high speed SDHC card at address aaaa\ni2c_dev: i2c /dev entries driver\n"
    "can0: bitrate error 0.0%\n"
)


def test_each_kind_of_trouble_in_the_kernel_log_and_its_sources(machine: Machine) -> None:
    for line, words in [
        ("usb 1-1.2: reset full-speed USB device number 4 using dwc_otg", "resets of USB devices"),
        ("usb 1-1-port2: cannot reset port (err = -71)", "resets of USB devices"),
        ("usb 1-1-port2: over-current change #3", "too much current on USB"),
        ("usb 1-1: device descriptor read/64, error -71", "errors of USB transfers"),
        ("usb usb1-port1: disabled by hub (EMI?), re-enabling...", "errors of USB transfers"),
        ("hwmon hwmon1: Undervoltage detected!", "low voltage"),
        ("Under-voltage detected! (0x00050005)", "low voltage"),
        ("mmc0: Timeout waiting for hardware interrupt.", "errors of the SD card"),
        ("blk_update_request: I/O error, dev mmcblk0, sector 123", "errors of the SD card"),
        ("i2c-bcm2835 fe804000.i2c: i2c transfer timed out", "errors of I2C"),
        ("kvaser_pci 0000:00:06.0 can0: bus-off", "errors of CAN controllers"),  # recorded from the lab's kernel
        ("mcp251x spi0.0 can0: bus-off", "errors of CAN controllers"),
        ("ttyAMA0: 4 input overrun(s)", "overruns of serial ports"),
        ("oom-kill:constraint=CONSTRAINT_NONE,task=python3", "lack of memory"),
    ]:
        machine.prints("journalctl", QUIET + line + "\n")
        machine.tells(LOG, "warning", f"kernel log: 1 lines about {words}, the last: {line[:40]}")
    machine.prints("journalctl", QUIET)
    assert machine.told(LOG) == [("ok", "no fault of ports, buses, storage or voltage in 6 lines of the kernel log → ")]
    machine.prints("journalctl", QUIET * 3)
    ((_, text),) = machine.told(LOG)
    assert "3 lines about disconnected serial adapters" in text
    machine.prints("journalctl", "", 1, "No journal files were found.")
    machine.prints("dmesg", QUIET)
    assert machine.find(LOG)[0].severity == "ok"
    machine.prints("journalctl", "")
    machine.prints("dmesg", "", 1, "dmesg: read kernel buffer failed: Operation not permitted")
    machine.tells(LOG, "not checked", "Operation not permitted → run `sudo imud doctor`")
    machine.prints("journalctl", "usb 1-1: reset full-speed USB device\n" + "usb: fine\n" * 5000)
    machine.tells(LOG, "ok", "in 5000 lines")
    machine.prints("journalctl", line := "usb 1-1: reset full-speed USB device " + "x" * 120)
    assert machine.told(LOG)[0][1].partition(", the last: ")[2].partition(" → ")[0] == line[:120]
    machine.outputs.clear()
    machine.tells(LOG, "not checked", "cannot read the kernel log: journalctl: No such file", "join the group adm")
    machine.outputs["journalctl"] = PermissionError(13, "Permission denied", "journalctl")
    machine.tells(LOG, "not checked", "journalctl: Permission denied")
    machine.prints("dmesg --notime", "", 1, "dmesg: unknown option --notime")
    machine.prints("dmesg", QUIET)
    machine.tells(LOG, "ok", "in 6 lines of the kernel log")
