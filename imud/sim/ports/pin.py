"""Pins of a simulated device: what it does on single wires beside its data, without I/O."""

from enum import StrEnum
from typing import NamedTuple, Protocol, runtime_checkable


class Pin(StrEnum):
    """Outputs, by the names that lines have in the configuration."""

    SOUT = "sout"
    """High before each frame; the frame follows the falling edge."""
    SOUT_DIV = "sout_div"
    """Every n-th pulse of SOUT."""
    ALARM = "alarm"
    """High while an angle is out of range."""


class PinEdge(NamedTuple):
    """One change of a pin's level."""

    due_ns: int
    """CLOCK_MONOTONIC of the change."""
    pin: Pin
    rising: bool
    sample_ns: int | None = None
    """CLOCK_MONOTONIC of the measurement whose frame follows; None where none does."""


@runtime_checkable
class PinModule(Protocol):
    """A simulated device with pins. Its inputs are methods (`mark`), times as in `StreamModule`."""

    def pins(self, now_ns: int) -> list[PinEdge]:
        """Return the edges since the last call, in order. All pins are low in the beginning."""
        ...

    def next_pin_ns(self) -> int | None:
        """When `pins` may have something next, or None while nothing is to come."""
        ...
