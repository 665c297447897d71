"""Permissions: users who may read, users who may change settings, and users without permissions."""

from tests.lab_debian.guest.checks import Checks, expect, expect_in
from tests.lab_debian.guest.system import PYTHON, RINGS, SOCKET, Host, add_user, must, run, wait_streaming

READ_RING = "from imud.client import Ring\nwith Ring('usb') as ring: print(ring.latest().seq > 0)"
RATE_HZ = 10
"""Rate of the device on USB, Hz. At 100 Hz, the adapter of QEMU, which stores 384 bytes, would lose replies of the
device at each stall of the host of 40 ms."""
WRITE_RING = f"open('{RINGS}/imud.usb', 'r+b')"


def check(checks: Checks, _host: Host) -> None:
    """Check members of imud, members of imud-control, the daemon's user, and other users."""
    add_user("reader", "imud")
    add_user("chief", "imud", "imud-control")
    add_user("stranger")
    wait_streaming("usb")
    with checks("a member of imud reads the socket and the ring"):
        must("runuser", "-u", "reader", "--", "imud", "devices")
        expect("ring", run(PYTHON, "-c", READ_RING, user="reader").stdout.strip(), "True")
    with checks("a member of imud cannot change settings"):
        refused = run("imud", "settings", "usb", "--set", f"output.hi91={RATE_HZ}", user="reader")
        assert refused.returncode, "expected an error for the change"
        expect_in("imud-control", refused.stdout, "refusal")
        expect_in("Permission denied", run(PYTHON, "-c", WRITE_RING, user="reader").stdout, "writing to a ring")
    with checks("a member of imud-control changes a device"):
        must("runuser", "-u", "chief", "--", "imud", "settings", "usb", "--yes", "--set", f"output.hi91={RATE_HZ}")
    with checks("another user can read neither socket nor ring, and receives the reason"):
        refused = run("imud", "devices", user="stranger")
        assert refused.returncode, "expected an error for another user"
        expect_in("imud", refused.stdout, "refusal")
        assert run(PYTHON, "-c", READ_RING, user="stranger").returncode, "another user reads the ring"
    with checks("only imud creates files next to socket and rings"):
        for user in ("reader", "chief", "stranger"):
            for folder in (SOCKET.rpartition("/")[0], str(RINGS), "/var/lib/imud"):
                assert run("touch", f"{folder}/mine", user=user).returncode, f"{user} creates a file in {folder}"
    with checks("the daemon may not become another user or root"):
        expect_in("NoNewPrivs:\t1", must("sh", "-c", "cat /proc/$(systemctl show -P MainPID imud)/status"), "status")
