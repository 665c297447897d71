"""The watch over a guest, with shell scripts in QEMU's place: every way to end, none of them a hang."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.lab.host.errors import HungGuest, LabError
from tests.lab.host.guest import MACHINE_LOG, Folder, Limits, run
from tests.lab.host.monitor import QUESTIONS

LONG = Limits(total_s=30.0, boot_s=30.0, silence_s=30.0)
HANG = "echo $$ >pid; exec sleep 300"


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, Limits], tuple[int, bytes]]:
    """Runs a script as the guest, in the run's folder; returns its status and output."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tests.lab.host.monitor.ANSWER_S", 0.1)  # the scripts have no monitor

    def go(script: str, limits: Limits) -> tuple[int, bytes]:
        output = bytearray()
        status = run(lambda _fds, _monitor: ["sh", "-c", script], Folder(tmp_path), limits, output.extend)
        return status, bytes(output)

    return go


Start = Callable[[str, Limits], tuple[int, bytes]]


def is_gone(pid: int) -> bool:
    """Whether no process has this number."""
    return not Path(f"/proc/{pid}").exists()


def test_status_and_output_come_back(start: Start) -> None:
    assert start("echo one; echo two; echo 3 >status", LONG) == (3, b"one\ntwo\n")


def test_output_comes_while_the_guest_runs(tmp_path: Path) -> None:
    """The script goes on only after the runner passed its first line on."""
    fifo = tmp_path / "go"
    os.mkfifo(fifo)
    script = f"echo first; cat {fifo} >/dev/null; echo 0 >{tmp_path}/status"
    seen = []

    def passed_on(data: bytes) -> None:
        seen.append(data)
        fifo.write_bytes(b"go")

    assert run(lambda _fds, _monitor: ["sh", "-c", script], Folder(tmp_path), LONG, passed_on) == 0
    assert seen == [b"first\n"]


def test_uart_ends_are_passed_and_connected(tmp_path: Path) -> None:
    def command(fds: tuple[int, int], _monitor: int) -> list[str]:
        crossed = f"import os; os.write({fds[0]}, b'x'); assert os.read({fds[1]}, 1) == b'x'"
        return ["sh", "-c", f'python3 -I -c "{crossed}" && echo 0 >{tmp_path}/status']

    assert run(command, Folder(tmp_path), LONG, lambda _data: None) == 0


def test_panic(start: Start) -> None:
    with pytest.raises(LabError, match=r"^kernel panic in the guest: Kernel panic - not syncing: test$"):
        start("echo '[ 9.2] Kernel panic - not syncing: test' >console.log", LONG)


def test_end_without_a_word(start: Start) -> None:
    with pytest.raises(LabError, match="guest ended without a result; last console line: Run init"):
        start("echo '[ 1.0] Run init' >console.log", LONG)


def test_bad_qemu_option(start: Start) -> None:
    with pytest.raises(LabError, match=r"^QEMU failed: qemu: -frob: invalid option$"):
        start("echo 'qemu: -frob: invalid option' >&2; exit 1", LONG)


def test_set_up_problem_in_the_guest(start: Start) -> None:
    with pytest.raises(LabError, match=r"^guest set-up failed: mount /tmp$"):
        start("echo 'guest set-up failed: mount /tmp' >problem", LONG)


def test_out_of_memory_with_a_status(start: Start) -> None:
    """The kernel killed pytest: the shell reports 137, which says nothing."""
    with pytest.raises(LabError, match=r"^guest out of memory: Out of memory: Killed process 7"):
        start("echo '[ 9.0] Out of memory: Killed process 7 (python)' >console.log; echo 137 >status", LONG)


def test_memory_kill_that_no_test_minded(start: Start) -> None:
    assert start("echo 'Out of memory: Killed process 7' >console.log; echo 0 >status", LONG)[0] == 0


@pytest.mark.parametrize(
    ("script", "limits", "message"),
    [
        (HANG, Limits(total_s=30.0, boot_s=0.3, silence_s=30.0), "^hung guest: not booted after 0 s$"),
        (f": >alive; {HANG}", Limits(total_s=30.0, boot_s=30.0, silence_s=0.3), "^hung guest: no sign of life for"),
        (
            f": >alive; echo 'watchdog: BUG: soft lockup' >console.log; {HANG}",
            Limits(total_s=30.0, boot_s=30.0, silence_s=0.3),
            r"^hung guest: no sign of life for \d+ s \(guest kernel stuck: watchdog: BUG: soft lockup\)$",
        ),
        (f": >alive; {HANG}", Limits(total_s=0.3, boot_s=30.0, silence_s=30.0), "^time is up: the guest still ran"),
    ],
)
def test_hung_guest_is_ended(start: Start, tmp_path: Path, script: str, limits: Limits, message: str) -> None:
    before_s = time.monotonic()
    with pytest.raises(LabError, match=message):
        start(script, limits)
    assert time.monotonic() - before_s < 10
    assert is_gone(int((tmp_path / "pid").read_text(encoding="ascii")))


MONITOR = """import os, sys
monitor = int(sys.argv[1])
os.write(monitor, b"QEMU\\n(qemu) ")
while True:
    question = os.read(monitor, 100)
    if question == b"nmi\\n":
        break
    for part in (b"echo\\n", b"answer to ", question, b"(qe", b"mu) "):
        os.write(monitor, part)
"""


def test_hung_guest_is_examined(tmp_path: Path) -> None:
    """Each question has its answer in the log, and the interrupt that ends the guest is the last of them."""
    program = tmp_path / "monitor.py"
    program.write_text(MONITOR, encoding="ascii")
    limits = Limits(total_s=30.0, boot_s=30.0, silence_s=0.3)

    def command(_fds: tuple[int, int], monitor: int) -> list[str]:
        return ["sh", "-c", f": >{tmp_path}/alive; exec python3 -I {program} {monitor}"]

    with pytest.raises(HungGuest):
        run(command, Folder(tmp_path), limits, lambda _data: None)
    answers = "".join(f"{question}\nanswer to {question}\n(qemu) " for question in QUESTIONS)
    assert (tmp_path / MACHINE_LOG).read_text() == f"QEMU\n(qemu) {answers}nmi\n"


CONTINUED = """import os, pathlib, sys
told = b""
while len(told) < 20:
    told += os.read(int(sys.argv[1]), 100)
pathlib.Path("told").write_bytes(told)
pathlib.Path("status").write_text("7")
"""


def test_silent_guest_is_stopped_and_continued_until_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It goes on at the second time."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "alive").touch()
    limits = Limits(total_s=30.0, boot_s=30.0, silence_s=30.0, restart_s=0.3)

    def command(_fds: tuple[int, int], monitor: int) -> list[str]:
        return [sys.executable, "-I", "-c", CONTINUED, str(monitor)]

    assert run(command, Folder(tmp_path), limits, lambda _data: None) == 7
    assert (tmp_path / "told").read_bytes() == b"stop\ncont\n" * 2


def test_flood_of_output_does_not_defeat_the_limit(start: Start) -> None:
    with pytest.raises(LabError, match="time is up"):
        start("exec yes", Limits(total_s=0.3, boot_s=30.0, silence_s=30.0))


def test_machine_that_does_not_stop_after_its_status(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.lab.host.guest.GOODBYE_S", 0.1)
    assert start(f"echo 4 >status; {HANG}", LONG)[0] == 4
    assert is_gone(int((tmp_path / "pid").read_text(encoding="ascii")))
