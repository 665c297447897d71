"""Samples for chronyd: their length from its program, their layout, and a real chronyd."""

import os
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from imud.host.clock import HostClock
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.utc.chrony import LONG_BYTES, SHORT_BYTES, ChronyFeed, encode, find_sample_bytes
from tests.support.daemon_process import LIMIT_S

UTC_S = 1_795_000_000

ARM, AMD64, I386, RISCV = 40, 62, 3, 243
SOCKET = "/run/chrony.imud.sock"


def program(bits: int, machine: int, symbols: bytes = b"") -> bytes:
    """Return the head of a program, and some of its symbols."""
    return struct.pack("=4sB11xHH", b"\x7fELF", 2 if bits == 64 else 1, 3, machine) + bytes(500) + symbols


PROGRAMS = {
    "amd64": (program(64, AMD64), LONG_BYTES),
    "armhf of Debian 12": (program(32, ARM, b"\0clock_gettime\0gettimeofday\0"), SHORT_BYTES),
    "armhf of Debian 13": (program(32, ARM, b"\0__clock_gettime64\0"), LONG_BYTES),
    "i386": (program(32, I386, b"\0gettimeofday\0"), SHORT_BYTES),
    "x32": (program(32, AMD64), LONG_BYTES),
    "riscv32": (program(32, RISCV), LONG_BYTES),
    "script": (b"#!/bin/sh\n" * 10, None),
    "empty": (b"", None),
}


class FakeProc:
    """Folder like /proc."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "net").mkdir(parents=True)
        (folder / "net/unix").write_text("Num       RefCount Protocol Flags    Type St Inode Path\n")

    def bind(self, inode: int, path: str = SOCKET) -> None:
        with (self.folder / "net/unix").open("a") as table:
            table.write(f"0000000000000000: 00000002 00000000 00000000 0002 01 {inode} {path}\n")

    def add_process(self, number: int, name: str, file: Path, inode: int | None = None) -> None:
        process = self.folder / str(number)
        process.mkdir()
        (process / "comm").write_text(f"{name}\n")
        (process / "cmdline").write_bytes(os.fsencode(file) + b"\0-F\0001\0")
        if inode is not None:
            (process / "fd").mkdir()
            (process / "fd/5").symlink_to(f"socket:[{inode}]")
            (process / "exe").symlink_to(file)


@pytest.fixture
def proc(tmp_path: Path) -> FakeProc:
    return FakeProc(tmp_path / "proc")


@pytest.mark.parametrize("name", PROGRAMS)
def test_length_of_each_program(tmp_path: Path, proc: FakeProc, name: str) -> None:
    content, expected = PROGRAMS[name]
    file = tmp_path / "chronyd"
    file.write_bytes(content)
    assert find_sample_bytes(SOCKET, proc.folder, (file,)) == expected


def test_owner_before_process_before_installed_program(tmp_path: Path, proc: FakeProc) -> None:
    files = [tmp_path / name for name in ("owner", "process", "installed")]
    for file, bits in zip(files, (32, 64, 32), strict=True):
        file.write_bytes(program(bits, I386 if bits == 32 else AMD64))
    owner, process, installed = files
    assert find_sample_bytes(SOCKET, proc.folder, (tmp_path / "none", installed)) == SHORT_BYTES
    proc.add_process(12, "chronyd", process)
    proc.add_process(13, "sshd", owner)
    assert find_sample_bytes(SOCKET, proc.folder, (installed,)) == LONG_BYTES
    proc.bind(4711, "/run/other.sock")
    proc.bind(4712)
    proc.add_process(14, "other", process, 4711)
    proc.add_process(15, "gps time", owner, 4712)
    assert find_sample_bytes(SOCKET, proc.folder, (installed,)) == SHORT_BYTES


def test_unknown_without_a_readable_program(tmp_path: Path, proc: FakeProc) -> None:
    assert find_sample_bytes(SOCKET, proc.folder, (tmp_path / "none",)) is None
    assert find_sample_bytes(SOCKET, tmp_path / "no proc", ()) is None
    for index, bits in enumerate((32, 64)):
        file = tmp_path / str(bits)
        file.write_bytes(program(bits, I386 if bits == 32 else AMD64))
        proc.add_process(index, "chronyd", file)
    assert find_sample_bytes(SOCKET, proc.folder, ()) is None, "two different programs"


def test_owner_of_a_real_socket(tmp_path: Path) -> None:
    """The Python of this test."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(tmp_path / "sock"))
        expected = LONG_BYTES if struct.calcsize("l") == 8 else None
        if expected is None:
            pytest.skip("a 32-bit Python can have both times")
        assert find_sample_bytes(str(tmp_path / "sock"), programs=()) == expected


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(tmp_path / "sock"))
        sock.setblocking(False)
        yield sock


def feed(receiver: socket.socket, ahead_ns: int = 0) -> ChronyFeed:
    """A feed on a host whose clock is `ahead_ns` ahead of UTC, and whose CLOCK_MONOTONIC is UTC - UTC_S."""
    return ChronyFeed(receiver.getsockname(), lambda: UTC_S * NS_PER_S + ahead_ns)


def test_the_layout_byte_by_byte() -> None:
    sample = encode(1_500_000_000 * NS_PER_S + 123_456_789, -250_000_000, pulse=False, leap=2)
    assert sample[:8] == (1_500_000_000).to_bytes(8, "little")
    assert sample[8:16] == (123_456).to_bytes(8, "little")
    assert sample[16:24] == bytes.fromhex("000000000000d0bf")  # -0.25
    assert sample[24:36] == bytes([0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0])
    assert sample[36:] == b"KCOS"  # 0x534f434b
    assert encode(0, 0, pulse=True)[24] == 1


@pytest.mark.parametrize("ahead_ns", [0, 300 * NS_PER_MS, -7 * NS_PER_S - 1])
def test_a_pulse_of_a_known_second_gives_the_whole_offset(receiver: socket.socket, ahead_ns: int) -> None:
    chrony = feed(receiver, ahead_ns)
    assert chrony.send_pulse(10 * NS_PER_S, UTC_S + 10)
    assert receiver.recv(100) == encode((UTC_S + 10) * NS_PER_S + ahead_ns, -ahead_ns, pulse=False)
    assert (chrony.sent, chrony.refused, chrony.problem) == (1, 0, "")
    chrony.close()
    chrony.close()


@pytest.mark.parametrize(
    ("ahead_ns", "given_ns"), [(0, 0), (300, -300), (-400, 400), (600, 400), (-600, -400), (3200, -200)]
)
def test_a_pulse_alone_gives_the_nearest_second(receiver: socket.socket, ahead_ns: int, given_ns: int) -> None:
    chrony = feed(receiver, ahead_ns * NS_PER_MS)
    chrony.send_pulse(10 * NS_PER_S)
    expected = encode((UTC_S + 10) * NS_PER_S + ahead_ns * NS_PER_MS, given_ns * NS_PER_MS, pulse=True)
    assert receiver.recv(100) == expected
    chrony.close()


def test_a_missing_socket_is_counted_and_the_next_sample_tried(tmp_path: Path) -> None:
    chrony = ChronyFeed(str(tmp_path / "sock"), HostClock().utc_offset_ns)
    assert not chrony.send_pulse(time.monotonic_ns())
    assert chrony.refused == 1
    assert "is it running" in chrony.problem
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(tmp_path / "sock"))
        assert chrony.send_pulse(time.monotonic_ns())
        assert chrony.problem == ""
    assert not chrony.send_pulse(time.monotonic_ns())
    assert (chrony.sent, chrony.refused) == (1, 2)
    chrony.close()


def test_sample_for_a_32_bit_time() -> None:
    sample = encode(1_500_000_000 * NS_PER_S + 123_456_789, -250_000_000, pulse=False, leap=2, sample_bytes=32)
    assert sample[:8] == (1_500_000_000).to_bytes(4, "little") + (123_456).to_bytes(4, "little")
    assert sample[8:] == bytes.fromhex("000000000000d0bf") + bytes([0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0]) + b"KCOS"
    assert encode(2**32 * NS_PER_S, 0, pulse=True, sample_bytes=32)[:4] == bytes(4), "after the year 2106"


def test_length_follows_the_present_chronyd(tmp_path: Path) -> None:
    lengths: list[int | None] = [32, None, 40]
    path = tmp_path / "sock"
    chrony = ChronyFeed(str(path), lambda: 0, None, lambda _path: lengths.pop(0))
    received: list[int] = []
    for problem in ("", "not verified", ""):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.bind(str(path))
            for _ in range(3):
                assert chrony.send_pulse(0)
                received.append(len(sock.recv(100)))
            assert problem in chrony.problem
            assert bool(chrony.problem) == bool(problem)
        path.unlink()
        assert not chrony.send_pulse(0)
    assert received == [40, 32, 32, 32, 40, 40, 40, 40, 40]
    chrony.close()


def test_configured_length_needs_no_program(receiver: socket.socket) -> None:
    chrony = ChronyFeed(receiver.getsockname(), lambda: 0, 32, lambda _path: None)
    assert chrony.send_pulse(0)
    assert len(receiver.recv(100)) == 32
    assert chrony.problem == ""
    chrony.close()


def test_a_receiver_that_does_not_read_blocks_nothing(receiver: socket.socket) -> None:
    chrony = feed(receiver)
    while not chrony.refused:
        chrony.send_pulse(0)
    assert chrony.sent > 0
    chrony.close()
    assert not chrony.send_pulse(0), "a closed feed refuses"
    assert chrony.refused == 2


# --- a real chronyd ---------------------------------------------------------------------------------------------------

MISSING = next((name for name in ("chronyd", "chronyc") if not shutil.which(name)), "")
NO_CHRONY = f"{MISSING} is not installed (Debian package chrony)" if MISSING else ""
if not NO_CHRONY and os.geteuid() != 0:
    NO_CHRONY = "chronyd needs root"


@pytest.fixture
def chronyd(tmp_path: Path) -> Iterator[Path]:
    config = tmp_path / "chrony.conf"
    config.write_text(
        f"refclock SOCK {tmp_path}/imud.sock refid IMUD poll 0 filter 1\n"
        f"bindcmdaddress {tmp_path}/command.sock\ncmdport 0\nport 0\npidfile {tmp_path}/pid\nuser root\n"
    )
    tmp_path.chmod(0o750)  # chronyd requires a folder without write permission for others
    process = subprocess.Popen(["chronyd", "-x", "-d", "-f", str(config)], stderr=subprocess.PIPE, text=True)
    try:
        yield tmp_path
    finally:
        process.terminate()
        _, said = process.communicate(timeout=LIMIT_S)
        print(said)


def sources(folder: Path) -> dict[str, list[str]]:
    """Return the reference clocks of chronyd by name: the fields of `chronyc -c sources`."""
    with suppress(subprocess.TimeoutExpired):
        run = subprocess.run(
            ["chronyc", "-h", str(folder / "command.sock"), "-c", "sources"],
            capture_output=True, text=True, check=False, timeout=LIMIT_S,
        )  # fmt: skip
        return {fields[2]: fields for line in run.stdout.splitlines() if len(fields := line.split(",")) > 7}
    return {}


@pytest.mark.live
@pytest.mark.skipif(bool(NO_CHRONY), reason=NO_CHRONY)
def test_chronyd_takes_the_samples_and_sees_the_offset(chronyd: Path) -> None:
    offset_ns = 123 * NS_PER_MS  # UTC according to the pulses minus the system clock
    utc_offset_ns = HostClock().utc_offset_ns
    chrony = ChronyFeed(str(chronyd / "imud.sock"), utc_offset_ns)
    limit_s = time.monotonic() + LIMIT_S
    while True:
        now_ns = time.monotonic_ns()
        utc_ns = now_ns + utc_offset_ns() + offset_ns
        chrony.send_pulse(now_ns - utc_ns % NS_PER_S, utc_ns // NS_PER_S)
        source = sources(chronyd).get("IMUD")
        if source and source[5] != "0" and float(source[7]):
            break
        assert time.monotonic() < limit_s, (source, chrony.problem)
        time.sleep(0.2)
    assert source[0] == "#"  # a reference clock
    # fields 7 and 8: adjusted and measured offset of the last sample; positive: the system clock is ahead
    assert abs(float(source[8])) == pytest.approx(0.123, abs=0.02)
    chrony.close()
