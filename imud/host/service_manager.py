"""Service manager: sd_notify(3) notifications, one datagram each to NOTIFY_SOCKET, and the watchdog."""

import logging
import os
import socket
from collections.abc import Callable
from typing import Final

from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

STATUS_NS: Final = NS_PER_S  # minimum time between two changes of the status line, ns


def notify(state: str) -> None:
    """Send `state`, for example `READY=1`. Do nothing without a service manager."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):  # an abstract socket
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as sock:
            sock.sendto(state.encode(), address)
    except OSError as error:
        log.warning("cannot notify the service manager of %s: %s", state.partition("\n")[0], error.strerror)


class ServiceManager:
    """Notifications of the running daemon. Synchronization: the thread of the event loop only."""

    def __init__(self) -> None:
        self._watchdog_s = watchdog_interval_s()
        self._watchdog_due_ns = 0
        self._status = ""
        self._status_due_ns = 0

    def ready(self) -> None:
        """Report that all outputs are open and the search for devices runs."""
        notify("READY=1")

    def stopping(self) -> None:
        """Report the end of the daemon."""
        notify("STOPPING=1")

    def tick(self, now_ns: int, status_line: Callable[[], str]) -> None:
        """Feed the watchdog. Report the status line if it changed. Call this method twice per second. `status_line`
        is called at most once per second."""
        if self._watchdog_s is not None and now_ns >= self._watchdog_due_ns:
            notify("WATCHDOG=1")
            self._watchdog_due_ns = now_ns + int(self._watchdog_s * NS_PER_S)
        if now_ns < self._status_due_ns:
            return
        self._status_due_ns = now_ns + STATUS_NS
        status = status_line()
        if status != self._status:
            self._status = status
            notify(f"STATUS={status}")


def watchdog_interval_s() -> float | None:
    """Return half of WATCHDOG_USEC, s: the interval of `WATCHDOG=1`. None if no watchdog is configured."""
    usec = os.environ.get("WATCHDOG_USEC", "")
    pid = os.environ.get("WATCHDOG_PID", str(os.getpid()))
    if not usec.isdecimal() or int(usec) == 0 or pid != str(os.getpid()):
        return None
    return int(usec) / 2e6
