"""A Forsense IMU61x on a CAN bus: manual "IMU61X Interface Protocol and Instructions", chapter 4.

Without I/O and without a clock of its own. It samples at whole periods of its own crystal, which runs `skew_ppm` fast,
and sends the five frames of a sample back to back `processing_ns` later. INDEX counts samples from power-on. It takes
no commands. Heading starts as the truth has it.
"""

from dataclasses import dataclass, field
from typing import Final

from imud.attitude import euler_zyx_from_quat
from imud.devices.imu61x.can.codec import BASE_ID, SET_FRAMES, encode_set
from imud.formats.can import STANDARD_ID_MAX
from imud.sim.can_module import BITRATE, CanSimulator, FrameWire, SentFrame
from imud.sim.physics.motion import MOTIONS, Motion, swing
from imud.sim.physics.noise import Noise
from imud.sim.simulator import SimulatorOptions
from imud.units import NS_PER_MS, NS_PER_S

RATE_MAX_HZ: Final = 400.0


@dataclass(frozen=True, slots=True)
class Imu61xCanHardware:
    """What a device is made of and how it is set."""

    rate_hz: float = 100.0
    base_id: int = BASE_ID
    bitrate: int = BITRATE
    motion: Motion = field(default_factory=swing)
    noise: Noise | None = None
    skew_ppm: float = 20.0
    boot_ms: int = 500
    processing_ns: int = 125_000
    index: int = 0
    """INDEX of the first sample after the first power-on, to begin near the end of its range."""


class Imu61xCanModule:
    """One device, powered on when it is made."""

    def __init__(self, now_ns: int, hardware: Imu61xCanHardware | None = None) -> None:
        self.hardware = hardware or Imu61xCanHardware()
        self.epoch_ns = now_ns
        self.samples_sent = 0
        self._power_on(now_ns, self.hardware.index)

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Others' frames mean nothing to it."""

    def mark(self, now_ns: int) -> None:
        """It has no sync input on this port."""

    def reboot(self, now_ns: int) -> None:
        """Power was lost and came back: INDEX starts anew."""
        self._power_on(now_ns, 0)

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return what has crossed the wire since the last call, in order."""
        while (sample_ns := self._sample_ns(self._taken)) <= now_ns:
            self._taken += 1
            self.samples_sent += 1
            for can_id, data in self._frames(sample_ns):
                self._wire.send(sample_ns + self.hardware.processing_ns, can_id, False, data, sample_ns)
        return self._wire.sent(now_ns)

    def next_ns(self) -> int | None:
        """When `advance` will have something next."""
        waiting = self._wire.next_ns()
        if waiting is not None:
            return waiting
        return self._sample_ns(self._taken) + self.hardware.processing_ns + self._wire.frame_ns

    def counters(self) -> dict[str, int]:
        """Samples and frames sent."""
        return {"samples_sent": self.samples_sent, "frames_sent": self.samples_sent * SET_FRAMES}

    def _power_on(self, now_ns: int, index: int) -> None:
        hardware = self.hardware
        self._begin_ns = now_ns + hardware.boot_ms * NS_PER_MS
        self._period_ns = NS_PER_S / hardware.rate_hz / (1 + hardware.skew_ppm * 1e-6)
        self._taken = 0
        self._first_index = index
        self._wire = FrameWire(hardware.bitrate, self._begin_ns)

    def _sample_ns(self, number: int) -> int:
        return self._begin_ns + round(number * self._period_ns)

    def _frames(self, sample_ns: int) -> list[tuple[int, bytes]]:
        t_s = (sample_ns - self.epoch_ns) / NS_PER_S
        truth = self.hardware.motion.at(t_s)
        reading = self.hardware.noise.add(truth, t_s) if self.hardware.noise else truth
        return encode_set(
            index=self._first_index + self._taken - 1,
            accel_m_s2=reading.accel_m_s2,
            gyro_rad_s=reading.gyro_rad_s,
            euler_rad=euler_zyx_from_quat(reading.quat_wxyz),
            temperature_c=reading.temperature_c,
            base_id=self.hardware.base_id,
        )


def make(options: SimulatorOptions, now_ns: int) -> Imu61xCanModule:
    """A device from the common options. Raises ValueError naming the option that it cannot have."""
    if not 1 <= options.rate_hz <= RATE_MAX_HZ:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected 1 … {RATE_MAX_HZ:g}")
    if options.message:
        raise ValueError(f"message {options.message!r}: expected none, there is only one")
    if not 0 <= options.node <= STANDARD_ID_MAX - SET_FRAMES + 1:
        raise ValueError(f"node {options.node}: expected the identifier of the first frame, or 0 for {BASE_ID}")
    if options.motion not in MOTIONS:
        raise ValueError(f"motion {options.motion!r}: expected {' or '.join(MOTIONS)}")
    hardware = Imu61xCanHardware(
        rate_hz=options.rate_hz,
        base_id=options.node or BASE_ID,
        bitrate=options.bitrate(BITRATE),
        motion=MOTIONS[options.motion](options.gravity_m_s2),
        noise=Noise(options.seed) if options.noise == "real" else None,
        skew_ppm=options.skew_ppm,
        boot_ms=options.boot_ms,
        processing_ns=options.processing_ns,
    )
    return Imu61xCanModule(now_ns, hardware)


SIMULATOR = CanSimulator("imu61x-can", "Forsense IMU614 (IMU61x) on a CAN bus", make)
