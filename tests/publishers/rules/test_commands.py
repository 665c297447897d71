"""Commands of rules as real processes: results, limits, the whole process group ends, and imud reaps it."""

import asyncio
import os
import time
from pathlib import Path

import pytest

from imud.publishers.rules import commands
from imud.publishers.rules.commands import CommandEnd, CommandRunner, Result
from imud.publishers.rules.settings import CommandLimits
from tests.support.daemon_process import wait_until
from tests.support.event_loops import VirtualClock

SHELL = "/bin/sh"  # the shell of the test; imud starts no shell
pytestmark = pytest.mark.live


async def results(runner: CommandRunner, *argvs: list[str], stop: bool = False) -> list[CommandEnd]:
    found: list[CommandEnd] = []
    for argv in argvs:
        runner.run(argv, {"IMUD_RULE": "hot"}, found.append)
    if stop:
        runner.close()
    async with asyncio.timeout(60):
        while len(found) < len(argvs):
            await asyncio.sleep(0.01)
    assert runner.running == 0
    return found


def end_of(*argv: str, stop: bool = False, **limits: float) -> CommandEnd:
    runner = CommandRunner(CommandLimits(**limits), time.monotonic_ns)  # type: ignore[arg-type]
    (end,) = asyncio.run(results(runner, list(argv), stop=stop))
    assert runner.results == {end.result: 1}
    return end


@pytest.mark.parametrize(
    ("argv", "end"),
    [
        ([SHELL, "-c", "echo one; echo two $IMUD_RULE >&2"], CommandEnd(Result.OK, "exit status 0", "two hot")),
        (["/bin/echo", "a b; c", "$HOME"], CommandEnd(Result.OK, "exit status 0", "a b; c $HOME")),
        ([SHELL, "-c", "exit 3"], CommandEnd(Result.FAILED, "exit status 3")),
        ([SHELL, "-c", "kill -9 $$"], CommandEnd(Result.FAILED, "ended by signal 9")),
        (["/nonexistent/x"], CommandEnd(Result.NOT_STARTED, "cannot start /nonexistent/x: No such file or directory")),
        (["/etc/passwd"], CommandEnd(Result.NOT_STARTED, "cannot start /etc/passwd: Permission denied")),
        (
            [SHELL, "-c", "yes | head -c 300000; printf '\\033x'"],
            CommandEnd(Result.OK, "exit status 0", "\\x1bx"),
        ),
    ],
)  # fmt: skip
def test_the_result_is_the_result_of_the_program(argv: list[str], end: CommandEnd) -> None:
    assert end_of(*argv) == end


def has_ended(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"  # an orphan that init reaps


@pytest.mark.parametrize("trap", ["", "trap '' TERM;"])
@pytest.mark.parametrize("stop", [False, True])
def test_a_long_command_ends_with_its_group(
    tmp_path: Path, trap: str, stop: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "TERM_NS", 300_000_000)
    script = f"{trap} sleep 600 & echo $! $$ >{tmp_path}/pids; wait; sleep 600"
    found = {False: (Result.TIMEOUT, "ended by imud after 0.5 s"), True: (Result.STOPPED, "ended by imud because")}[
        stop
    ]

    async def run() -> CommandEnd:
        runner = CommandRunner(CommandLimits(time_s=60 if stop else 0.5), time.monotonic_ns)
        ends: list[CommandEnd] = []
        runner.run([SHELL, "-c", script], {}, ends.append)
        async with asyncio.timeout(60):
            while stop and not (tmp_path / "pids").exists():
                await asyncio.sleep(0.01)
            if stop:
                runner.close()
            while not ends:
                await asyncio.sleep(0.01)
        return ends[0]

    end = asyncio.run(run())
    assert end.result is found[0]
    assert end.words.startswith(found[1])
    assert end.words.endswith(f"ended by signal {9 if trap else 15}")
    pids = [int(pid) for pid in (tmp_path / "pids").read_text().split()]
    wait_until(lambda: all(map(has_ended, pids)), "all processes of the group have ended")


def test_a_program_that_leaves_children_does_not_keep_them(tmp_path: Path) -> None:
    begun = time.monotonic()
    assert end_of(SHELL, "-c", f"sleep 600 & echo $! >{tmp_path}/pid").result is Result.OK
    assert time.monotonic() - begun < 300, "imud does not wait for the child, which has the output open"
    wait_until(lambda: has_ended(int((tmp_path / "pid").read_text())), "the child has ended")


def test_limits_of_running_commands_and_of_an_hour() -> None:
    clock = VirtualClock()
    runner = CommandRunner(CommandLimits(running=2, per_hour=3), clock.now_ns)
    argvs = [[SHELL, "-c", f"exit {n}"] for n in range(3)]
    first = asyncio.run(results(runner, *argvs))
    assert sorted(end.words for end in first) == [
        "exit status 0", "exit status 1",
        "not started: the limit of 2 running commands (rules.commands.running) is reached",
    ]  # fmt: skip
    second = asyncio.run(results(runner, argvs[0], argvs[0]))
    words = "not started: the limit of 3 commands per hour (rules.commands.per_hour) is reached"
    assert [end.words for end in second] == [words, "exit status 0"]
    clock.advance(3600 * 10**9)
    assert asyncio.run(results(runner, argvs[0]))[0].result is Result.OK
    assert runner.results == {Result.OK: 3, Result.FAILED: 1, Result.LEFT_OUT: 2}
