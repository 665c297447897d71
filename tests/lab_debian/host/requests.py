"""Requests of the guest while it runs: `plug` and `unplug` the USB adapter, one line each. The reply is one line."""

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

from tests.lab.host.errors import LabError
from tests.lab_debian.host.machine import CONNECT_LIMIT_S, QMP, REQUESTS, Qmp, connected

LINE_BYTES = 200
DRAIN_S = 0.5
"""Time for the bytes that the sensor sent before it stopped, s."""


@contextlib.contextmanager
def answered(sockets: Path, sensor_pid: int) -> Iterator[None]:
    """Process the guest's requests in a thread until the end of the block or of QEMU.

    `sensor_pid` is the process of the simulated sensor.
    """
    thread = threading.Thread(target=_serve_machine, args=(sockets, sensor_pid), daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join(CONNECT_LIMIT_S + 1)


def _serve_machine(sockets: Path, sensor_pid: int) -> None:
    with (
        contextlib.suppress(LabError),
        Qmp(sockets / QMP) as qmp,
        connected(sockets / REQUESTS, CONNECT_LIMIT_S) as guest,
    ):
        guest.settimeout(None)
        serve(guest, {"plug": qmp.plug, "unplug": partial(unplug_quietly, qmp.unplug, sensor_pid)})


def unplug_quietly(unplug: Callable[[], None], sensor_pid: int) -> None:
    """Unplug the adapter while the sensor is stopped, because a byte would crash QEMU 7.2 in this time."""
    os.kill(sensor_pid, signal.SIGSTOP)
    try:
        time.sleep(DRAIN_S)
        unplug()
    finally:
        os.kill(sensor_pid, signal.SIGCONT)


def serve(guest: socket.socket, actions: Mapping[str, Callable[[], None]]) -> None:
    """Reply to each line of `guest` with `ok` or one line with the error, until `guest` closes."""
    with contextlib.suppress(OSError), guest.makefile("rb") as lines:
        while line := lines.readline(LINE_BYTES):
            guest.sendall(f"{answer(line.decode('utf-8', 'replace').strip(), actions)}\n".encode())


def answer(word: str, actions: Mapping[str, Callable[[], None]]) -> str:
    action = actions.get(word)
    if action is None:
        return f"expected one of {', '.join(sorted(actions))}, got {word!r}"
    try:
        action()
    except LabError as error:
        return str(error)
    return "ok"
