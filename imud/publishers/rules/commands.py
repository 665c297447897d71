"""Commands of rules: programs that imud runs without a shell.

Each command has a thread, because the start of a program can wait for a disk, and the loop of the daemon must not wait.
The thread reaps the program. The process group contains all programs that the command starts. At its end, imud kills
the rest of the group before it reaps the program: until then, no other group can have the same number.
"""

import asyncio
import logging
import os
import signal
import subprocess
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import IO, Final

from imud.host.log import printable
from imud.model.errors import reason_of
from imud.model.units import NS_PER_S
from imud.publishers.rules.settings import CommandLimits

log = logging.getLogger(__name__)

HOUR_NS: Final = 3600 * NS_PER_S
TERM_NS: Final = 2 * NS_PER_S  # time from SIGTERM to SIGKILL, ns
POLL_S: Final = 0.05  # interval in which the thread looks for the end of the program, s
LINE_BYTES: Final = 200  # maximum length of the last line of the output
READ_BYTES: Final = 65536
KEPT_VARIABLES: Final = ("PATH", "LANG", "LC_ALL", "TZ", "HOME", "USER", "LOGNAME")


class Result(StrEnum):
    """Results of commands."""

    OK = "ok"  # exit status 0
    FAILED = "failed"  # another exit status, or a signal from another process
    TIMEOUT = "timeout"  # imud ended the command after its maximum duration
    STOPPED = "stopped"  # imud ended the command because the output ended
    NOT_STARTED = "not_started"  # the system did not start the program
    LEFT_OUT = "left_out"  # imud did not start the program because a limit was reached


@dataclass(frozen=True, slots=True)
class CommandEnd:
    """End of a command."""

    result: Result
    words: str  # description, one clause
    last_line: str = ""  # last line of the output; empty without output


OnCommandEnd = Callable[[CommandEnd], None]


class CommandRunner:
    """Runner of commands. Synchronization: the event loop's thread only."""

    def __init__(self, limits: CommandLimits, now_ns: Callable[[], int]) -> None:
        self.results: Counter[Result] = Counter()
        self._limits = limits
        self._now_ns = now_ns
        self._started: deque[int] = deque()  # times of the commands of the last hour
        self._running: set[RunningCommand] = set()

    def run(self, argv: Sequence[str], facts: Mapping[str, str], on_end: OnCommandEnd) -> None:
        """Run a command. `facts` are additional environment variables. `on_end` is called in the loop."""
        now_ns, limits = self._now_ns(), self._limits
        while self._started and now_ns - self._started[0] >= HOUR_NS:
            self._started.popleft()
        reached = ""
        if len(self._running) >= limits.running:
            reached = f"{limits.running} running commands (rules.commands.running)"
        elif len(self._started) >= limits.per_hour:
            reached = f"{limits.per_hour} commands per hour (rules.commands.per_hour)"
        if reached:
            self._finish(CommandEnd(Result.LEFT_OUT, f"not started: the limit of {reached} is reached"), on_end)
            return
        self._started.append(now_ns)
        kept = {name: os.environ[name] for name in KEPT_VARIABLES if name in os.environ}
        command = RunningCommand(argv, {**kept, **facts}, limits.time_s, self._now_ns)
        self._running.add(command)
        loop = asyncio.get_running_loop()

        def ended(end: CommandEnd) -> None:
            self._running.discard(command)
            self._finish(end, on_end)

        def call_loop(end: CommandEnd) -> None:
            with suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(ended, end)

        try:
            command.start(call_loop)
        except RuntimeError as error:  # no further thread
            ended(CommandEnd(Result.NOT_STARTED, f"cannot start a thread: {error}"))

    @property
    def running(self) -> int:
        """Number of running commands."""
        return len(self._running)

    def close(self) -> None:
        """End all commands. Their threads send SIGTERM, after TERM_NS SIGKILL, and reap them. Do not wait."""
        for command in self._running:
            command.stop()

    def _finish(self, end: CommandEnd, on_end: OnCommandEnd) -> None:
        self.results[end.result] += 1
        on_end(end)


class RunningCommand:
    """One command with its thread."""

    def __init__(
        self, argv: Sequence[str], environment: Mapping[str, str], limit_s: float, now_ns: Callable[[], int]
    ) -> None:
        self._argv = list(argv)
        self._environment = dict(environment)
        self._limit_s, self._now_ns = limit_s, now_ns
        self._stop = threading.Event()
        self._tail = b""

    def start(self, on_end: Callable[[CommandEnd], None]) -> None:
        """Start the thread. It calls `on_end` after the program was reaped. Raises RuntimeError."""
        # not a daemon thread: the interpreter waits for it at the exit, so that no program remains
        threading.Thread(target=lambda: on_end(self._run()), name="rule command").start()

    def stop(self) -> None:
        """End the program early."""
        self._stop.set()

    def _run(self) -> CommandEnd:
        try:
            process = subprocess.Popen(
                self._argv, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                env=self._environment, cwd="/", start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            return CommandEnd(Result.NOT_STARTED, f"cannot start {printable(self._argv[0])}: {reason_of(error)}")
        assert process.stdout is not None
        with process.stdout as output:
            result = self._wait(process.pid, output)
            with suppress(ProcessLookupError, PermissionError):  # the rest of the group
                os.killpg(process.pid, signal.SIGKILL)
            status = process.wait()
        words = f"exit status {status}" if status >= 0 else f"ended by signal {-status}"
        if result is Result.TIMEOUT:
            words = f"ended by imud after {self._limit_s:g} s (rules.commands.time_s), {words}"
        elif result is Result.STOPPED:
            words = f"ended by imud because the rules ended, {words}"
        elif status:
            result = Result.FAILED
        line = self._tail.rstrip().rpartition(b"\n")[2][-LINE_BYTES:]
        return CommandEnd(result, words, printable(line.decode(errors="replace")))

    def _wait(self, pid: int, output: IO[bytes]) -> Result:
        """Wait for the end of the program without reaping it. Send SIGTERM and SIGKILL to its group when due."""
        os.set_blocking(output.fileno(), False)
        due_ns, result, number = self._now_ns() + round(self._limit_s * NS_PER_S), Result.OK, signal.SIGTERM
        while True:
            ended = os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
            self._read(output)
            if ended:
                return result
            if result is Result.OK and (self._stop.is_set() or self._now_ns() >= due_ns):
                result, due_ns = (Result.STOPPED if self._stop.is_set() else Result.TIMEOUT), 0
            if result is not Result.OK and self._now_ns() >= due_ns:
                with suppress(ProcessLookupError, PermissionError):
                    os.killpg(pid, number)
                due_ns, number = self._now_ns() + TERM_NS, signal.SIGKILL
            (self._stop if result is Result.OK else threading.Event()).wait(POLL_S)

    def _read(self, output: IO[bytes]) -> None:
        """Keep the end of the output."""
        with suppress(BlockingIOError):
            self._tail = (self._tail + os.read(output.fileno(), READ_BYTES))[-2 * LINE_BYTES :]
