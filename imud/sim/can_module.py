"""Simulated devices on a CAN bus: their contract, their wire, and their common parts.

CanModule           contract: receives frames of other nodes, returns sent frames
FrameWire           sends frames one after the other at the bit rate of the bus
PeriodicCanModule   device that only sends, with the same frames in each period
CanModules          several devices on one bus, with the interface of one device
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

# Mean number of stuff bits in a frame. The model ignores that frames with fewer than eight bytes are shorter.
STUFF_BITS: Final = 9
BITRATE: Final = 500_000
DATA_PHASE: Final = 4  # bit rate of the data after the eighth byte of a CAN FD frame, in bit rates (assumption)


class SentFrame(NamedTuple):
    """A frame that was sent completely."""

    due_ns: int  # CLOCK_MONOTONIC of the end of the frame
    can_id: int  # identifier
    extended: bool  # True for a 29-bit identifier
    data: bytes  # 0 to 8 bytes; 0 to 64 bytes for CAN FD
    sample_ns: int | None = None  # CLOCK_MONOTONIC of the measurement; None if the frame contains no measurement


class CanModule(Protocol):
    """A simulated device. Times are CLOCK_MONOTONIC in ns and never go backwards. Synchronization: one thread."""

    epoch_ns: int  # zero of the motion, ns: the truth at an instant is `motion.at((instant - epoch_ns) / 1e9)`

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Receive a frame of another node."""
        ...

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return the frames sent since the last call, in order."""
        ...

    def next_ns(self) -> int | None:
        """Return the time of the next frame of `advance`; None if no frame is due."""
        ...

    def counters(self) -> dict[str, int]:
        """Return the counters of the device by name."""
        ...

    def mark(self, now_ns: int) -> None:
        """Send a rising edge to the sync input. A device without this input ignores it."""
        ...

    def reboot(self, now_ns: int) -> None:
        """Restart after a power failure. The device loses unsaved settings."""
        ...


@dataclass(frozen=True, slots=True)
class CanSimulator:
    """Row of a simulated CAN device."""

    name: str  # name of the driver of the device
    title: str  # name of the product
    # Function that makes the device, with power on at the given CLOCK_MONOTONIC. Raises ValueError for unsupported
    # options.
    make: Callable[[SimulatorOptions, int], CanModule]
    interface: int = 0  # interface version for which another package was written; 0 for simulators of imud


class FrameWire:
    """The wire of a CAN bus. It sends the frames of a device in sequence at the bit rate."""

    def __init__(self, bitrate: int, free_ns: int) -> None:
        """`bitrate` 0: frames take no time, so that frames of one instant leave together. The wire is busy until
        `free_ns`."""
        # time of a frame with 8 bytes and an identifier of 11 bits, of 29 bits, ns
        self.frame_ns, self.extended_ns = (
            (frame_bits(extended, DATA_BYTES_MAX) + STUFF_BITS) * NS_PER_S // bitrate if bitrate else 0
            for extended in (False, True)
        )
        self._byte_ns = 8 * NS_PER_S // (bitrate * DATA_PHASE) if bitrate else 0
        self._free_ns = free_ns
        self._waiting: deque[SentFrame] = deque()

    def frame_time_ns(self, extended: bool, data_bytes: int) -> int:
        """Return the time of a frame on the wire, ns."""
        more_bytes = max(data_bytes - DATA_BYTES_MAX, 0)
        return (self.extended_ns if extended else self.frame_ns) + more_bytes * self._byte_ns

    def send(self, ready_ns: int, can_id: int, extended: bool, data: bytes, sample_ns: int | None = None) -> None:
        """Queue a frame that is ready at `ready_ns`."""
        self._free_ns = max(ready_ns, self._free_ns) + self.frame_time_ns(extended, len(data))
        self._waiting.append(SentFrame(self._free_ns, can_id, extended, data, sample_ns))

    def sent(self, now_ns: int) -> list[SentFrame]:
        """Return and remove the frames that were sent completely until now."""
        done: list[SentFrame] = []
        while self._waiting and self._waiting[0].due_ns <= now_ns:
            done.append(self._waiting.popleft())
        return done

    def next_ns(self) -> int | None:
        """Return the end of the next frame; None if the queue is empty."""
        return self._waiting[0].due_ns if self._waiting else None


class PeriodicCanModule:
    """A device that samples at whole periods of its own crystal, sends each sample immediately, and accepts no
    commands.

    Its power is on from the start. Synchronization: one thread.
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
        """`encode` returns the frames (identifier, data) of a sample from its number and its measurement. Numbers start
        at `first_number` after the first power-on, at 0 after a restart."""
        self.epoch_ns: int = now_ns  # zero of the motion, CLOCK_MONOTONIC
        self.samples_sent: int = 0  # number of samples
        self.frames_sent: int = 0  # number of frames
        self._hardware, self._encode, self._extended = hardware, encode, extended
        self._period_ns = NS_PER_S / rate_hz / (1 + hardware.skew_ppm * 1e-6)
        self._bitrate = bitrate
        self._power_on(now_ns, first_number)

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Ignore a frame of another node."""

    def mark(self, now_ns: int) -> None:
        """Do nothing: the device has no sync input."""

    def reboot(self, now_ns: int) -> None:
        """Restart after a power failure. Sample numbers start at 0 again."""
        self._power_on(now_ns, 0)

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return the frames sent since the last call, in order."""
        while (sample_ns := self._sample_ns()) <= now_ns:
            reading = self._hardware.reading((sample_ns - self.epoch_ns) / NS_PER_S)
            for can_id, data in self._encode(self._first_number + self._sampled, reading):
                self._wire.send(sample_ns + self._hardware.processing_ns, can_id, self._extended, data, sample_ns)
                self.frames_sent += 1
            self._sampled += 1
            self.samples_sent += 1
        return self._wire.sent(now_ns)

    def next_ns(self) -> int | None:
        """Return the time of the next frame of `advance`."""
        waiting = self._wire.next_ns()
        if waiting is not None:
            return waiting
        frame_ns = self._wire.extended_ns if self._extended else self._wire.frame_ns
        return self._sample_ns() + self._hardware.processing_ns + frame_ns

    def counters(self) -> dict[str, int]:
        """Return the numbers of samples and frames by name."""
        return {"samples_sent": self.samples_sent, "frames_sent": self.frames_sent}

    def _power_on(self, now_ns: int, first_number: int) -> None:
        self._begin_ns = now_ns + self._hardware.boot_ms * NS_PER_MS
        self._first_number = first_number
        self._sampled = 0
        self._wire = FrameWire(self._bitrate, self._begin_ns)

    def _sample_ns(self) -> int:
        return self._begin_ns + round(self._sampled * self._period_ns)


class CanModules:
    """Several devices on a bus with the interface of one device (`CanModule`). Synchronization: one thread."""

    def __init__(self, modules: Sequence[CanModule]) -> None:
        """Raises ValueError if `modules` is empty."""
        if not modules:
            raise ValueError("expected at least one device, got none")
        self.modules: tuple[CanModule, ...] = tuple(modules)  # the devices
        self.epoch_ns: int = modules[0].epoch_ns  # zero of the motion of the first device, CLOCK_MONOTONIC

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Pass a frame of another node to all devices."""
        for module in self.modules:
            module.receive(can_id, extended, data, now_ns)

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return the frames sent since the last call. Frames of one instant are in the order of the devices."""
        sent = [module.advance(now_ns) for module in self.modules]
        for sender, frames in zip(self.modules, sent, strict=True):
            for frame in frames:
                self._others_hear(sender, frame, now_ns)
        return list(merge(*sent, key=lambda frame: frame.due_ns))

    def next_ns(self) -> int | None:
        """Return the time of the next frame of `advance`; None if no frame is due."""
        return min((due_ns for module in self.modules if (due_ns := module.next_ns()) is not None), default=None)

    def counters(self) -> dict[str, int]:
        """Return the sums of the counters."""
        total: dict[str, int] = {}
        for module in self.modules:
            for name, value in module.counters().items():
                total[name] = total.get(name, 0) + value
        return total

    def mark(self, now_ns: int) -> None:
        """Send a rising edge to the sync inputs. One wire connects them."""
        for module in self.modules:
            module.mark(now_ns)

    def reboot(self, now_ns: int) -> None:
        """Restart all devices after a power failure."""
        for module in self.modules:
            module.reboot(now_ns)

    def _others_hear(self, sender: CanModule, frame: SentFrame, now_ns: int) -> None:
        for module in self.modules:
            if module is not sender:
                module.receive(frame.can_id, frame.extended, frame.data, now_ns)
