"""Outputs and sources of imud in the confinement of the unit: metrics on another address, gpsd over TCP."""

import os
from pathlib import Path

from tests.lab_debian.guest import system
from tests.lab_debian.guest.checks import Checks, expect, expect_in, wait_until
from tests.lab_debian.guest.sandbox import PRIVATE, PUBLIC
from tests.lab_debian.guest.service import CAN, USB, metrics

METRICS_PORT = 9400
GPSD_PORT = 2947
NOTHING_YET = "has no sentences yet"
REALTIME = "[Service]\nCPUSchedulingPolicy=rr\nCPUSchedulingPriority=10\n"


def check(checks: Checks, _host: system.Host) -> None:
    with checks("metrics on all addresses and another port"):
        system.configure(f"metrics: {{address: 0.0.0.0, port: {METRICS_PORT}}}\n{USB}{CAN}")
        system.start_service()
        system.wait_streaming("usb")
        for address in (PUBLIC, PRIVATE):
            system.must("ip", "address", "replace", f"{address}/32", "dev", "lo")
        wait_until(lambda: metrics(f"http://{PRIVATE}:{METRICS_PORT}"), "metrics on another address")
    with checks("metrics are not served to a public address"):
        assert not metrics(f"http://{PUBLIC}:{METRICS_PORT}"), "they are"
    with checks("the daemon reaches a real gpsd over TCP"):
        # without a receiver; bookworm's gpsd ends if it has neither a receiver nor a control socket
        system.background("labgpsd", "/usr/sbin/gpsd", "-N", "-n", "-S", str(GPSD_PORT), "-F", "/run/labgpsd.sock")
        system.configure(USB.replace("115200}", "115200}\n    rmc: {source: gpsd}") + CAN)
        system.start_service()
        system.wait_streaming("usb")
        wait_until(lambda: NOTHING_YET in str((system.device("usb") or {}).get("utc")), "gpsd without a receiver")
        system.must("systemctl", "stop", "labgpsd")
        wait_until(lambda: NOTHING_YET not in str((system.device("usb") or {}).get("utc")), "the loss of gpsd")
    with checks("real-time scheduling with the drop-in of docs/operate.md"):
        folder = Path("/etc/systemd/system/imud.service.d")
        folder.mkdir()
        (folder / "realtime.conf").write_text(REALTIME)
        system.must("systemctl", "daemon-reload")
        system.configure(USB + CAN)
        system.start_service()
        system.wait_streaming("usb")
        expect("policy", os.sched_getscheduler(system.pid()), os.SCHED_RR)
        (folder / "realtime.conf").unlink()
        folder.rmdir()
        system.must("systemctl", "daemon-reload")
    system.start_service()
    system.wait_streaming("usb")
    expect_in("active", system.run("systemctl", "is-active", "imud").stdout, "service")
