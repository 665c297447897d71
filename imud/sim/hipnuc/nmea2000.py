"""A HiPNUC module, or any heading and attitude sensor, on NMEA 2000: PGNs 127250, 127251 and 127257.

Without I/O and without a clock of its own. It samples at whole periods of its own crystal, which runs `skew_ppm` fast,
and sends the three messages of an instant, with the same SID, back to back `processing_ns` later. It listens to nobody
and claims no address. Vessel and sensor frame: see `imud.devices.hipnuc.nmea2000.messages`. The rate of turn is the
sensor's rate about its own z.
"""

from dataclasses import dataclass, field
from typing import Final

from imud.devices.hipnuc.nmea2000 import messages
from imud.devices.hipnuc.nmea2000.codec import EXAMPLE_SOURCE, encode
from imud.devices.hipnuc.nmea2000.messages import Reference
from imud.formats.j1939 import ADDRESS_MAX
from imud.sim.can_module import CanSimulator, FrameWire, SentFrame
from imud.sim.physics.motion import MOTIONS, Motion, swing
from imud.sim.physics.noise import Noise
from imud.sim.simulator import SimulatorOptions
from imud.units import NS_PER_MS, NS_PER_S

BITRATE: Final = 250_000
"""Of every NMEA 2000 bus."""
RATE_MAX_HZ: Final = 100.0
MESSAGES: Final = ("", "heading", "attitude")
"""All three, or one alone."""
SIDS: Final = messages.SID_MOST + 1


@dataclass(frozen=True, slots=True)
class Nmea2000Hardware:
    """What a sensor is made of and how it is set."""

    rate_hz: float = 10.0
    message: str = ""
    source: int = EXAMPLE_SOURCE
    bitrate: int = BITRATE
    reference: Reference = Reference.MAGNETIC
    motion: Motion = field(default_factory=swing)
    noise: Noise | None = None
    skew_ppm: float = 20.0
    boot_ms: int = 500
    processing_ns: int = 125_000


class HipnucNmea2000Module:
    """One sensor, powered on when it is made."""

    def __init__(self, now_ns: int, hardware: Nmea2000Hardware | None = None) -> None:
        self.hardware = hardware or Nmea2000Hardware()
        self.epoch_ns = now_ns
        self.samples_sent = 0
        self.frames_sent = 0
        self.reboot(now_ns)

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Others' frames mean nothing to it."""

    def mark(self, now_ns: int) -> None:
        """It has no sync input on this port."""

    def reboot(self, now_ns: int) -> None:
        """Power was lost and came back: SIDs start anew."""
        hardware = self.hardware
        self._begin_ns = now_ns + hardware.boot_ms * NS_PER_MS
        self._period_ns = NS_PER_S / hardware.rate_hz / (1 + hardware.skew_ppm * 1e-6)
        self._taken = 0
        self._wire = FrameWire(hardware.bitrate, self._begin_ns)

    def advance(self, now_ns: int) -> list[SentFrame]:
        """Return what has crossed the wire since the last call, in order."""
        while (sample_ns := self._sample_ns()) <= now_ns:
            for pgn, data in self._messages(sample_ns, self._taken % SIDS):
                can_id, _ = encode(pgn, data, self.hardware.source)
                self._wire.send(sample_ns + self.hardware.processing_ns, can_id, True, data, sample_ns)
                self.frames_sent += 1
            self._taken += 1
            self.samples_sent += 1
        return self._wire.sent(now_ns)

    def next_ns(self) -> int | None:
        """When `advance` will have something next."""
        waiting = self._wire.next_ns()
        if waiting is not None:
            return waiting
        return self._sample_ns() + self.hardware.processing_ns + self._wire.extended_ns

    def counters(self) -> dict[str, int]:
        """Samples and frames sent."""
        return {"samples_sent": self.samples_sent, "frames_sent": self.frames_sent}

    def _sample_ns(self) -> int:
        return self._begin_ns + round(self._taken * self._period_ns)

    def _messages(self, sample_ns: int, sid: int) -> list[tuple[int, bytes]]:
        hardware = self.hardware
        t_s = (sample_ns - self.epoch_ns) / NS_PER_S
        truth = hardware.motion.at(t_s)
        reading = hardware.noise.add(truth, t_s) if hardware.noise else truth
        heading = messages.HEADING, messages.pack_heading(sid, reading.euler_rad[2], hardware.reference)
        rate = messages.RATE_OF_TURN, messages.pack_rate_of_turn(sid, reading.gyro_rad_s[2])
        attitude = messages.ATTITUDE, messages.pack_attitude(sid, reading.euler_rad)
        return {"heading": [heading], "attitude": [attitude]}.get(hardware.message, [heading, rate, attitude])


def make(options: SimulatorOptions, now_ns: int) -> HipnucNmea2000Module:
    """A sensor from the common options. Raises ValueError naming the option that it cannot have."""
    if not 1 <= options.rate_hz <= RATE_MAX_HZ:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected 1 … {RATE_MAX_HZ:g}")
    if options.message not in MESSAGES:
        raise ValueError(f"message {options.message!r}: expected {' or '.join(filter(None, MESSAGES))}, or none")
    if not 0 <= options.node <= ADDRESS_MAX:
        raise ValueError(f"node {options.node}: expected an address 1 … {ADDRESS_MAX}, or 0 for {EXAMPLE_SOURCE}")
    if options.motion not in MOTIONS:
        raise ValueError(f"motion {options.motion!r}: expected {' or '.join(MOTIONS)}")
    hardware = Nmea2000Hardware(
        rate_hz=options.rate_hz,
        message=options.message,
        source=options.node or EXAMPLE_SOURCE,
        bitrate=options.bitrate(BITRATE),
        motion=MOTIONS[options.motion](options.gravity_m_s2),
        noise=Noise(options.seed) if options.noise == "real" else None,
        skew_ppm=options.skew_ppm,
        boot_ms=options.boot_ms,
        processing_ns=options.processing_ns,
    )
    return HipnucNmea2000Module(now_ns, hardware)


SIMULATOR: Final = CanSimulator("hipnuc-nmea2000", "HiPNUC HI14 (CAN, NMEA 2000)", make)
