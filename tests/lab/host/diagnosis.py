"""Search the console log of a guest without a result for known causes."""

import re

CAUSES = (
    (r"Kernel panic - not syncing: System is deadlocked on memory", "guest out of memory"),
    (r"VFS: Unable to mount root fs|Cannot open root device", "guest could not mount the host's root over 9p"),
    (r"Requested init .* failed|No working init found", "guest could not start its init"),
    (r"Out of memory: Killed process", "guest out of memory"),
    (r"soft lockup|rcu_preempt detected stalls|blocked for more than", "guest kernel stuck"),
    (r"BUG: |Oops: |general protection fault", "kernel fault in the guest"),
    (r"Kernel panic", "kernel panic in the guest"),
    (r"lab init failed", "guest set-up failed"),
)
"""Patterns of console lines with their meaning, the most significant pattern first."""

KILLED = re.compile(r"Out of memory: Killed process")


def cause(console: str) -> str | None:
    for pattern, meaning in CAUSES:
        line = next((line for line in console.splitlines() if re.search(pattern, line)), None)
        if line is not None:
            return f"{meaning}: {_bare(line)}"
    return None


def out_of_memory(console: str) -> bool:
    """Return whether the guest's kernel killed a process because memory was full."""
    return KILLED.search(console) is not None


def last_line(console: str) -> str:
    lines = [line for line in console.splitlines() if line.strip()]
    return _bare(lines[-1]) if lines else "no output on the console"


def _bare(line: str) -> str:
    """Return a console line without time stamp and control characters, at most 160 characters."""
    plain = re.sub(r"^\[ *[\d.]+\](\[[^]]*\])? *", "", line.strip())
    return "".join(character for character in plain if character.isprintable())[:160]
