"""`imud doctor` on a system that is in order and on one that is not; `imud setup --yes` from nothing to samples."""

import json

from tests.lab_debian.guest.checks import Checks, expect, expect_in, wait_until
from tests.lab_debian.guest.service import CAN, USB
from tests.lab_debian.guest.system import (
    CONFIG,
    EXAMPLE,
    UNIT,
    Host,
    ask,
    configure,
    device,
    must,
    run,
    shown,
    start_service,
    wait_streaming,
)

ERROR = 2


def check_doctor(checks: Checks, host: Host) -> None:
    """Daemon up, adapter pulled, daemon down."""
    configure(USB + CAN)
    start_service()
    wait_streaming("usb")
    wait_streaming("can")
    with checks("imud doctor finds no error while everything runs"):
        # on a busy host a simulator stands still for a second, which is an error while it lasts
        wait_until(lambda: not errors(), "no error of imud doctor")
    with checks("imud doctor tells that the adapter is gone"):
        host.unplug()
        wait_until(lambda: (device("usb") or {}).get("state") == "missing", "the device is missing")
        result = run("imud", "doctor")
        expect("exit status", result.returncode, ERROR)
        expect_in("/dev/ttyUSB0", result.stdout, "doctor")
        host.plug()
        wait_streaming("usb")
    with checks("imud doctor tells that the service does not run"):
        must("systemctl", "stop", UNIT)
        result = run("imud", "doctor")
        expect("exit status", result.returncode, ERROR)
        expect_in("systemctl", result.stdout, "doctor")
        start_service()
        wait_streaming("usb")


def errors() -> list[dict[str, str]]:
    """The errors that `imud doctor --json` finds, printed so that a run shows those that pass."""
    examined = json.loads(run("imud", "doctor", "--json").stdout)
    found = [one for check in examined["checks"] for one in check["findings"] if one["severity"] == "error"]
    for one in found:
        print(f"       {one['seen']}", flush=True)
    return found


def check_setup(checks: Checks, _host: Host) -> None:
    """`imud setup --yes` from the package's example to samples, and `--undo`."""
    must("systemctl", "disable", "--now", UNIT)
    CONFIG.write_bytes(EXAMPLE.read_bytes())
    with checks("imud setup --yes ends with a service that is enabled and has samples of what is attached"):
        said = must("imud", "setup", "--yes", limit_s=900)
        expect("enabled", run("systemctl", "is-enabled", UNIT).stdout.strip(), "enabled")
        expect("active", shown("ActiveState"), "active")
        expect_in("/dev/serial/by-id/", CONFIG.read_text(), f"configuration after: {said}")
        for found in ask("status")["devices"]:
            wait_streaming(found["name"])
    with checks("imud setup --undo takes it back"):
        must("imud", "setup", "--undo", "--yes", limit_s=900)
        expect("enabled", run("systemctl", "is-enabled", UNIT).stdout.strip(), "disabled")
        assert CONFIG.read_bytes() == EXAMPLE.read_bytes(), "the configuration is not the one before"
    configure(USB + CAN)
    must("systemctl", "enable", UNIT)
    start_service()
    wait_streaming("usb")
