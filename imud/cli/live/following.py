"""The connection of a command that runs until it is interrupted: once, or again after each restart of the daemon.

What is said about the connection and about devices goes to standard error, so that standard output has only the samples
or events.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

from imud.cli.streams import complain, raise_if_unread
from imud.client import Client
from imud.contracts.status import DeviceState
from imud.errors import LinkMissing, ServerError

RETRY_S: Final = 1.0
"""Time between two attempts to connect: a restart of the service takes about two."""
LOOK_S: Final = 2.0
"""Time between two looks at the states of the watched devices, and how long a silence is waited for at once."""


def keep_connected(
    command: str,
    path: str,
    work: Callable[[Client], None],
    *,
    follow: bool,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Connect to the daemon at `path` and do the work; with `follow` again after each loss of the daemon, until done.

    Where no daemon is there, `follow` waits for one. Raises LinkMissing and ServerError (a daemon that does not answer)
    without `follow`; always LinkDenied, other ServerErrors, and BrokenPipeError when nobody reads the output any more.
    """
    reason = ""
    while True:
        try:
            with Client(path) as client:
                if reason:
                    complain(f"{command}: connected again")
                    reason = ""
                work(client)
                return
        except (LinkMissing, TimeoutError) as error:
            if not follow:
                if isinstance(error, TimeoutError):
                    raise ServerError(str(error)) from error
                raise
            if str(error) != reason:
                complain(f"{command}: {error}; waiting for the daemon")
            reason = str(error)
        raise_if_unread()
        wait(RETRY_S)


class DeviceLister(Protocol):
    """What lists the devices of a daemon, as `imud.client.Client` does."""

    def devices(self) -> Sequence[Mapping[str, Any]]:
        """Each with its name, state and problem."""
        ...


class DeviceNotes:
    """Lines on standard error for devices that are watched and send no samples now, and for samples that were dropped
    because the output was read too slowly."""

    def __init__(self, client: DeviceLister, names: Sequence[str]) -> None:
        """No `names` are all devices."""
        self._client = client
        self._names = list(names)
        self._due_s = 0.0
        self._noted: dict[str, str] = {}
        self._dropped: dict[str, int] = {}

    def add_dropped(self, device: str, count: int) -> None:
        """Note samples that the daemon dropped; they are reported with the next look."""
        self._dropped[device] = self._dropped.get(device, 0) + count

    def look(self, now_s: float) -> None:
        """Ask for the devices, once in LOOK_S at most, and note what has changed."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + LOOK_S
        found = {str(device["name"]): device for device in self._client.devices()}
        for name in self._names or sorted({*found, *self._noted}):
            words = _why_silent(found[name]) if name in found else "not in the configuration any more"
            if words != self._noted.get(name, ""):
                complain(f"imud watch: {name} is {words or 'running'}")
            self._noted[name] = words
        for name, count in self._dropped.items():
            complain(f"imud watch: {count} samples of {name} were dropped: they were read too slowly")
        self._dropped.clear()


def _why_silent(device: Mapping[str, Any]) -> str:
    """Describe state and problem of a device; empty for one that runs."""
    state, problem = device["state"], device["problem"]
    return "" if state == DeviceState.RUNNING else f"{state}: {problem}" if problem else str(state)
