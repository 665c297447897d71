"""Simulated devices on a CAN bus: their contract, their wire, and their common parts.

CanModule           the contract: frames of others in, frames that crossed the wire out
FrameWire           one frame after the other at the bit rate of the bus
PeriodicCanModule   a module that only sends, the same frames at every period
CanModules          several modules on one bus, in the shape of a single one
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from heapq import merge
from typing import Final, NamedTuple, Protocol

from imud.formats.can import DATA_BYTES_MAX, frame_bits
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.physics import Truth
from imud.sim.sensor import SensorHardware, SimulatorOptions

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
        """Receive a frame of another device."""
        ...

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return what has crossed the wire since the last call, in order."""
        ...

    def next_ns(self) -> int | None:
        """Time of the next output of `advance`; None for none."""
        ...

    def counters(self) -> dict[str, int]:
        """Return the module's own counters, by name."""
        ...

    def mark(self, now_ns: int) -> None:
        """Pulse its sync input (a rising edge); ignored by a device without one."""
        ...

    def reboot(self, now_ns: int) -> None:
        """Restart after a loss of power: unsaved settings are lost."""
        ...


@dataclass(frozen=True, slots=True)
class CanSimulator:
    """Row of a simulated CAN device."""

    name: str
    """Name of the driver of the device."""
    title: str
    """The product, for people."""
    make: Callable[[SimulatorOptions, int], CanModule]
    """Makes the module, powered on at the given CLOCK_MONOTONIC. Raises ValueError for options it cannot have."""


class FrameWire:
    """The wire of a CAN bus: one frame after the other at the bit rate; frames of one device never overlap."""

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
        """Return and remove the frames that have crossed the wire by now."""
        done: list[SentFrame] = []
        while self._waiting and self._waiting[0].due_ns <= now_ns:
            done.append(self._waiting.popleft())
        return done

    def next_ns(self) -> int | None:
        """Time at which the next frame is through; None if none waits."""
        return self._waiting[0].due_ns if self._waiting else None


class PeriodicCanModule:
    """A device that samples at whole periods of its own crystal, sends every sample at once, and takes no commands.

    It is powered on when it is made. Synchronization: one thread.
    """

    def __init__(
        self,
        now_ns: int,
        hardware: SensorHardware,
        rate_hz: float,
        bitrate: int,
        encode: Callable[[int, Truth], Sequence[tuple[int, bytes]]],
        *,
        extended: bool = False,
        first_number: int = 0,
    ) -> None:
        """`encode` makes the frames (identifier, data) of a sample from its number and reading. Numbers count from
        `first_number` after the first power-on, from 0 after a restart."""
        self.epoch_ns = now_ns
        self.samples_sent = 0
        self.frames_sent = 0
        self._hardware, self._encode, self._extended = hardware, encode, extended
        self._period_ns = NS_PER_S / rate_hz / (1 + hardware.skew_ppm * 1e-6)
        self._bitrate = bitrate
        self._power_on(now_ns, first_number)

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Ignore frames of other devices."""

    def mark(self, now_ns: int) -> None:
        """Ignore the edge: there is no sync input on this port."""

    def reboot(self, now_ns: int) -> None:
        """Restart after a loss of power: samples are numbered from 0 again."""
        self._power_on(now_ns, 0)

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return what has crossed the wire since the last call, in order."""
        while (sample_ns := self._sample_ns()) <= now_ns:
            reading = self._hardware.reading((sample_ns - self.epoch_ns) / NS_PER_S)
            for can_id, data in self._encode(self._first_number + self._sampled, reading):
                self._wire.send(sample_ns + self._hardware.processing_ns, can_id, self._extended, data, sample_ns)
                self.frames_sent += 1
            self._sampled += 1
            self.samples_sent += 1
        return self._wire.sent(now_ns)

    def next_ns(self) -> int | None:
        """Time of the next output of `advance`; None for none."""
        waiting = self._wire.next_ns()
        if waiting is not None:
            return waiting
        frame_ns = self._wire.extended_ns if self._extended else self._wire.frame_ns
        return self._sample_ns() + self._hardware.processing_ns + frame_ns

    def counters(self) -> dict[str, int]:
        """Samples and frames sent."""
        return {"samples_sent": self.samples_sent, "frames_sent": self.frames_sent}

    def _power_on(self, now_ns: int, first_number: int) -> None:
        self._begin_ns = now_ns + self._hardware.boot_ms * NS_PER_MS
        self._first_number = first_number
        self._sampled = 0
        self._wire = FrameWire(self._bitrate, self._begin_ns)

    def _sample_ns(self) -> int:
        return self._begin_ns + round(self._sampled * self._period_ns)


class CanModules:
    """Modules that share a bus, in the shape of a single one (`CanModule`). Synchronization: one thread."""

    def __init__(self, modules: Sequence[CanModule]) -> None:
        """Raises ValueError without any module."""
        if not modules:
            raise ValueError("expected at least one module")
        self.modules = tuple(modules)
        self.epoch_ns = modules[0].epoch_ns

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Pass a frame to every module."""
        for module in self.modules:
            module.receive(can_id, extended, data, now_ns)

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return the frames through since the last call; those of the same moment in the order of the modules."""
        sent = [module.advance(now_ns) for module in self.modules]
        for sender, frames in zip(self.modules, sent, strict=True):
            for frame in frames:
                self._others_hear(sender, frame, now_ns)
        return list(merge(*sent, key=lambda frame: frame.due_ns))

    def next_ns(self) -> int | None:
        """Earliest time of output of all modules."""
        return min((due_ns for module in self.modules if (due_ns := module.next_ns()) is not None), default=None)

    def counters(self) -> dict[str, int]:
        """Sums of the modules' counters."""
        total: dict[str, int] = {}
        for module in self.modules:
            for name, value in module.counters().items():
                total[name] = total.get(name, 0) + value
        return total

    def mark(self, now_ns: int) -> None:
        """Pulse the sync inputs, which are wired together."""
        for module in self.modules:
            module.mark(now_ns)

    def reboot(self, now_ns: int) -> None:
        """Power all modules off."""
        for module in self.modules:
            module.reboot(now_ns)

    def _others_hear(self, sender: CanModule, frame: SentFrame, now_ns: int) -> None:
        for module in self.modules:
            if module is not sender:
                module.receive(frame.can_id, frame.extended, frame.data, now_ns)
