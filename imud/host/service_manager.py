"""The service manager: notifications by sd_notify(3), one datagram each to NOTIFY_SOCKET, and its watchdog."""

import logging
import os
import socket
from collections.abc import Callable, Mapping
from typing import Final

from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

STATUS_NS: Final = NS_PER_S
"""The status line changes at most once a second."""
NAMES_SHOWN: Final = 5
"""Devices that are named in the status line."""
FINE: Final = ("running", "finished")
"""States of devices (`DeviceState`) that need nobody's attention."""


def notify(state: str) -> None:
    """Send `state`, for example `READY=1`; no-op when not started by a service manager."""
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
    """What the daemon tells the service manager while it runs. Synchronization: the event loop's thread only."""

    def __init__(self) -> None:
        self._watchdog_s = watchdog_interval_s()
        self._watchdog_due_ns = 0
        self._status = ""
        self._status_due_ns = 0

    def ready(self) -> None:
        """The daemon is up: outputs are open and devices are searched for."""
        notify("READY=1")

    def stopping(self) -> None:
        """The daemon ends."""
        notify("STOPPING=1")

    def tick(self, now_ns: int, states: Callable[[], Mapping[str, str]]) -> None:
        """Feed the watchdog, and tell how the devices are when that has changed. Call it ten times a second.

        `states` returns the state of each device by its name; it is called at most once a second.
        """
        if self._watchdog_s is not None and now_ns >= self._watchdog_due_ns:
            notify("WATCHDOG=1")
            self._watchdog_due_ns = now_ns + int(self._watchdog_s * NS_PER_S)
        if now_ns < self._status_due_ns:
            return
        self._status_due_ns = now_ns + STATUS_NS
        status = status_line(states())
        if status != self._status:
            self._status = status
            notify(f"STATUS={status}")


def status_line(states: Mapping[str, str]) -> str:
    """Say how many devices run and name those that do not, for `systemctl status`."""
    if not states:
        return "No devices are configured."
    other = [f"{name} ({state})" for name, state in states.items() if state not in FINE]
    running = len(states) - len(other)
    counted = f"{running} of {len(states)} devices running" if len(states) > 1 else f"{running} of 1 device running"
    if not other:
        return f"{counted}."
    more = f" and {len(other) - NAMES_SHOWN} more" if len(other) > NAMES_SHOWN else ""
    return f"{counted}; not: {', '.join(other[:NAMES_SHOWN])}{more}."


def watchdog_interval_s() -> float | None:
    """Half of WATCHDOG_USEC in seconds: how often `WATCHDOG=1` must be sent; None where no watchdog is asked for."""
    usec = os.environ.get("WATCHDOG_USEC", "")
    pid = os.environ.get("WATCHDOG_PID", str(os.getpid()))
    if not usec.isdecimal() or int(usec) == 0 or pid != str(os.getpid()):
        return None
    return int(usec) / 2e6
