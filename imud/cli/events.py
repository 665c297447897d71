"""`imud events`: print new or past events with local time and priority.

    2026-11-23T14:05:09.123+01:00 warning bow: down: the adapter was pulled out

The priority is the log level of this kind of event in the daemon (`imud.model.event.LEVELS`), a name of syslog(3).
The daemon keeps the newest 1,000 events of each device since its start. Repeated events are one line with a count.
"""

import argparse
import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import msgspec

from imud.cli.arguments import CliCommand, add_socket, duration_s
from imud.cli.output import complain, local_time, raise_if_unread
from imud.client.connection import Client, decoded
from imud.client.feed import clock_ahead_ns, utc_offset_ns
from imud.contracts.condition import DeviceCondition, signature
from imud.contracts.condition import duration as in_words
from imud.host.log import MESSAGE_CHARACTERS_MAX, printable, printable_json
from imud.model.errors import LinkMissing, ServerError
from imud.model.event import LEVELS, Event, StoredEvent
from imud.model.units import NS_PER_S

RETRY_S: Final = 1.0  # Time between two attempts to connect, s. A restart of the service takes about 2 s.
LOOK_S: Final = 2.0  # time between two checks of the device states, and maximum wait for the next sample or event, s


def keep_connected(
    command: str,
    path: str,
    work: Callable[[Client], None],
    *,
    follow: bool,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Connect to the daemon at `path` and call `work`. With `follow`, wait for a daemon and connect again after a loss.

    Without `follow`, raises LinkMissing if no daemon runs, and ServerError if the daemon does not reply. Raises
    LinkDenied, other ServerErrors, and BrokenPipeError if the reader of the output closed the pipe.
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
                # the daemon accepted the connection, but did not reply
                if isinstance(error, TimeoutError):
                    raise ServerError(str(error)) from error
                raise
            # print each reason once, not at every attempt
            if str(error) != reason:
                complain(f"{command}: {error}; waiting for the daemon")
            reason = str(error)
        raise_if_unread()
        wait(RETRY_S)


class DeviceLister(Protocol):
    """Source of the devices of a daemon: `imud.client.Client`, or a replacement in tests."""

    def devices(self) -> Sequence[Mapping[str, Any]]:
        """Return name, state and problem of each device."""
        ...


class DeviceNotes:
    """Notes on standard error about the conditions of watched devices, and about dropped samples."""

    def __init__(self, client: DeviceLister, names: Sequence[str]) -> None:
        """`names`: the watched devices; empty for all devices."""
        self._client = client
        self._names = list(names)
        self._due_s = 0.0
        self._noted: dict[str, str] = {}
        self._dropped: dict[str, int] = {}

    def add_dropped(self, device: str, count: int) -> None:
        """Count samples that the daemon dropped. The next `look` reports them."""
        self._dropped[device] = self._dropped.get(device, 0) + count

    def look(self, now_s: float) -> None:
        """Request the conditions, at most once per LOOK_S, and print the changes."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + LOOK_S
        found = {str(device["name"]): device for device in self._client.devices()}
        for name in self._names or sorted({*found, *self._noted}):
            cause, words = _condition(found[name]) if name in found else ("gone", "no longer in the configuration")
            if cause != self._noted.get(name, ""):
                complain(f"imud watch: {name}: {words}")
            self._noted[name] = cause
        for name, count in self._dropped.items():
            complain(f"imud watch: the daemon dropped {count} samples of {name} because imud watch was too slow")
        self._dropped.clear()


def _condition(device: Mapping[str, Any]) -> tuple[str, str]:
    """Return a text that changes with the reasons of the condition, and the condition with its reasons. The first text
    is empty for a device that is OK, or whose daemon sends no condition."""
    found = device.get("condition")
    condition = None if found is None else decoded(found, DeviceCondition)
    causes = " ".join(sorted(code + setting for code, setting in signature(condition)))
    return causes, "ok" if not causes else str(condition)


# Log levels by the name of the priority, the highest priority first
PRIORITIES: Final = {"warning": logging.WARNING, "info": logging.INFO, "debug": logging.DEBUG}
DAEMON: Final = "imud"  # printed device name for events of the daemon itself


class PrintedEvent(msgspec.Struct, frozen=True, omit_defaults=True):
    """Output of `--json`: an event as the socket sends it, with local time and priority."""

    time: str  # local time with the offset from UTC, ISO 8601
    priority: str
    t_ns: int  # CLOCK_MONOTONIC when the daemon noticed the event, ns
    device: str  # empty for events of the daemon itself
    kind: str
    message: str
    detail: dict[str, str | int | float | bool | None] = {}
    count: int = 1  # number of equal events; `t_ns` and `message` belong to the last event
    first_ns: int = 0  # CLOCK_MONOTONIC of the first of them, ns; 0 for a single new event


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument(
        "--device", action="append", default=[], metavar="DEVICE",
        help="print events of this device and of the daemon; repeat for more devices (default: all devices)",
    )  # fmt: skip
    parser.add_argument(
        "--priority", choices=list(PRIORITIES), default="debug",
        help="lowest printed priority (default: %(default)s, which prints all events)",
    )  # fmt: skip
    parser.add_argument(
        "--since", type=duration_s, default=None, metavar="TIME",
        help="print the events of this time, for example 30min or 2d, then stop; --follow: then new events",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print one JSON object per line")
    parser.add_argument("--count", type=int, default=None, metavar="N", help="stop after N events")
    parser.add_argument("--follow", action="store_true", help="wait for the daemon, and continue after its restarts")


def run(args: argparse.Namespace) -> int:
    """Print events until Ctrl-C, until `--count` events, or until the daemon stops. `--follow` survives restarts."""
    keep_connected("imud events", args.socket, _Printer(args).work, follow=args.follow)
    return 0


class _Printer:
    """State of the command, across several connections."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._args = args
        self._left: int | None = args.count
        self._least = PRIORITIES[args.priority]

    def work(self, client: Client) -> None:
        """Print the events of one connection."""
        ahead_ns = clock_ahead_ns(client.status()["now_ns"])
        if self._args.since is not None:
            self._print_past(client, ahead_ns)
            if not self._args.follow:
                return
        events = client.events(self._args.device or None, timeout_s=LOOK_S)
        while self._left is None or self._left > 0:
            try:
                event = next(events)
            except TimeoutError:  # no event for LOOK_S: without a write, only this check finds a closed pipe
                raise_if_unread()
                continue
            self._print(event, ahead_ns)

    def _print_past(self, client: Client, ahead_ns: int) -> None:
        """Print the stored events of the requested time."""
        since_ns = time.monotonic_ns() + ahead_ns - int(self._args.since * NS_PER_S)
        past = client.past_events(since_ns, self._args.device or None)
        if past.since_ns > since_ns:
            ago = in_words(time.monotonic_ns() + ahead_ns - past.since_ns)
            complain(f"imud events: imud has all events of the last {ago}; for older events, run: journalctl -u imud")
        for event in past.events:
            if self._left != 0:
                self._print(event, ahead_ns)

    def _print(self, event: Event, ahead_ns: int) -> None:
        if level_of(event) < self._least:
            return
        show = as_json if self._args.json else as_text
        sys.stdout.write(show(printed(event, utc_offset_ns(ahead_ns))) + "\n")
        sys.stdout.flush()
        if self._left is not None:
            self._left -= 1


def level_of(event: Event) -> int:
    """Return the log level of this kind of event in the daemon; WARNING for an unknown kind."""
    return LEVELS.get(event.kind, logging.WARNING)


def printed(event: Event, utc_offset_ns: int) -> PrintedEvent:
    """Add local time and priority to an event. `utc_offset_ns` is CLOCK_REALTIME minus CLOCK_MONOTONIC."""
    level = level_of(event)
    priority = next(name for name, least in PRIORITIES.items() if level >= least)
    when = local_time(event.t_ns + utc_offset_ns).isoformat(timespec="milliseconds")
    made = PrintedEvent(when, priority, event.t_ns, event.device, str(event.kind), event.message, event.detail)
    if isinstance(event, StoredEvent) and event.count > 1:
        return msgspec.structs.replace(made, count=event.count, first_ns=event.first_ns)
    return made


def as_text(event: PrintedEvent) -> str:
    """Format an event as one line of printable characters."""
    repeated = f" (×{event.count} in {in_words(event.t_ns - event.first_ns)})" if event.count > 1 else ""
    line = f"{event.time} {event.priority:7} {event.device or DAEMON}: {event.kind}: {event.message}{repeated}"
    return printable(line, MESSAGE_CHARACTERS_MAX)


def as_json(event: PrintedEvent) -> str:
    """Format an event as one JSON object."""
    return printable_json(event)


EVENTS = CliCommand(add_arguments, run)
