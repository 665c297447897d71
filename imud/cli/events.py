"""`imud events`: print events as they come, each with its local time and priority.

    2026-11-23T14:05:09.123+01:00 warning bow: down: the adapter was pulled out

The priority is the log level of this kind of event in the daemon (`imud.model.event.LEVELS`), a name of syslog(3).
What happened before the command began is not sent: `imud status` shows what it led to, and the journal has all of it.
"""

import argparse
import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import msgspec

from imud.cli.arguments import CliCommand, add_socket
from imud.cli.output import complain, local_time, raise_if_unread
from imud.client.connection import Client
from imud.client.feed import clock_ahead_ns, utc_offset_ns
from imud.contracts.status import DeviceState
from imud.host.log import MESSAGE_CHARACTERS_MAX, printable
from imud.model.errors import LinkMissing, ServerError
from imud.model.event import LEVELS, Event

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


PRIORITIES: Final = {"warning": logging.WARNING, "info": logging.INFO, "debug": logging.DEBUG}
"""Priorities by name, the most important first."""
DAEMON: Final = "imud"
"""Shown as the device of events of the daemon itself."""


class PrintedEvent(msgspec.Struct, frozen=True, omit_defaults=True):
    """An event as `--json` prints it: as the socket sends it, with its time and its priority."""

    time: str
    """Local time with its offset from UTC, ISO 8601."""
    priority: str
    t_ns: int
    """CLOCK_MONOTONIC when it was noticed."""
    device: str
    """Empty for the daemon itself."""
    kind: str
    message: str
    detail: dict[str, str | int | float | bool | None] = {}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud events`."""
    add_socket(parser)
    parser.add_argument(
        "--device", action="append", default=[], metavar="DEVICE",
        help="events of this device and of the daemon itself; may be given several times (default: of all)",
    )  # fmt: skip
    parser.add_argument(
        "--priority", choices=list(PRIORITIES), default="debug",
        help="events of this priority and of more important ones (default: %(default)s, which are all)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--count", type=int, default=None, metavar="N", help="stop after N events")
    parser.add_argument(
        "--follow", action="store_true", help="wait for the daemon where it does not run, and go on after its restarts"
    )


def run(args: argparse.Namespace) -> int:
    """Print until interrupted, until N events came, or until the daemon ends; with `--follow` also after that."""
    keep_connected("imud events", args.socket, _Printer(args).work, follow=args.follow)
    return 0


class _Printer:
    """What goes on from one connection to the next."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._args = args
        self._left: int | None = args.count
        self._least = PRIORITIES[args.priority]

    def work(self, client: Client) -> None:
        """Print the events of one connection."""
        ahead_ns = clock_ahead_ns(client.status()["now_ns"])
        events = client.events(self._args.device or None, timeout_s=LOOK_S)
        show = as_json if self._args.json else as_text
        while self._left is None or self._left > 0:
            try:
                event = next(events)
            except TimeoutError:  # nothing happens
                raise_if_unread()
                continue
            if level_of(event) < self._least:
                continue
            sys.stdout.write(show(printed(event, utc_offset_ns(ahead_ns))) + "\n")
            sys.stdout.flush()
            if self._left is not None:
                self._left -= 1


def level_of(event: Event) -> int:
    """Return the level with which the daemon logs events of this kind; that of a warning for a kind that is unknown."""
    return LEVELS.get(event.kind, logging.WARNING)


def printed(event: Event, utc_offset_ns: int) -> PrintedEvent:
    """Add time and priority to an event; `utc_offset_ns` is CLOCK_REALTIME minus CLOCK_MONOTONIC."""
    level = level_of(event)
    priority = next(name for name, least in PRIORITIES.items() if level >= least)
    when = local_time(event.t_ns + utc_offset_ns).isoformat(timespec="milliseconds")
    return PrintedEvent(when, priority, event.t_ns, event.device, str(event.kind), event.message, event.detail)


def as_text(event: PrintedEvent) -> str:
    """Format an event as one line of printable characters."""
    line = f"{event.time} {event.priority:7} {event.device or DAEMON}: {event.kind}: {event.message}"
    return printable(line, MESSAGE_CHARACTERS_MAX)


def as_json(event: PrintedEvent) -> str:
    """Format an event as one JSON object."""
    return msgspec.json.encode(event).decode()


EVENTS = CliCommand(add_arguments, run)
