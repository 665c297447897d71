"""Sensor of a simulated device: the motion that it measures, its noise and its crystal; made from the options."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol, TypedDict

from imud.sim.physics import GRAVITY_M_S2, MOTIONS, Motion, Noise, Truth, swing


class Burst(NamedTuple):
    """Bytes that leave the device in one piece."""

    due_ns: int
    """CLOCK_MONOTONIC at which the last byte has crossed the wire."""
    data: bytes
    sample_ns: int | None = None
    """CLOCK_MONOTONIC of the instant of measurement; None for text."""
    device_ms: int | None = None
    """Device time of that instant in ms of its own crystal since power-on, not wrapped."""


class StreamModule(Protocol):
    """A simulated device. Times are CLOCK_MONOTONIC in ns and never go backwards. Synchronization: one thread."""

    @property
    def baud(self) -> int:
        """Rate in bit/s at which it sends and listens now."""
        ...

    epoch_ns: int
    """Zero of its motion: truth at an instant is `motion.at((instant - epoch_ns) / 1e9)`."""

    def receive(self, data: bytes, now_ns: int) -> None:
        """Receive bytes that the host sent, already sampled at the device's rate."""
        ...

    def advance(self, now_ns: int) -> list[Burst]:
        """Return what has left the wire since the last call, in order."""
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
        """Restart after a loss of power or by a command: unsaved settings are lost."""
        ...


@dataclass(frozen=True, slots=True)
class SimulatorOptions:
    """Options of every simulated device."""

    rate_hz: float = 100.0
    """Samples per second of the device's own time."""
    baud: int = 0
    """Rate of the port in bit/s; 0 for the slowest common one that carries the samples."""
    message: str = ""
    """Name of the message to send, empty for the factory's choice."""
    motion: str = "swing"
    """A row of `imud.sim.physics.MOTIONS`."""
    gravity_m_s2: float = GRAVITY_M_S2
    noise: Literal["real", "none"] = "real"
    skew_ppm: float = 20.0
    """Rate error of the device's crystal against the host's clock, 1e-6."""
    firmware: int = 0
    """Firmware version as the device states it, 0 for a common one."""
    boot_ms: int = 500
    """Silence after power-on and reboot."""
    processing_ns: int = 125_000
    """Time from the instant of measurement to the first bit on the wire."""
    seed: int = 1
    node: int = 0
    """Which of several devices of a bus it is: node, address or first identifier, as its driver counts; 0 for the
    factory's."""
    at_once: bool = False
    """Whether the frames of a CAN device leave without the pauses that a bit rate makes, as on a virtual bus."""

    def bitrate(self, common: int) -> int:
        """Bit rate of a CAN device, bit/s: `baud`, or the common one; 0 for frames that take no time."""
        return 0 if self.at_once else self.baud or common


@dataclass(frozen=True, slots=True)
class Simulator:
    """Row of a simulated device."""

    name: str
    """Name of the driver of the device."""
    title: str
    """The product, for people."""
    make: Callable[[SimulatorOptions, int], StreamModule]
    """Makes the module, powered on at the given CLOCK_MONOTONIC. Raises ValueError for options it cannot have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorHardware:
    """Hardware of every simulated sensor, whatever its link."""

    motion: Motion = field(default_factory=swing)
    noise: Noise | None = None
    skew_ppm: float = 20.0
    """Rate error of the crystal against the host's clock, 1e-6."""
    boot_ms: int = 500
    """Silence after power-on and reboot."""
    processing_ns: int = 125_000
    """From the instant of measurement to the first bit on the wire."""

    def reading(self, t_s: float) -> Truth:
        """Measured values `t_s` seconds after the zero of the motion."""
        truth = self.motion.at(t_s)
        return self.noise.add(truth, t_s) if self.noise else truth


class SensorFields(TypedDict):
    """Fields of `SensorHardware` by name."""

    motion: Motion
    noise: Noise | None
    skew_ppm: float
    boot_ms: int
    processing_ns: int


def sensor_of(options: SimulatorOptions) -> SensorFields:
    """The sensor from the common options. Raises ValueError for an unknown motion."""
    return {
        "motion": motion_of(options),
        "noise": noise_of(options),
        "skew_ppm": options.skew_ppm,
        "boot_ms": options.boot_ms,
        "processing_ns": options.processing_ns,
    }


def motion_of(options: SimulatorOptions) -> Motion:
    """The motion by its name. Raises ValueError for an unknown one."""
    if options.motion not in MOTIONS:
        raise ValueError(f"motion {options.motion!r}: expected {' or '.join(MOTIONS)}")
    return MOTIONS[options.motion](options.gravity_m_s2)


def noise_of(options: SimulatorOptions, number: int = 0) -> Noise | None:
    """The noise of the device with this number, None for a perfect one."""
    return Noise(options.seed + number) if options.noise == "real" else None
