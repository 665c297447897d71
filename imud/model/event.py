"""Events of a device other than samples, for subscribers and the log."""

import logging
from enum import StrEnum
from typing import Final, Protocol, cast

import msgspec


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
    # Gravity at rest contradicts the attitude or the mounting. The message contains the likely cause.
    ATTITUDE = "attitude"
    RECORDER = "recorder"  # the recorder stopped (for example: full disk), continued, lost records, or saved a snapshot
    MQTT = "mqtt"  # the output `mqtt` stopped spooling (for example: full disk) or continued
    OUTPUT = (
        "output"  # an exception in an output. imud starts this output again; the devices and other outputs continue.
    )
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
}


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """Event of one device, or of the daemon if `device` is empty."""

    t_ns: int  # CLOCK_MONOTONIC at the detection of the event
    device: str
    kind: EventKind
    message: str  # Description, one sentence
    detail: dict[str, str | int | float | bool | None] = {}  # msgspec copies a mutable default


class RaiseEvent(Protocol):
    """Function that sends and logs one event of one device."""

    def __call__(
        self, now_ns: int, kind: EventKind, message: str, /, **detail: str | int | float | bool | None
    ) -> None:
        """Raise an event at `now_ns` (CLOCK_MONOTONIC) with one sentence for the user and details by name."""
        ...
