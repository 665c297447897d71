"""Checks of the kernel log. All lines except one are written by hand, from the sources of the drivers."""

from imud.cli.doctor.machine import kernel_log
from imud.cli.doctor.surroundings import DoctorCheck
from tests.support.surroundings import Machine

LOG = DoctorCheck("k", kernel_log)
QUIET = (
    "usb 1-1: new full-speed USB device number 4 using xhci_hcd\nhub 1-0:1.0: USB hub found\n"
    "ftdi_sio ttyUSB0: FTDI USB Serial Device converter now disconnected from ttyUSB0\n"
    "mmc0: new high speed SDHC card at address aaaa\ni2c_dev: i2c /dev entries driver\n"
    "can0: bitrate error 0.0%\n"
)


def test_each_kind_of_trouble_a_quiet_log_and_other_sources(machine: Machine) -> None:
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


def test_missing_programs_and_only_the_newest_lines(machine: Machine) -> None:
    machine.prints("journalctl", "usb 1-1: reset full-speed USB device\n" + "usb: fine\n" * 5000)
    machine.tells(LOG, "ok", "in 5000 lines")
    del machine.outputs["journalctl"]
    machine.tells(LOG, "not checked", "cannot read the kernel log: journalctl: No such file", "join the group adm")
    machine.outputs["journalctl"] = PermissionError(13, "Permission denied", "journalctl")
    machine.tells(LOG, "not checked", "journalctl: Permission denied")
    machine.prints("dmesg --notime", "", 1, "dmesg: unknown option --notime")
    machine.prints("dmesg", QUIET)
    machine.tells(LOG, "ok", "in 6 lines of the kernel log")
