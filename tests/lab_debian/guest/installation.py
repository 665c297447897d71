"""The system is running, and the package installs as in README.md."""

import re
import time

from tests.lab_debian.guest.checks import Checks, Failed, expect
from tests.lab_debian.guest.system import CONFIG, EXAMPLE, NODE, SHARE, Host, must, run, shown, uptime_s

LEFT_OUT = re.compile(r"^missing +/usr/share/(doc|man)\b")
"""Files that dpkg of the guest does not unpack (image.py)."""


def check(checks: Checks, _host: Host) -> None:
    with checks("the system runs without a failed unit"):
        state = run("systemctl", "is-system-running", "--wait").stdout.strip()
        if state != "running":
            raise Failed(f"{state}: {run('systemctl', '--failed', '--no-legend', '--plain').stdout.strip()}")
    checks.figure("start of the kernel to a running system", uptime_s(), "s")
    with checks("apt installs the package"):
        start_s = time.monotonic()
        must("apt-get", "--quiet", "--yes", "install", "/run/lab/imud.deb", limit_s=900)
        checks.figure("installation", time.monotonic() - start_s, "s")
        EXAMPLE.write_bytes(CONFIG.read_bytes())
    with checks("the installed files match the package, and its modules are compiled"):
        changed = run("dpkg", "--verify", "imud-daemon").stdout.splitlines()
        expect("dpkg --verify", [line for line in changed if not LEFT_OUT.search(line)], [])
        must("sh", "-c", "find /usr/lib/imud/lib -name '*.pyc' | grep --quiet .")
    with checks("no service is started or enabled"):
        expect("active", run("systemctl", "is-active", "imud").stdout.strip(), "inactive")
        expect("enabled", run("systemctl", "is-enabled", "imud").stdout.strip(), "disabled")
        expect("load state", shown("LoadState"), "loaded")
    with checks("systemd accepts the unit without a warning"):
        said = run("systemd-analyze", "--man=no", "verify", "imud.service").stdout  # the guest has no man
        expect("systemd-analyze verify", [line for line in said.splitlines() if "imud" in line], [])
    with checks("the command and its manual page exist"):
        must("imud", "--version")
        must("test", "-s", "/usr/share/bash-completion/completions/imud")
        must("imud", "check", "/etc/imud.yaml")
    with checks("the USB adapter is an FTDI with a node of group dialout"):
        must("udevadm", "settle")
        expect("group", NODE.group(), "dialout")
        must("sh", "-c", "ls /dev/serial/by-id/usb-*")
    if not (SHARE / "imud.deb").exists():
        raise SystemExit("expected the package in the run's folder")
