"""Console logs and what they mean. The lines are as kernel 6.12 prints them."""

import pytest

from tests.lab.host.diagnosis import cause, last_line, out_of_memory

PANIC = (
    "[    9.1] sysrq: Trigger a crash\n[    9.2] Kernel panic - not syncing: sysrq triggered crash\n[    9.3] CPU: 0\n"
)
OOPS = "[ 3.0] BUG: kernel NULL pointer dereference, address: 0\n[ 3.1] Kernel panic - not syncing: Fatal exception\n"
KILLED = "[   20.5][  T91] Out of memory: Killed process 91 (python) total-vm:900kB\n[ 21.0] sysrq: Resetting\n"
OF_A_CGROUP = (
    "[ 4.0] Memory cgroup out of memory: Killed process 7 (python)\n[ 4.1] Out of memory and no killable processes...\n"
)
DEADLOCK = KILLED + "[ 22.0] Kernel panic - not syncing: System is deadlocked on memory\n"


@pytest.mark.parametrize(
    ("console", "expected"),
    [
        (PANIC, "kernel panic in the guest: Kernel panic - not syncing: sysrq triggered crash"),
        (OOPS, "kernel fault in the guest: BUG: kernel NULL pointer dereference, address: 0"),
        (KILLED, "guest out of memory: Out of memory: Killed process 91 (python) total-vm:900kB"),
        (DEADLOCK, "guest out of memory: Kernel panic - not syncing: System is deadlocked on memory"),
        (
            "Kernel panic - not syncing: VFS: Unable to mount root fs on unknown-block(0,0)\r\n",
            "guest could not mount the host's root over 9p:"
            " Kernel panic - not syncing: VFS: Unable to mount root fs on unknown-block(0,0)",
        ),
        ("[ 1.0] Run /init as init process\n", None),
        (OF_A_CGROUP, None),
        ("", None),
    ],
)
def test_cause(console: str, expected: str | None) -> None:
    assert cause(console) == expected


def test_memory_kill_is_recognised() -> None:
    assert out_of_memory(KILLED)
    assert not out_of_memory(PANIC)


def test_last_line() -> None:
    assert last_line("[ 1.0] one\n[    2.8] two\x07\n\n") == "two"
    assert last_line("") == "nothing on the console"
    assert len(last_line("x" * 500)) == 160
