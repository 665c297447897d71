"""System interfaces that the daemon and its tests use are in the lab's kernel."""

import ctypes
import mmap
import os
import platform
import select
import signal
import socket
from pathlib import Path

from tests.lab.tool import tool

LIBC = ctypes.CDLL(None, use_errno=True)
IN_CREATE = 0x100


def test_kernel_is_the_built_one() -> None:
    assert platform.release().startswith("6.12.")
    assert Path("/sys/module/imud_lab").is_dir()


def test_root_is_read_only_and_memory_is_writable() -> None:
    assert os.statvfs("/").f_flag & os.ST_RDONLY
    for folder in ("/tmp", "/run", "/var/tmp", "/dev/shm"):
        probe = Path(folder) / "probe"
        probe.write_bytes(b"x")
        probe.unlink()


def test_shared_memory_posix_sysv_and_anonymous() -> None:
    block = Path("/dev/shm/imud-lab-probe")  # what shm_open("/imud-lab-probe") opens
    block.write_bytes(bytes(4096))
    with block.open("r+b") as file, mmap.mmap(file.fileno(), 4096) as view:
        view[:4] = b"imud"
    assert block.read_bytes()[:4] == b"imud"
    block.unlink()
    identifier = tool("ipcmk", "--shmem", "4096").split()[-1]
    tool("ipcrm", "--shmem-id", identifier)
    fd = os.memfd_create("probe")
    try:
        os.truncate(fd, 4096)
        with mmap.mmap(fd, 4096) as view:
            view[0] = 1
    finally:
        os.close(fd)


def test_unix_socket_passes_credentials_and_descriptors() -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    event = os.eventfd(0)
    with near, far:
        credentials = near.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        assert int.from_bytes(credentials[:4], "little") == os.getpid()
        socket.send_fds(near, [b"x"], [event])
        _, (received,), _, _ = socket.recv_fds(far, 1, 1)
        os.eventfd_write(received, 5)
        assert os.eventfd_read(event) == 5
        os.close(received)
    os.close(event)


def test_inotify_sees_a_new_file(tmp_path: Path) -> None:
    fd = LIBC.inotify_init1(os.O_CLOEXEC)
    try:
        assert LIBC.inotify_add_watch(fd, str(tmp_path).encode(), IN_CREATE) >= 0
        (tmp_path / "new").touch()
        assert select.select([fd], [], [], 10)[0]
        assert os.read(fd, 4096)[16:].rstrip(b"\0") == b"new"
    finally:
        os.close(fd)


def test_signalfd_receives_a_signal() -> None:
    mask = ctypes.c_uint64(1 << (signal.SIGUSR1 - 1))
    padded = (ctypes.c_uint64 * 16)(mask.value)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
    fd = LIBC.signalfd(-1, padded, os.O_CLOEXEC)
    try:
        os.kill(os.getpid(), signal.SIGUSR1)
        assert int.from_bytes(os.read(fd, 128)[:4], "little") == signal.SIGUSR1
    finally:
        os.close(fd)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR1})


def test_loopback_works() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname(), 10) as client,
        server.accept()[0] as accepted,
    ):
        client.sendall(b"x")
        assert accepted.recv(1) == b"x"


def test_sysctl_is_writable() -> None:
    limit = Path("/proc/sys/net/core/rmem_max")
    before = limit.read_text(encoding="ascii")
    limit.write_text("4194304", encoding="ascii")
    assert limit.read_text(encoding="ascii").strip() == "4194304"
    limit.write_text(before, encoding="ascii")
