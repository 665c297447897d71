"""What a simulated device on a CAN bus is: without I/O, driven by an explicit clock; and its way to the wire."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from imud.formats.can import DATA_BYTES_MAX, frame_bits
from imud.sim.simulator import SimulatorOptions
from imud.units import NS_PER_S

STUFF_BITS: Final = 9
"""Of a frame with average data. Frames with fewer than eight bytes take as long here as those with eight."""
BITRATE: Final = 500_000


class SentFrame(NamedTuple):
    """A frame that has crossed the wire."""

    due_ns: int
    """CLOCK_MONOTONIC of its end."""
    can_id: int
    extended: bool
    data: bytes
    sample_ns: int | None = None
    """CLOCK_MONOTONIC of the instant of measurement; None for what is no measurement."""


class CanModule(Protocol):
    """A simulated device. Times are CLOCK_MONOTONIC in ns and never go backwards. Synchronization: one thread."""

    epoch_ns: int
    """Zero of its motion: truth at an instant is `motion.at((instant - epoch_ns) / 1e9)`."""

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Take a frame that somebody else sent."""
        ...

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return what has crossed the wire since the last call, in order."""
        ...

    def next_ns(self) -> int | None:
        """When `advance` will have something next, or None while nothing is to come."""
        ...

    def counters(self) -> dict[str, int]:
        """What it counts of itself, by name."""
        ...

    def mark(self, now_ns: int) -> None:
        """A rising edge on its sync input; ignored by a device without one."""
        ...

    def reboot(self, now_ns: int) -> None:
        """Power was lost and came back: what was not saved is gone."""
        ...


@dataclass(frozen=True, slots=True)
class CanSimulator:
    """The row a simulated CAN device's file ends with."""

    name: str
    """Name of the driver it stands in for."""
    title: str
    """The product, for people."""
    make: Callable[[SimulatorOptions, int], CanModule]
    """Makes the module, powered on at the given CLOCK_MONOTONIC. Raises ValueError for options it cannot have."""


class FrameWire:
    """One frame after the other at the rate of the bus; frames of one device never overlap."""

    def __init__(self, bitrate: int, free_ns: int) -> None:
        """`bitrate` 0: frames take no time, so that those of one instant leave together. `free_ns`: nothing before."""
        self.frame_ns, self.extended_ns = (
            (frame_bits(extended, DATA_BYTES_MAX) + STUFF_BITS) * NS_PER_S // bitrate if bitrate else 0
            for extended in (False, True)
        )
        self._free_ns = free_ns
        self._waiting: deque[SentFrame] = deque()

    def send(self, ready_ns: int, can_id: int, extended: bool, data: bytes, sample_ns: int | None = None) -> None:
        """Queue a frame that is ready then."""
        self._free_ns = max(ready_ns, self._free_ns) + (self.extended_ns if extended else self.frame_ns)
        self._waiting.append(SentFrame(self._free_ns, can_id, extended, data, sample_ns))

    def sent(self, now_ns: int) -> list[SentFrame]:
        """Take out what has crossed the wire by now."""
        done: list[SentFrame] = []
        while self._waiting and self._waiting[0].due_ns <= now_ns:
            done.append(self._waiting.popleft())
        return done

    def next_ns(self) -> int | None:
        """When the next frame is through, None if none waits."""
        return self._waiting[0].due_ns if self._waiting else None
