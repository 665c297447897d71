"""Upgrade, downgrade, removal and purge of the package while the service runs."""

from pathlib import Path

from tests.lab_debian.guest.checks import Checks, expect, expect_in
from tests.lab_debian.guest.service import CAN, USB
from tests.lab_debian.guest.system import CONFIG, Host, must, pid, run, shown, start_service, wait_streaming

STATE = Path("/var/lib/imud")
KEPT = STATE / "kept"
"""File in place of the state of the daemon, which can exist or not."""
LIMIT_S = 900  # apt and dpkg under emulation
SETUP_LOCK = "/run/imud-setup.lock"
"""Lock of `imud setup`. The next boot removes it."""


def check(checks: Checks, _host: Host) -> None:
    CONFIG.write_text(f"# mine\n{USB}{CAN}")
    start_service()
    wait_streaming("usb")
    must("systemctl", "enable", "imud")  # earlier checks may have disabled the service
    KEPT.touch()
    with checks("an upgrade restarts the service and keeps configuration, state and enabled units"):
        before = pid()
        must("apt-get", "--quiet", "--yes", "install", "/run/lab/next.deb", limit_s=LIMIT_S)
        expect_in("lab1", must("dpkg-query", "--show", "imud-daemon"), "version")
        wait_streaming("usb")
        assert pid() != before, "expected a new process after the upgrade"
        assert CONFIG.read_text().startswith("# mine"), "expected the same configuration"
        assert KEPT.exists(), "expected the state of the daemon"
        expect("enabled", run("systemctl", "is-enabled", "imud").stdout.strip(), "enabled")
    with checks("an upgrade does not start a stopped service"):
        must("systemctl", "stop", "imud")
        must("apt-get", "--quiet", "--yes", "reinstall", "/run/lab/next.deb", limit_s=LIMIT_S)
        expect("active", run("systemctl", "is-active", "imud").stdout.strip(), "inactive")
        start_service()
    with checks("a downgrade to the former version keeps configuration and state"):
        options = ("--quiet", "--yes", "--allow-downgrades")
        must("apt-get", *options, "install", "/run/lab/imud.deb", limit_s=LIMIT_S)
        assert "lab1" not in must("dpkg-query", "--show", "imud-daemon"), "expected the former version"
        wait_streaming("usb")
        assert CONFIG.read_text().startswith("# mine"), "expected the same configuration"
        assert KEPT.exists(), "expected the state of the daemon"
    with checks("a removal stops the service and keeps configuration and state"):
        must("apt-get", "--quiet", "--yes", "remove", "imud-daemon", limit_s=LIMIT_S)
        expect("active", run("systemctl", "is-active", "imud").stdout.strip(), "inactive")
        assert not Path("/usr/lib/imud").exists(), "expected no files in /usr/lib/imud"
        assert CONFIG.exists(), "expected the configuration"
        assert KEPT.exists(), "expected the state of the daemon"
        assert not Path("/run/imud").exists(), "expected no runtime directory"
    with checks("a purge removes all except the users and groups"):
        must("apt-get", "--quiet", "--yes", "purge", "imud-daemon", limit_s=LIMIT_S)
        left = must(
            "find", "/etc", "/usr", "/var/lib", "/run", "/dev/shm", "-xdev", "-iname", "*imud*", "-not", "-path",
            "/run/lab/*",
        )  # fmt: skip
        expect("left", [line for line in left.splitlines() if "/var/lib/dpkg/" not in line and line != SETUP_LOCK], [])
        must("getent", "group", "imud")
    with checks("no unit has failed at the end"):
        expect("load state", shown("LoadState"), "not-found")
        expect("failed units", run("systemctl", "--failed", "--no-legend", "--plain").stdout.strip(), "")
