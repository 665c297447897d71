"""Events of a device other than samples, for subscribers and the log."""

import logging
from collections.abc import Collection, Iterator
from enum import StrEnum
from heapq import merge
from itertools import islice, takewhile
from typing import Final, Protocol, cast

import msgspec

from imud.model.units import NS_PER_S


class EventKind(StrEnum):
    """Kinds of events. Readers must accept unknown kinds."""

    UP = "up"  # imud found and identified the device; samples follow
    DOWN = "down"  # the device or its link is absent; `detail` contains the reason
    # The condition of the device or its reasons changed. `detail` contains the condition and the codes of the reasons.
    CONDITION = "condition"
    SYNC = "sync"  # the source of time stamps changed
    # Samples were lost; `detail` contains their number and the cause. At most once per second and device.
    LOSS = "loss"
    CONFIGURATION = "configuration"  # the device settings or the configuration of the daemon changed
    ALARM = "alarm"  # the ALARM line or the alarm status of a device changed
    MARK = "mark"  # a pulse arrived on SOUT_DIV. `detail` contains its time, its number and the `seq` of its sample.
    # The state of the port or bus changed, for example a CAN controller became error-passive. The device may continue.
    LINK = "link"
    # Progress of a guided calibration. `detail` contains kind, phase and measured values. At most twice per second.
    CALIBRATION = "calibration"
    # Progress of a firmware update. `detail` contains phase and progress, 0 … 1. At most twice per second and phase.
    FIRMWARE = "firmware"
    # Gravity at rest contradicts the attitude or the mounting. The message contains the likely cause.
    ATTITUDE = "attitude"
    RECORDER = "recorder"  # the recorder stopped (for example: full disk), continued, lost records, or saved a snapshot
    MQTT = "mqtt"  # the output `mqtt` stopped spooling (for example: full disk) or continued
    # An exception in an output. imud starts this output again; the devices and other outputs continue.
    OUTPUT = "output"
    # A rule of the output `rules` became active or ended (`detail.active`), or its command failed
    RULE = "rule"
    BAD_FRAME = "bad-frame"  # imud received a damaged or unknown frame. At most once per second and device.


def kind_of(name: str) -> EventKind:
    """Return the kind with this name; for an unknown kind, return the name."""
    return EventKind(name) if name in EventKind.__members__.values() else cast("EventKind", name)


# kinds without an entry have the level of a warning
LEVELS: Final = {
    EventKind.UP: logging.INFO,
    EventKind.SYNC: logging.INFO,
    EventKind.CONDITION: logging.INFO,  # the causes have events of their own
    EventKind.MARK: logging.DEBUG,  # as frequent as camera triggers
    EventKind.CALIBRATION: logging.DEBUG,  # twice per second during a calibration
    EventKind.FIRMWARE: logging.DEBUG,  # twice per second during an update
}


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """Event of one device, or of the daemon if `device` is empty."""

    t_ns: int  # CLOCK_MONOTONIC at the detection of the event
    device: str  # name of the device; empty for the daemon
    kind: EventKind  # kind of the event; a string if a newer daemon sends a kind that this version does not know
    message: str  # description, one sentence
    detail: dict[str, str | int | float | bool | None] = {}  # msgspec copies a mutable default
    """Values by name, which depend on the kind."""


class StoredEvent(Event, frozen=True, omit_defaults=True):
    """Group of equal events of one device. `t_ns`, `message` and `detail` belong to the newest event."""

    count: int = 1  # number of events in the group
    first_ns: int = 0  # CLOCK_MONOTONIC of the first event of the group


class PastEvents(msgspec.Struct, frozen=True):
    """Stored events, the oldest first."""

    events: list[StoredEvent] = []  # msgspec copies a mutable default
    """Groups of events."""
    # CLOCK_MONOTONIC since which `events` has all events. It is later than requested if imud started later, or if it
    # removed older events.
    since_ns: int = 0


EVENTS_MAX: Final = 1000  # maximum number of stored groups of a device
GROUP_NS: Final = 60 * NS_PER_S  # maximum time between two events of a group, ns
# Kinds whose messages contain counts: all events of the kind are equal
COUNTED: Final = frozenset((EventKind.LOSS, EventKind.BAD_FRAME, EventKind.MARK))

_Key = tuple[str, ...]


class EventLog:
    """Newest events of all devices and of the daemon, repeated events as groups. Synchronization: one thread."""

    def __init__(self, begun_ns: int = 0) -> None:
        self._begun_ns = begun_ns
        self._removed_ns: dict[str, int] = {}  # time of the newest removed event by device
        # By device: groups by number in the order of their newest events, and number of the newest group of each key
        self._devices: dict[str, tuple[dict[int, StoredEvent], dict[_Key, int]]] = {}
        self._made = 0  # number of groups since start

    def add(self, event: Event) -> None:
        """Store an event, and remove the oldest groups of its device above EVENTS_MAX."""
        groups, newest = self._devices.setdefault(event.device, ({}, {}))
        key, self._made = _group_key(event), self._made + 1
        number = newest.get(key, 0)
        before = groups.get(number)
        count, first_ns = 1, event.t_ns
        if before is not None and event.t_ns - before.t_ns <= GROUP_NS:
            del groups[number]
            count, first_ns = before.count + 1, before.first_ns
        newest[key] = self._made
        groups[self._made] = StoredEvent(
            event.t_ns, event.device, event.kind, event.message, event.detail, count=count, first_ns=first_ns
        )
        if len(groups) > EVENTS_MAX:
            number, oldest = next(iter(groups.items()))
            del groups[number]
            self._removed_ns[event.device] = oldest.t_ns
            if newest.get(_group_key(oldest)) == number:
                del newest[_group_key(oldest)]

    def remove(self, device: str) -> None:
        """Remove the events of a device that left the configuration."""
        self._devices.pop(device, None)
        self._removed_ns.pop(device, None)

    def newest(self, since_ns: int, limit: int, devices: Collection[str] | None = None) -> PastEvents:
        """Return the newest groups since `since_ns`, at most `limit`, the oldest first. None: of all devices."""

        def of(device: str) -> Iterator[StoredEvent]:
            return takewhile(lambda one: one.t_ns >= since_ns, reversed(self._devices[device][0].values()))

        names = [device for device in self._devices if devices is None or not device or device in devices]
        found = list(islice(merge(*map(of, names), key=lambda one: -one.t_ns), limit + 1))
        absent_ns = [self._removed_ns[name] for name in names if name in self._removed_ns]
        if len(found) > limit:
            absent_ns.append(found.pop().t_ns)
        return PastEvents(found[::-1], max(since_ns, self._begun_ns, *(one + 1 for one in absent_ns)))


def _group_key(event: Event) -> _Key:
    """Return the key of the group of an event: equal events have equal keys."""
    if event.kind in (EventKind.CALIBRATION, EventKind.FIRMWARE):
        return event.kind, str(event.detail.get("kind")), str(event.detail.get("phase"))
    return (event.kind,) if event.kind in COUNTED else (event.kind, event.message)


class RaiseEvent(Protocol):
    """Function that sends and logs one event of one device."""

    def __call__(
        self, now_ns: int, kind: EventKind, message: str, /, **detail: str | int | float | bool | None
    ) -> None:
        """Raise an event at `now_ns` (CLOCK_MONOTONIC) with one sentence for the user and details by name."""
        ...
