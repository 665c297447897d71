"""A HiPNUC device or another heading and attitude sensor on NMEA 2000: PGNs 127250, 127251 and 127257.

The simulator contains no I/O and reads no clock. The device samples at whole periods of its own crystal, which runs
`skew_ppm` fast. It sends the three messages of an instant back to back with the same SID, `processing_ns` later. It
ignores other nodes and claims no address. Vessel and sensor frame: see `imud.drivers.hipnuc.nmea2000`. The rate of turn
is the angular rate about z of the sensor.
"""

from dataclasses import dataclass
from functools import partial
from typing import Final

from imud.drivers.hipnuc import nmea2000 as messages
from imud.drivers.hipnuc.nmea2000 import EXAMPLE_SOURCE, encode
from imud.formats.j1939 import ADDRESS_MAX
from imud.formats.nmea2000 import ATTITUDE, HEADING, RATE_OF_TURN, SID_MOST, Reference
from imud.sim.can_module import CanSimulator, PeriodicCanModule
from imud.sim.physics import Truth
from imud.sim.sensor import SensorHardware, SimulatorOptions, sensor_of

BITRATE: Final = 250_000  # bit rate of NMEA 2000, bit/s
RATE_MAX_HZ: Final = 100.0
MESSAGES: Final = ("", "heading", "attitude")  # messages to send: empty for all three, or the name of one
SIDS: Final = SID_MOST + 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Nmea2000Hardware(SensorHardware):
    """A sensor and its settings."""

    rate_hz: float = 10.0
    message: str = ""
    source: int = EXAMPLE_SOURCE
    bitrate: int = BITRATE
    reference: Reference = Reference.MAGNETIC


class HipnucNmea2000Module(PeriodicCanModule):
    def __init__(self, now_ns: int, hardware: Nmea2000Hardware | None = None) -> None:
        self.hardware = hardware = hardware or Nmea2000Hardware()
        frames = partial(_frames, hardware)
        super().__init__(now_ns, hardware, hardware.rate_hz, hardware.bitrate, frames, extended=True)


def _frames(hardware: Nmea2000Hardware, number: int, reading: Truth) -> list[tuple[int, bytes]]:
    """Return the messages of one instant with the same SID. SIDs start again at power-on."""
    sid = number % SIDS
    heading = HEADING, messages.pack_heading(sid, reading.euler_rad[2], hardware.reference)
    rate = RATE_OF_TURN, messages.pack_rate_of_turn(sid, reading.gyro_rad_s[2])
    attitude = ATTITUDE, messages.pack_attitude(sid, reading.euler_rad)
    sent = {"heading": [heading], "attitude": [attitude]}.get(hardware.message, [heading, rate, attitude])
    return [encode(pgn, data, hardware.source) for pgn, data in sent]


def make(options: SimulatorOptions, now_ns: int) -> HipnucNmea2000Module:
    """Return a sensor for the options. Raises ValueError for an unsupported option."""
    options.chosen({"as in the manual": None})
    if not 1 <= options.rate_hz <= RATE_MAX_HZ:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected 1 … {RATE_MAX_HZ:g}")
    if options.message not in MESSAGES:
        raise ValueError(f"message {options.message!r}: expected {' or '.join(filter(None, MESSAGES))}, or none")
    if not 0 <= options.node <= ADDRESS_MAX:
        raise ValueError(f"node {options.node}: expected an address 1 … {ADDRESS_MAX}, or 0 for {EXAMPLE_SOURCE}")
    hardware = Nmea2000Hardware(
        rate_hz=options.rate_hz,
        message=options.message,
        source=options.node or EXAMPLE_SOURCE,
        bitrate=options.bitrate(BITRATE),
        **sensor_of(options),
    )
    return HipnucNmea2000Module(now_ns, hardware)


SIMULATOR: Final = CanSimulator("hipnuc-nmea2000", "HiPNUC HI14 (CAN, NMEA 2000)", make)
