"""`imud doctor` on a correct system and on a system with faults; `imud setup --yes` from an empty system to samples."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from tests.lab_debian.guest import system
from tests.lab_debian.guest.checks import Checks, Failed, expect, expect_in, wait_until
from tests.lab_debian.guest.service import CAN, USB

ERROR = 2
STATUS = {"warning": 1, "error": ERROR}
HOLDER = "imud-lab-holder.service"
HOLD_PORT = f"import serial, time; port = serial.Serial('{system.NODE}', exclusive=True); time.sleep(3600)"
DROP_IN = Path("/run/systemd/system/imud.service.d/90-lab.conf")
OPERATOR = "skipper"
SETUP = ("env", f"SUDO_USER={OPERATOR}", "imud", "setup")
RULES = Path("/etc/udev/rules.d/61-imud-setup.rules")
JOURNAL = Path("/var/lib/imud-setup/journal.json")
MODEM_MANAGER = Path("/etc/systemd/system/ModemManager.service")
LATENCY_MS = 1
"""Latency timer that the udev rules set, ms. Without the rules: 16 for an FTDI chip, 0 for the adapter of QEMU."""


class AdapterNow(NamedTuple):
    latency_ms: int
    """Latency timer, ms (`latency_timer` of ftdi_sio)."""
    ignored: bool
    """Whether ModemManager ignores the adapter (`ID_MM_DEVICE_IGNORE`)."""


def check_doctor(checks: Checks, host: system.Host) -> None:
    """Check with a running daemon, with an unplugged adapter, and without a daemon."""
    system.ensure_running(USB + CAN)
    system.wait_streaming("can")
    with checks("imud doctor reports no error in normal operation"):
        # on a busy host, a simulator can stop for a second, which is an error during this time
        wait_until(lambda: not errors(), "no error of imud doctor")
    with checks("imud doctor reports a missing adapter"):
        host.unplug()
        wait_until(lambda: (system.device("usb") or {}).get("state") == "missing", "the device is missing")
        result = system.run("imud", "doctor")
        expect("exit status", result.returncode, ERROR)
        expect_in("/dev/ttyUSB0", result.stdout, "doctor")
        host.plug()
        system.wait_streaming("usb")
    with checks("imud doctor reports that the service does not run"):
        system.must("systemctl", "stop", system.UNIT)
        result = system.run("imud", "doctor")
        expect("exit status", result.returncode, ERROR)
        expect_in("systemctl", result.stdout, "doctor")
        system.start_service()
        system.wait_streaming("usb")


def check_complaints(checks: Checks, _host: system.Host) -> None:
    system.ensure_running(USB + CAN)
    with checks("imud doctor names the program that uses the port, and the daemon uses the port afterwards"):
        system.must("systemctl", "stop", system.UNIT)
        system.background(HOLDER, system.PYTHON, "-c", HOLD_PORT)
        wait_until(lambda: f"{system.NODE}" in open_files(), "another program has the port")
        system.start_service()
        wait_until(lambda: "in use by" in (system.device("usb") or {}).get("problem", ""), "the port is in use")
        expect_finding("ports taken", "error", f"{system.NODE} is open in another program", "stop the program")
        system.must("systemctl", "stop", HOLDER)
        system.wait_streaming("usb")
    with checks("imud doctor reports a user without the port's group, and its advice gives access"):
        system.must("gpasswd", "--delete", "imud", "dialout")
        system.start_service()
        wait_until(lambda: "cannot open" in (system.device("usb") or {}).get("problem", ""), "the port is refused")
        command = "usermod --append --groups dialout imud"
        expect_finding("rights", "error", f"user imud cannot open {system.NODE}", f"`sudo {command}`")
        system.must(*command.split())
        system.start_service()
        system.wait_streaming("usb")
    with checks("imud doctor reports a unit that does not allow the port, and its advice gives access"), drop_in():
        allow("char-pts rw")
        wait_until(lambda: "EPERM" in (system.device("usb") or {}).get("problem", ""), "the port is refused")
        entry = "char-ttyUSB rw"
        expect_finding(
            "rules of the unit", "error", f"DeviceAllow= of imud.service does not allow {system.NODE}", entry
        )
        allow("char-pts rw", entry)
        system.wait_streaming("usb")
    with checks("imud doctor warns of a service that is not enabled"):
        system.must("systemctl", "disable", system.UNIT)
        try:
            expect_finding("service", "warning", "systemd does not start imud at boot", "`sudo systemctl enable imud`")
        finally:
            system.must("systemctl", "enable", system.UNIT)


def open_files() -> list[str]:
    holder = int(system.shown("MainPID", HOLDER))
    found: list[str] = []
    with suppress(FileNotFoundError):  # the descriptor was closed, or its process ended
        found.extend(os.readlink(one) for one in Path(f"/proc/{holder}/fd").iterdir())
    return found


@contextmanager
def drop_in() -> Iterator[None]:
    """Allow additional settings of the unit (`allow`) during the block. The next start is without them."""
    try:
        yield
    finally:
        shutil.rmtree(DROP_IN.parent, ignore_errors=True)
        system.must("systemctl", "daemon-reload")


def allow(*entries: str) -> None:
    DROP_IN.parent.mkdir(parents=True, exist_ok=True)
    DROP_IN.write_text("[Service]\nDeviceAllow=\n" + "".join(f"DeviceAllow={entry}\n" for entry in entries))
    system.must("systemctl", "daemon-reload")
    system.start_service()


def expect_finding(check: str, severity: str, seen: str, advice: str) -> None:
    """Raise Failed unless `imud doctor` reports this finding with the matching exit status."""
    result = system.run("imud", "doctor", "--json")
    examined = json.loads(result.stdout)
    found = [one for each in examined["checks"] if each["name"] == check for one in each["findings"]]
    fitting = [one for one in found if one["severity"] == severity and seen in one["seen"] and advice in one["advice"]]
    if not fitting:
        raise Failed(f"{check}: expected {severity} {seen!r} with {advice!r}, got {found}")
    assert result.returncode >= STATUS[severity], f"exit status {result.returncode} with {fitting}"


def errors() -> list[dict[str, str]]:
    """Return the errors of `imud doctor --json`, and print them, so that the log of a run contains passing errors."""
    examined = json.loads(system.run("imud", "doctor", "--json").stdout)
    found = [one for check in examined["checks"] for one in check["findings"] if one["severity"] == "error"]
    for one in found:
        print(f"       {one['seen']}", flush=True)
    return found


def check_setup(checks: Checks, host: system.Host) -> None:
    """Check `imud setup --yes` up to the first samples, and `--undo`, on a system with ModemManager."""
    system.must("systemctl", "disable", "--now", system.UNIT)
    system.CONFIG.write_bytes(system.EXAMPLE.read_bytes())
    system.add_user(OPERATOR)
    with modem_manager():
        before = replugged(host)
        with checks("imud setup --yes ends with an enabled service and samples of the connected device"):
            said = system.must(*SETUP, "--yes", limit_s=900)
            expect("enabled", system.run("systemctl", "is-enabled", system.UNIT).stdout.strip(), "enabled")
            expect("active", system.shown("ActiveState"), "active")
            expect_in("/dev/serial/by-id/", system.CONFIG.read_text(), f"configuration after: {said}")
            for found in system.ask("status")["devices"]:
                system.wait_streaming(found["name"])
        check_made(checks, host, before)
        with checks("imud setup --undo removes configuration, service, rules, group and journal"):
            system.must(*SETUP, "--undo", "--yes", limit_s=900)
            expect("enabled", system.run("systemctl", "is-enabled", system.UNIT).stdout.strip(), "disabled")
            assert system.CONFIG.read_bytes() == system.EXAMPLE.read_bytes(), (
                "expected the configuration before imud setup"
            )
            left = [
                path
                for path in (RULES, JOURNAL, *system.CONFIG.parent.glob(f"{system.CONFIG.name}.*"))
                if path.exists()
            ]
            expect("remaining files of imud setup", left, [])
            expect("groups of the user that runs sudo", groups(), {OPERATOR})
            expect("the adapter after it was plugged in again", replugged(host), before)
    system.configure(USB + CAN)
    system.must("systemctl", "enable", system.UNIT)
    system.start_service()
    system.wait_streaming("usb")


def check_made(checks: Checks, host: system.Host, before: AdapterNow) -> None:
    """Check the changes of `imud setup` except for configuration and service. `before` is the adapter without the
    rules."""
    with checks("the user that runs sudo may read samples after imud setup"):
        expect("groups", groups(), {OPERATOR, "imud"})
    with checks("after imud setup, udev hides the adapter from ModemManager and sets its latency timer"):
        expect("ignored without the rules", before.ignored, False)
        assert before.latency_ms != LATENCY_MS, f"the latency timer is {LATENCY_MS} ms without the rules"
        expect("as it is", adapter().ignored, True)
        # a request of the daemon for low latency makes the driver report 1 for any value of udev
        system.must("systemctl", "stop", system.UNIT)
        try:
            expect("plugged in again", replugged(host), AdapterNow(LATENCY_MS, ignored=True))
        finally:
            system.start_service()
    with checks("the journal of imud setup exists, only for root"):
        expect("mode", JOURNAL.stat().st_mode & 0o777, 0o600)


@contextmanager
def modem_manager() -> Iterator[None]:
    """Run a service with this name during the block: Debian in the guest does not contain it."""
    MODEM_MANAGER.write_text("[Service]\nExecStart=/bin/sleep infinity\n")
    system.must("systemctl", "daemon-reload")
    system.must("systemctl", "start", MODEM_MANAGER.name)
    try:
        yield
    finally:
        system.run("systemctl", "stop", MODEM_MANAGER.name)
        MODEM_MANAGER.unlink()
        system.must("systemctl", "daemon-reload")


def replugged(host: system.Host) -> AdapterNow:
    host.unplug()
    wait_until(lambda: not system.NODE.exists(), f"{system.NODE} is gone")
    host.plug()
    wait_until(system.NODE.exists, f"{system.NODE} is there")
    system.must(
        "udevadm", "wait", "--timeout=60", str(system.NODE)
    )  # the event of the port, after the event of the driver
    system.must("udevadm", "settle")
    return adapter()


def adapter() -> AdapterNow:
    """Return latency timer and ModemManager's property of the adapter, from the kernel and from udev's database."""
    latency = Path(f"/sys/bus/usb-serial/devices/{system.NODE.name}/latency_timer").read_text()
    return AdapterNow(
        int(latency), "ID_MM_DEVICE_IGNORE=1" in properties(system.must("udevadm", "info", str(system.NODE)))
    )


def properties(text: str) -> list[str]:
    return [line.removeprefix("E: ") for line in text.splitlines() if line.startswith("E: ")]


def groups() -> set[str]:
    return set(system.must("id", "-nG", OPERATOR).split())
