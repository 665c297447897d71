"""Contract: events of a device other than samples, delivered to subscribers and to the log."""

import logging
from enum import StrEnum
from typing import Final, Protocol, cast

import msgspec


class EventKind(StrEnum):
    """Kinds of events; readers must accept kinds they do not know."""

    UP = "up"
    """The device is found and identified; samples follow."""
    DOWN = "down"
    """The device or its link is gone; `detail` has the reason."""
    SYNC = "sync"
    """The source of time stamps changed."""
    LOSS = "loss"
    """Samples were lost; `detail` has their number and cause. Sent at most once a second and device."""
    CONFIGURATION = "configuration"
    """The device's own settings, or the daemon's configuration, are not what they were."""
    ALARM = "alarm"
    """The alarm line or the alarm status of a device changed."""
    MARK = "mark"
    """A pulse came on SOUT_DIV: `detail` has its time, its number, and the `seq` of the sample it belongs to."""
    LINK = "link"
    """The state of the port or bus changed, though the device may go on: a CAN controller became error-passive."""
    CALIBRATION = "calibration"
    """Progress of a guided calibration; `detail` has kind, phase, and what was measured. At most twice a second."""
    ATTITUDE = "attitude"
    """Gravity contradicts the attitude or the mounting at rest; the message says what is likely wrong."""
    RECORDER = "recorder"
    """The recorder stopped, for example because the disk is full, went on, lost records, or saved a snapshot."""
    MQTT = "mqtt"
    """The output `mqtt` stopped spooling, for example because the disk is full, or went on."""
    BAD_FRAME = "bad-frame"
    """A damaged or unknown frame was heard. Sent at most once a second and device."""


def kind_of(name: str) -> EventKind:
    """Return the kind of this name; one that this imud does not know stays a plain string."""
    return EventKind(name) if name in EventKind.__members__.values() else cast("EventKind", name)


LEVELS: Final = {
    EventKind.UP: logging.INFO,
    EventKind.SYNC: logging.INFO,
    EventKind.MARK: logging.DEBUG,
    EventKind.CALIBRATION: logging.DEBUG,
}
"""Kinds below a warning; marks are as frequent as camera triggers, progress of a calibration comes twice a second."""


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """An event of one device, or of the daemon itself when `device` is empty."""

    t_ns: int
    """CLOCK_MONOTONIC when it was noticed."""
    device: str
    kind: EventKind
    message: str
    """Description, one sentence."""
    detail: dict[str, str | int | float | bool | None] = {}  # msgspec copies a mutable default


class RaiseEvent(Protocol):
    """Function that sends and logs one event of one device."""

    def __call__(
        self, now_ns: int, kind: EventKind, message: str, /, **detail: str | int | float | bool | None
    ) -> None:
        """At `now_ns` (CLOCK_MONOTONIC): one sentence for people, and details by name."""
        ...
