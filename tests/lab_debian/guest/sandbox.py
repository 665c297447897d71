"""The confinement of the unit: the score of systemd, forbidden operations of the process, and nodes of all kinds.

The test tries each forbidden operation three times: as root without the settings of the unit, which must succeed,
because a refusal has no meaning otherwise; as the user of the service with the settings; and as root with the settings,
because file modes do not stop root.
"""

import json
import platform
import re
from pathlib import Path

from tests.lab_debian.guest import buses
from tests.lab_debian.guest.checks import Checks, Failed, expect, expect_in
from tests.lab_debian.guest.system import Host, confined, confinement, must, pid

SCORE_MAX = 2.0
"""Maximum score. 0.4 of it is due to adjtimex, which reports whether the clock is synchronised (docs/operate.md)."""
PUBLIC, PRIVATE = "192.0.2.1", "10.9.8.7"
"""Additional addresses of the guest. The first is from TEST-NET-1 (RFC 5737), outside of every private network."""
INIT_MODULE = {"x86_64": 175, "aarch64": 105}[platform.machine()]
FORBIDDEN = {
    "write to /usr": "open('/usr/probe', 'w')",
    "write to /etc": "open('/etc/probe', 'w')",
    "read a home": "import os; os.listdir('/root')",
    "see other users' processes": "import os; assert os.path.exists('/proc/1/cmdline')",
    "read the kernel's log": "open('/dev/kmsg')",
    "open a disk": "import os; os.open('/dev/vda', os.O_RDONLY)",
    "open memory": "import os; os.open('/dev/mem', os.O_RDONLY)",
    "set the clock": "import time; time.clock_settime(time.CLOCK_REALTIME, time.time())",
    "steer the clock": (
        "import ctypes; b = ctypes.create_string_buffer(512); b[0] = 2; assert ctypes.CDLL(None).adjtimex(b) >= 0"
    ),
    "send a packet to a public network": f"import socket; socket.socket(2, 2).sendto(b'', ('{PUBLIC}', 9))",
    "make a namespace": "import ctypes; l = ctypes.CDLL(None, use_errno=True); assert not l.unshare(0x10000000)",
    "map memory that is written and executed": "import mmap; mmap.mmap(-1, 4096, prot=7)",
    "open a packet socket": "import socket; socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)",
    "load a module": (
        "import ctypes, errno; l = ctypes.CDLL(None, use_errno=True); "
        f"l.syscall({INIT_MODULE}, 0, 0, 0); assert ctypes.get_errno() != errno.EPERM"  # if permitted: ENOEXEC
    ),
    "make a node": "import os, stat; os.mknod('/dev/shm/n', stat.S_IFCHR | 0o600, os.makedev(1, 3))",
    "make a set-uid file": "import os; open('/dev/shm/s', 'w'); os.chmod('/dev/shm/s', 0o4755)",
}
"""Forbidden operations of the confined user, as Python code that raises an exception if the kernel refuses the
operation."""
LEFT = ("/usr/probe", "/etc/probe", "/dev/shm/n", "/dev/shm/s")
FREE_FOR_ROOT = {"see other users' processes"}
"""Operations that ProtectProc= does not forbid for root: hidepid= of /proc exempts the group root (proc(5), `gid=`)."""
NOT_FOR_ROOT = "StateDirectory"
"""Prefix of the settings with which systemd would give the daemon's state to root."""
NEEDED = {
    "ask the kernel for the clock's state": (
        "import ctypes; b = ctypes.create_string_buffer(512); assert ctypes.CDLL(None).adjtimex(b) >= 0"
    ),
    "give its files to the group that may read": (
        "import os; f = '/var/lib/imud/probe'; open(f, 'w').close(); os.chown(f, -1, os.getgid()); os.unlink(f)"
    ),
    "send a packet to a private network": f"import socket; socket.socket(2, 2).sendto(b'', ('{PRIVATE}', 9))",
    "read the start time of the host, for the metrics of the process": "open('/proc/stat').read()",
}
"""Necessary operations of imud except for opening devices. A setting that breaks one of them would show late or
never."""
TRY_ALL = """
import json, os
said = {}
for name, code in SNIPPETS.items():
    ours, theirs = os.pipe()
    if (child := os.fork()) == 0:
        why = ''
        try:
            exec(code, {})
        except BaseException as error:
            why = f'{type(error).__name__}: {error}'
        os.write(theirs, why.encode())
        os._exit(0)
    os.close(theirs)
    said[name] = open(ours).read()
    ended = os.waitpid(child, 0)[1]
    if ended:
        said[name] = f'Error: ended with {ended}'
print(json.dumps(said), flush=True)
"""
OPEN = """
import errno, os
try:
    os.close(os.open('{node}', os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY))
except OSError as error:
    if error.errno != errno.EBUSY:  # allowed, and the daemon has it for itself
        raise
"""


def check(checks: Checks, _host: Host) -> None:
    with checks(f"systemd-analyze security gives at most {SCORE_MAX}"):
        said = must("systemd-analyze", "security", "--no-pager", "imud.service")
        found = re.search(r"Overall exposure level for imud\.service: ([\d.]+)", said)
        if found is None:
            raise Failed(said)
        checks.figure("exposure (systemd-analyze security)", float(found[1]), "of 10")
        open_points = [line for line in said.splitlines() if line.startswith("✗")]
        print("\n".join(f"       {line[:110]}" for line in open_points), flush=True)
        assert float(found[1]) <= SCORE_MAX, f"score {found[1]}"
    with checks("the process has no capability, a system call filter and no new privileges"):
        status = Path(f"/proc/{pid()}/status").read_text()
        for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"):
            expect(name, re.search(rf"{name}:\t(\w+)", status)[1], "0" * 16)  # type: ignore[index]
        expect_in("Seccomp:\t2", status, "status")
        expect_in("NoNewPrivs:\t1", status, "status")
    for address in (PUBLIC, PRIVATE):
        must("ip", "address", "replace", f"{address}/32", "dev", "lo")
    settings = confinement()
    buses.make_nodes()
    nodes = {node: OPEN.format(node=node) for node in present_nodes(checks)}
    able = tried(FORBIDDEN, [], user="root")
    results = tried({**FORBIDDEN, **NEEDED, **nodes}, settings)
    of_root = tried(FORBIDDEN, [one for one in settings if not one.startswith(NOT_FOR_ROOT)], user="root")
    judge(checks, able, results, of_root)
    for name in NEEDED:
        with checks(f"with the settings of the unit, a program may {name}"):
            expect("result", results[name], "")
    for node in nodes:
        with checks(f"with the settings of the unit, {node} can be opened"):
            expect("result", results[node], "")


def judge(checks: Checks, able: dict[str, str], results: dict[str, str], of_root: dict[str, str]) -> None:
    """Add a check for each row of FORBIDDEN, from the exceptions without settings, of the user, and of root."""
    for name in FORBIDDEN:
        with checks(f"with the settings of the unit, a program may not {name}; root may without them"):
            expect("result of root without the unit's settings", able[name], "")
            refused("the service's user", results[name])
            if name not in FREE_FOR_ROOT:
                refused("root with the unit's settings", of_root[name])


def refused(who: str, result: str) -> None:
    if "Error" not in result:
        raise Failed(f"{who}: expected an error, got {result or 'success'}")


def present_nodes(checks: Checks) -> list[str]:
    """Return one node of each required kind. Add a failed check for each kind without a node."""
    found = []
    for pattern in buses.NODES[platform.machine()]:
        nodes = sorted(str(path) for path in Path("/dev").glob(pattern))
        if not nodes:
            with checks(f"/dev/{pattern} exists"):
                raise Failed("expected such a node; is its driver loaded (README.md, What the guest has)?")
        found += nodes[:1]
    return found


def tried(snippets: dict[str, str], settings: list[str], user: str = "imud") -> dict[str, str]:
    """Run each piece of Python in its own process under the settings. Return its exception; empty if it succeeded.

    The function removes all traces of a piece.
    """
    try:
        said = confined(f"SNIPPETS = {snippets!r}\n{TRY_ALL}", *settings, user=user)
    finally:
        for path in LEFT:
            Path(path).unlink(missing_ok=True)
    for line in said.splitlines():
        if line.startswith("{"):
            found: dict[str, str] = json.loads(line)
            return found
    raise Failed(said or "expected a result of the confined program, got none")
