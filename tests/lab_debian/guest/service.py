"""The service: start, watchdog, reload, kill, and a configuration that cannot be used."""

import os
import signal
import time
from pathlib import Path

from tests.lab_debian.guest.checks import Checks, expect, expect_in, wait_until
from tests.lab_debian.guest.system import (
    PYTHON,
    RINGS,
    UNIT,
    Host,
    ask,
    background,
    configure,
    console,
    device,
    journal,
    mark,
    must,
    pid,
    run,
    shown,
    start_service,
    wait_streaming,
)

USB = """\
devices:
  usb:
    driver: hipnuc-uart
    uart: {port: /dev/ttyUSB0, baud: 115200}
"""
CAN = """\
  can:
    driver: hipnuc-canopen
    options: {node: 8}
    socketcan: {interface: vcan0}
"""
CAN_RATE_HZ = 20
NOTIFY_RELOAD_SINCE = 253
"""Version of systemd with Type=notify-reload. trixie has 257, bookworm 252."""
START_LIMIT_S = 400
"""Time limit, s, above TimeoutStartSec=, so that the limit of systemd acts first."""


def check(checks: Checks, host: Host) -> None:
    check_streaming(checks, host)
    check_reload(checks)
    check_ends(checks)
    check_refused_starts(checks)


def check_reload(checks: Checks) -> None:
    with checks("systemctl waits for a reload if systemd supports it"):
        waits = int(must("systemctl", "--version").split()[1]) >= NOTIFY_RELOAD_SINCE
        expect("type", shown("Type"), "notify-reload" if waits else "notify")
        if waits:
            configure(USB)
            must("systemctl", "reload", UNIT)
            expect("the removed device, immediately after the reload", device("can"), None)
            configure(USB + CAN)
            must("systemctl", "reload", UNIT)
            assert device("can"), "expected the added device immediately after the reload"
            wait_streaming("can")
    with checks("a reload keeps the process and the unchanged devices"):
        before, seq = pid(), newest("usb")
        configure(USB)
        must("systemctl", "reload", UNIT)
        wait_until(lambda: device("can") is None, "the removal of the device")
        expect("process", pid(), before)
        assert newest("usb") >= seq, "expected no restart of the unchanged device"
        configure(USB + CAN)
        must("systemctl", "reload", UNIT)
        wait_streaming("can")
    with checks("a reload of an invalid file changes nothing and is in the log"):
        before, since = pid(), mark()
        configure(USB.replace("baud:", "bauds:") + CAN)
        run("systemctl", "reload", UNIT)
        wait_until(lambda: "bauds" in journal(since), "the error in the log")
        expect("process", pid(), before)
        expect("active", shown("ActiveState"), "active")
        wait_streaming("usb")
        configure(USB + CAN)
        must("systemctl", "reload", UNIT)


def check_ends(checks: Checks) -> None:
    with checks("the watchdog kills a hung daemon, and systemd restarts it"):
        before, restarts, said = pid(), int(shown("NRestarts")), len(console())
        os.kill(before, signal.SIGSTOP)
        start_s = time.monotonic()
        wait_until(lambda: int(shown("NRestarts")) > restarts, "another start")
        wait_until(lambda: pid() not in (0, before), "another process")
        checks.figure("SIGSTOP to another process", time.monotonic() - start_s, "s")
        wait_until(lambda: "Failed with result 'watchdog'" in console()[said:], "the watchdog as the reason")
        wait_streaming("usb")
        wait_streaming("can")
    with checks("systemd restarts a killed daemon, with its rings"):
        before = pid()
        run("systemctl", "kill", "--signal", "SIGKILL", UNIT)
        start_s = time.monotonic()
        wait_until(lambda: pid() not in (0, before), "another process")
        wait_streaming("usb")
        checks.figure("SIGKILL to samples again", time.monotonic() - start_s, "s")
        expect("rings", sorted(path.name for path in RINGS.iterdir()), ["imud.can", "imud.usb"])
    with checks("a stop removes rings and socket"):
        must("systemctl", "stop", UNIT)
        expect("result", shown("Result"), "success")
        assert not Path("/run/imud").exists(), "expected no runtime directory"


def check_refused_starts(checks: Checks) -> None:
    """Starts that must fail once, and starts that must not fail."""
    with checks("an invalid configuration causes no restart"):
        configure("devices: {}: {}\n")
        assert run("systemctl", "start", UNIT, limit_s=START_LIMIT_S).returncode, "it started"
        time.sleep(2 * 2.5)  # more than RestartSec=, 2 s
        expect("state", shown("ActiveState"), "failed")
        expect("exit status", shown("ExecMainStatus"), "78")
        expect("restarts", shown("NRestarts"), "0")
    with checks("a used metrics port does not end the service"):
        background("busyport", "/usr/bin/python3", "-c", BUSY_PORT)
        wait_until(lambda: "9321" in run("ss", "--listening", "--tcp", "--numeric").stdout, "a listener on the port")
        configure(USB + CAN)
        start_service()
        wait_streaming("usb")
        must("systemctl", "stop", "busyport")
        wait_until(metrics, "metrics after the port is free")


BUSY_PORT = """
import signal, socket
listener = socket.create_server(("127.0.0.1", 9321))
signal.pause()
"""


def check_streaming(checks: Checks, _host: Host) -> None:
    """Check a start with a sensor on USB and a sensor on CAN, until every output contains samples."""
    with checks("a virtual CAN bus with a simulated device"):
        must("modprobe", "vcan")
        if run("ip", "link", "show", "vcan0").returncode:
            must("ip", "link", "add", "dev", "vcan0", "type", "vcan")
            must("ip", "link", "set", "vcan0", "up")
        command = (
            f"sleep infinity | {PYTHON} -m imud.sim --device hipnuc-canopen --rate {CAN_RATE_HZ} --interface vcan0"
        )
        background("simcan", "sh", "-c", command)
    with checks("the service starts and is READY"):
        configure(USB + CAN)
        start_s = time.monotonic()
        must("systemctl", "enable", "--now", UNIT, limit_s=START_LIMIT_S)
        checks.figure("start to READY", time.monotonic() - start_s, "s")
        expect("active", shown("ActiveState"), "active")
    with checks("both sensors stream"):
        start_s = time.monotonic()
        usb = wait_streaming("usb")
        checks.figure("READY to samples", time.monotonic() - start_s, "s")
        wait_streaming("can")
        wait_until(lambda: (device("usb") or usb)["identity"].get("product"), "the product of the device on USB")
    with checks("systemctl status shows the number of running devices"):
        wait_until(lambda: shown("StatusText") == "All 2 devices are OK.", f"two: {shown('StatusText')}")
    with checks("rings, socket and metrics contain the samples"):
        must(PYTHON, "-c", "from imud.client import Ring\nwith Ring('usb') as ring: assert ring.latest() is not None")
        must("sh", "-c", "imud devices | grep --quiet 'usb.* ok'")
        wait_until(metrics, "metrics")
    with checks("the log has priorities and starts with the version"):
        said = must("journalctl", "--no-pager", "--output", "cat", "--unit", UNIT, "--priority", "info..info")
        expect_in("has started", said, "log")
        expect("lines with a priority in their text", [line for line in journal().splitlines() if line[:1] == "<"], [])


def newest(name: str) -> int:
    return int(ask("poll", devices=[name])["samples"][0]["seq"])


def metrics(where: str = "http://127.0.0.1:9321") -> bool:
    code = f"import urllib.request; print(urllib.request.urlopen('{where}/metrics', timeout=20).read().decode())"
    return 'imud_samples_total{device="usb"' in run("/usr/bin/python3", "-c", code).stdout
