"""Motion of a vessel from the samples of one device: heading with its reference, roll, pitch and rate of turn.

The outputs for marine networks use this module. All functions expect a sample in `ned-frd`.
"""

import logging
import math
from dataclasses import dataclass
from typing import Final

import msgspec

from imud.attitude.conventions import Convention, Heading, is_settled
from imud.contracts.publisher import Batch, PublisherContext
from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

# Minimum cosine of pitch for a rate of turn (pitch 84°). Above this pitch, heading and roll are nearly the same
# rotation.
LEVEL_COS: Final = 0.1
# Time between two reads of the heading reference from the device status, ns. The device reports the reference only on
# request.
REFERENCE_NS: Final = NS_PER_S


@dataclass(frozen=True, slots=True)
class HeadingReference:
    """Reference of the yaw of samples."""

    heading: Heading = Heading.UNKNOWN
    # Declination that imud added to a magnetic heading, degrees; None if imud did not correct yaw
    declination_deg: float | None = None


def true_rad(sample: Sample, reference: HeadingReference) -> float | None:
    """Return the true heading; None if the reference is not true north."""
    return _yaw_rad(sample.euler_rad) if reference.heading is Heading.TRUE else None


def magnetic_rad(sample: Sample, reference: HeadingReference) -> float | None:
    """Return the magnetic heading, not limited to one turn; None if neither the reference nor the declination allows
    it."""
    yaw_rad = _yaw_rad(sample.euler_rad)
    if yaw_rad is None or reference.heading is Heading.MAGNETIC:
        return yaw_rad
    if reference.heading is Heading.TRUE and reference.declination_deg is not None:
        return yaw_rad - math.radians(reference.declination_deg)
    return None


def roll_pitch_rad(sample: Sample) -> tuple[float, float] | None:
    """Return roll (positive: right side down) and pitch (positive: bow up); None without finite angles."""
    euler_rad = sample.euler_rad
    if euler_rad is None or not (math.isfinite(euler_rad[0]) and math.isfinite(euler_rad[1])):
        return None
    return euler_rad[0], euler_rad[1]


def turn_rate_rad_s(sample: Sample) -> float | None:
    """Return the rate of change of the heading, positive to starboard; None without angular rate, or with the bow
    straight up.

    The rate is (q sin φ + r cos φ) / cos θ, with roll φ, pitch θ and the angular rates q about y and r about z. Thus
    rolling and pitching have no effect. Without an attitude, imud assumes a level body.
    """
    gyro = sample.gyro_rad_s
    if gyro is None or not all(map(math.isfinite, gyro)):
        return None
    roll_rad, pitch_rad = roll_pitch_rad(sample) or (0.0, 0.0)
    if math.cos(pitch_rad) < LEVEL_COS:
        return None
    return (gyro[1] * math.sin(roll_rad) + gyro[2] * math.cos(roll_rad)) / math.cos(pitch_rad)


def _yaw_rad(euler_rad: Vector3 | None) -> float | None:
    return euler_rad[2] if euler_rad is not None and math.isfinite(euler_rad[2]) else None


class VesselDevice:
    """The device whose motion an output sends: the configured device, or the only device.

    It requests the latency for samples of this device, and reads the heading reference of the device once per second.
    """

    def __init__(self, output: str, wanted: str | None, latency_ns: int, context: PublisherContext) -> None:
        """`output`: name of the output in the configuration; `wanted`: its key `device`."""
        self._output, self._wanted, self._latency_ns = output, wanted, latency_ns
        self._context = context
        self._names: dict[str, None] = {}
        self._reference_ns = 0  # time of the newest read; 0: the next `tick` reads the reference
        self._warned = ""
        self.name: str | None = None  # present device
        self.reference = HeadingReference()

    def add(self, name: str) -> None:
        """Add a device of the configuration."""
        self._names[name] = None
        self._choose()

    def remove(self, name: str) -> None:
        """Remove a device of the configuration."""
        self._names.pop(name, None)
        self._choose()

    def tick(self, now_ns: int) -> None:
        """Read the heading reference if it is due."""
        if self.name is None or now_ns - self._reference_ns < REFERENCE_NS:
            return
        self._reference_ns = now_ns
        found = next((status for status in self._context.devices.status() if status.name == self.name), None)
        if found is not None and found.frame is not None:
            self.reference = HeadingReference(found.frame.heading, found.frame.declination_deg)

    def close(self) -> None:
        """Withdraw the latency request. A second call does nothing."""
        self._context.latencies.release(self._output)

    def warn(self, message: str) -> None:
        """Log a problem once, not again for each sample."""
        if message != self._warned:
            self._warned = message
            log.warning("%s", message)

    def _choose(self) -> None:
        wanted = self._wanted
        if wanted is None and len(self._names) == 1:
            (wanted,) = self._names
        name = wanted if wanted in self._names else None
        if name is None and self._names:
            self.warn(
                f"{self._output}.device: expected the name of one device ({', '.join(self._names)}), got "
                f"{wanted or 'none'}; this output sends nothing"
            )
        if name == self.name:
            return
        self.name, self._reference_ns, self.reference = name, 0, HeadingReference()
        if name is None:
            self._context.latencies.release(self._output)
        else:
            self._context.latencies.ask(self._output, self._latency_ns, (name,))


def turned(batch: Batch, sample: Sample) -> Sample:
    """Return a sample of a batch in `ned-frd`, without attitude if the attitude filter of the host has not settled."""
    rotation = batch.frame.rotation_to(Convention.NED_FRD)
    made = sample if rotation is None else rotation.sample(sample)
    return made if is_settled(made.status) else msgspec.structs.replace(made, quat_wxyz=None, euler_rad=None)
