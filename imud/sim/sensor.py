"""Sensor of a simulated device: its motion, its noise and its crystal, from the options."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal, NamedTuple, Protocol, TypedDict, TypeVar

from imud.sim.physics import GRAVITY_M_S2, MOTIONS, Motion, Noise, Truth, swing

V = TypeVar("V")


class Burst(NamedTuple):
    """Bytes that leave the device in one piece."""

    due_ns: int  # CLOCK_MONOTONIC of the end of the last byte on the wire
    data: bytes  # bytes of the frame or the reply
    sample_ns: int | None = None  # CLOCK_MONOTONIC of the measurement; None for text
    device_ms: int | None = None  # device time of the measurement since power-on, ms, without wrap


class Pin(StrEnum):
    """Output pins with the names of lines in the configuration."""

    SOUT = "sout"  # High before each frame. The frame follows the falling edge.
    SOUT_DIV = "sout_div"  # every n-th pulse of SOUT
    ALARM = "alarm"  # high while an angle is out of its range


class PinEdge(NamedTuple):
    """A change of a pin's level."""

    due_ns: int  # CLOCK_MONOTONIC of the change
    pin: Pin  # name of the pin
    rising: bool  # True for a rising edge
    sample_ns: int | None = None  # CLOCK_MONOTONIC of the measurement in the next frame; None if no frame follows


class StreamModule(Protocol):
    """A simulated device. Times are CLOCK_MONOTONIC in ns and never go backwards. Synchronization: one thread."""

    @property
    def baud(self) -> int:
        """Current baud rate, bit/s."""
        ...

    epoch_ns: int  # zero of the motion, ns: the truth at an instant is `motion.at((instant - epoch_ns) / 1e9)`

    def receive(self, data: bytes, now_ns: int) -> None:
        """Receive bytes from the host, sampled at the baud rate of the device."""
        ...

    def advance(self, now_ns: int) -> list[Burst]:
        """Return the bursts sent since the last call, in order."""
        ...

    def next_ns(self) -> int | None:
        """Return the time of the next burst of `advance`; None if no burst is due."""
        ...

    def counters(self) -> dict[str, int]:
        """Return the counters of the device by name."""
        ...

    def mark(self, now_ns: int) -> None:
        """Send a rising edge to the sync input. A device without this input ignores it."""
        ...

    def reboot(self, now_ns: int) -> None:
        """Restart after a power failure or a command. The device loses unsaved settings."""
        ...


@dataclass(frozen=True, slots=True)
class SimulatorOptions:
    """Options of every simulated device."""

    rate_hz: float = 100.0
    """Samples per second of device time."""
    baud: int = 0
    """Baud rate of the port, bit/s; 0: the slowest usual rate that carries the samples."""
    message: str = ""
    """Name of the message to send; empty: the default of the factory."""
    motion: str = "swing"
    """Row of `imud.sim.physics.MOTIONS`."""
    gravity_m_s2: float = GRAVITY_M_S2
    """Local gravity, m/s²."""
    noise: Literal["real", "none"] = "real"
    """`real`: noise and bias of a device at rest (`NoiseLevels`); `none`: a perfect sensor."""
    skew_ppm: float = 20.0
    """Rate error of the crystal relative to the host clock, 1e-6."""
    firmware: int = 0
    """Firmware version that the device reports; 0: a usual version."""
    boot_ms: int = 500
    """Silence after power-on and restart, ms."""
    processing_ns: int = 125_000
    """Time from the measurement to the first bit on the wire, ns."""
    seed: int = 1
    """Seed of the noise. The same seed gives the same samples."""
    node: int = 0
    """Node, address or first identifier of the device on its bus; 0: the default of the factory."""
    variant: str = ""
    """Name of a behavior that the manual does not define; empty: the default of the device."""
    at_once: bool = False
    """True: the frames of a CAN device take no time on the wire, as on a virtual bus."""

    def chosen(self, variants: Mapping[str, V]) -> V:
        """Return the chosen variant, the first without a choice. Raises ValueError for an unknown name."""
        name = self.variant or next(iter(variants))
        if name not in variants:
            raise ValueError(f"variant {name!r}: expected one of {', '.join(variants)}")
        return variants[name]

    def bitrate(self, common: int) -> int:
        """Return the bit rate of a CAN device, bit/s: `baud` or `common`; 0 for frames that take no time."""
        return 0 if self.at_once else self.baud or common


@dataclass(frozen=True, slots=True)
class Simulator:
    """Row of a simulated device."""

    name: str  # name of the driver of the device
    title: str  # name of the product
    # Function that makes the device, with power on at the given CLOCK_MONOTONIC. Raises ValueError for unsupported
    # options.
    make: Callable[[SimulatorOptions, int], StreamModule]
    interface: int = 0  # interface version for which another package was written; 0 for simulators of imud


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorHardware:
    """Hardware of each simulated sensor, for all links."""

    motion: Motion = field(default_factory=swing)  # motion of the sensor
    noise: Noise | None = None  # noise of the sensor; None for a perfect sensor
    skew_ppm: float = 20.0  # rate error of the crystal relative to the host clock, 1e-6
    boot_ms: int = 500  # silence after power-on and restart, ms
    processing_ns: int = 125_000  # time from the measurement to the first bit on the wire, ns

    def reading(self, t_s: float) -> Truth:
        """Return the measured values at `t_s` seconds after the zero of the motion."""
        truth = self.motion.at(t_s)
        return self.noise.add(truth, t_s) if self.noise else truth


class SensorFields(TypedDict):
    motion: Motion
    noise: Noise | None
    skew_ppm: float
    boot_ms: int
    processing_ns: int


def sensor_of(options: SimulatorOptions) -> SensorFields:
    """Return the arguments of `SensorHardware` for the options. Raises ValueError for an unknown motion."""
    return {
        "motion": motion_of(options),
        "noise": noise_of(options),
        "skew_ppm": options.skew_ppm,
        "boot_ms": options.boot_ms,
        "processing_ns": options.processing_ns,
    }


def motion_of(options: SimulatorOptions) -> Motion:
    """Return the motion of the options. Raises ValueError for an unknown name."""
    if options.motion not in MOTIONS:
        raise ValueError(f"motion {options.motion!r}: expected {' or '.join(MOTIONS)}")
    return MOTIONS[options.motion](options.gravity_m_s2)


def noise_of(options: SimulatorOptions, number: int = 0) -> Noise | None:
    """Return the noise of the device with this number; None for a perfect device."""
    return Noise(options.seed + number) if options.noise == "real" else None
