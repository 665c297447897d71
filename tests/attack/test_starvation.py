"""The daemon as a process that does not run for a while: its ledger agrees with what the device made.

The device is a thread; its own delays do not matter: what counts is how many samples it made, and what came of them.
"""

import os
import signal
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep

from imud.ledger import lost
from tests.attack.starvation import attack
from tests.support.daemon_process import RunningDaemon, running_daemon, wait_until
from tests.support.files import hi91

RATE_HZ = 1000
STOPS = 4
STOP_S = 2.0


class Module:
    """A module that samples at 1 kHz behind a pseudo-terminal; what does not fit there is lost."""

    def __init__(self, path: Path) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        path.symlink_to(os.ttyname(self._slave))
        self._running = True
        self.made = self.refused = 0
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        """Sample from now on."""
        self._thread.start()

    def _run(self) -> None:
        begin = monotonic()
        while self._running:
            while self.made < int((monotonic() - begin) * RATE_HZ):
                self._send(hi91(100_000 + self.made))
            sleep(0.001)

    def _send(self, frame: bytes) -> None:
        self.made += 1
        size = 0
        with suppress(BlockingIOError):
            size = os.write(self._master, frame)
        self.refused += size != len(frame)

    def stop(self) -> None:
        """Sample no more; may be called twice."""
        self._running = False
        if self._thread.is_alive():
            self._thread.join()

    def close(self) -> None:
        """Remove the terminal."""
        self.stop()
        os.close(self._slave)
        os.close(self._master)


@contextmanager
def streaming(folder: Path) -> Iterator[tuple[Module, RunningDaemon]]:
    module = Module(folder / "port")
    uart = {"port": str(folder / "port"), "baud": 921600}
    devices = {"bow": {"driver": "hipnuc-uart", "identify": False, "uart": uart}}
    try:
        with running_daemon(folder, devices, python=()) as daemon:
            daemon.wait_for("bow", "searching")
            module.start()
            daemon.wait_for("bow", "running")
            sleep(2.0)
            yield module, daemon
    finally:
        module.close()


def check(module: Module, daemon: RunningDaemon, stops: int) -> None:
    """The ledger has every sample that was made, as a sample or as lost, within one for each stop."""
    sleep(1.0)
    module.stop()
    wait_until(lambda: daemon.statuses()["bow"].ledger["bytes_pending"] == 0, "all is read")
    ledger = daemon.statuses()["bow"].ledger
    assert ledger["lost_unknown"] == 0
    assert abs(module.made - ledger["samples"] - lost(ledger)) <= stops


def test_losses_over_stops_agree_with_the_device(tmp_path: Path) -> None:
    with streaming(tmp_path) as (module, daemon):
        for _ in range(STOPS):
            daemon.signal(signal.SIGSTOP)
            sleep(STOP_S)
            daemon.signal(signal.SIGCONT)
            sleep(0.5)
        check(module, daemon, STOPS)
        assert module.refused > STOPS * STOP_S * RATE_HZ / 2


def test_losses_under_attack_agree_with_the_device(tmp_path: Path) -> None:
    with streaming(tmp_path) as (module, daemon):
        check(module, daemon, attack(daemon.process.pid, 8.0))
