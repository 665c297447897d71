"""The state of a CAN controller, from the error frames that the kernel hands to a raw socket (linux/can/error.h)."""

from enum import IntEnum
from typing import Final

CLASS_CONTROLLER: Final = 0x0004
CLASS_BUS_OFF: Final = 0x0040
CLASS_RESTARTED: Final = 0x0100
WATCHED: Final = CLASS_CONTROLLER | CLASS_BUS_OFF | CLASS_RESTARTED
"""Classes to subscribe to. Single errors of the bus are not among them: a bad cable makes thousands a second."""

RECEIVE_OVERFLOW: Final = 0x01
WARNING: Final = 0x04 | 0x08
PASSIVE: Final = 0x10 | 0x20
ACTIVE: Final = 0x40
"""Bits of the second data byte, for receiver and transmitter."""


class ControllerState(IntEnum):
    """Error states of a CAN controller, numbered as `enum can_state` of linux/can/netlink.h."""

    ACTIVE = 0
    """Takes part in all traffic."""
    WARNING = 1
    """An error counter is above 96."""
    PASSIVE = 2
    """An error counter is above 127: it may not disturb others any more."""
    BUS_OFF = 3
    """The transmit error counter is above 255: it has left the bus."""


_WORDS: Final = {
    ControllerState.ACTIVE: "error-active again",
    ControllerState.WARNING: "near its error limit (warning)",
    ControllerState.PASSIVE: "error-passive",
    ControllerState.BUS_OFF: "bus-off",
}
_HELP: Final = {
    ControllerState.PASSIVE: "do all nodes have the same bit rate, is the bus terminated at both ends?",
    ControllerState.BUS_OFF: (
        "it left the bus; `ip link set {name} down`, then `ip link set {name} up type can restart-ms 100` let it "
        "recover by itself"
    ),
}


class BusState:
    """The state of one interface's controller, with counts of its error-passive and bus-off states."""

    def __init__(self, name: str, state: int | None = None) -> None:
        """`state` as the kernel numbers it; None where it reports none (virtual interfaces)."""
        self._name = name
        known = state is not None and state in ControllerState.__members__.values()
        self.state = ControllerState(state) if known else ControllerState.ACTIVE  # type: ignore[arg-type]  # not None
        self.passive_count = 0
        self.bus_off_count = 0
        self.overflows = 0
        """Times the controller's own receive buffer ran over."""

    @property
    def problem(self) -> str:
        """Describe the fault in one sentence; empty in the states error-active and warning."""
        advice = _HELP.get(self.state)
        return f"{self._name} is {_WORDS[self.state]}: {advice.format(name=self._name)}" if advice else ""

    def add_error_frame(self, classes: int, data: bytes) -> str:
        """Record an error frame; return the change of state in it, one sentence, or an empty text."""
        status = data[1] if classes & CLASS_CONTROLLER else 0
        if status & RECEIVE_OVERFLOW:
            self.overflows += 1
        state = self._named(classes, status)
        if state is None or state is self.state:
            return ""
        self.passive_count += state is ControllerState.PASSIVE
        self.bus_off_count += state is ControllerState.BUS_OFF
        self.state = state
        return self.problem or f"{self._name} is {_WORDS[state]}"

    def _named(self, classes: int, status: int) -> ControllerState | None:
        """The state that an error frame names, or None."""
        if classes & CLASS_BUS_OFF:
            return ControllerState.BUS_OFF
        if status & PASSIVE:
            return ControllerState.PASSIVE
        if status & WARNING:
            return ControllerState.WARNING
        if status & ACTIVE or classes & CLASS_RESTARTED:
            return ControllerState.ACTIVE
        return None
