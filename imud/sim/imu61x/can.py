"""A Forsense IMU61x on a CAN bus: manual "IMU61X Interface Protocol and Instructions", chapter 4.

The simulator contains no I/O and reads no clock. The device samples at whole periods of its own crystal, which runs
`skew_ppm` fast. It sends the five frames of a sample back to back `processing_ns` later. INDEX counts samples from
power-on. The device accepts no commands. The heading starts at the truth.
"""

from dataclasses import dataclass
from functools import partial
from typing import Final

from imud.attitude.rotation import euler_zyx_from_quat
from imud.drivers.imu61x.can import BASE_ID, SET_FRAMES, encode_set
from imud.formats.can import STANDARD_ID_MAX
from imud.sim.can_module import BITRATE, CanSimulator, PeriodicCanModule
from imud.sim.physics import Truth
from imud.sim.sensor import SensorHardware, SimulatorOptions, sensor_of

RATE_MAX_HZ: Final = 400.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Imu61xCanHardware(SensorHardware):
    """A device and its settings."""

    rate_hz: float = 100.0
    base_id: int = BASE_ID
    bitrate: int = BITRATE
    index: int = 0  # INDEX of the first sample after the first power-on, for a start near the end of its range


class Imu61xCanModule(PeriodicCanModule):
    def __init__(self, now_ns: int, hardware: Imu61xCanHardware | None = None) -> None:
        self.hardware = hardware = hardware or Imu61xCanHardware()
        encode = partial(_frames, hardware.base_id)
        super().__init__(now_ns, hardware, hardware.rate_hz, hardware.bitrate, encode, first_number=hardware.index)


def _frames(base_id: int, index: int, reading: Truth) -> list[tuple[int, bytes]]:
    return encode_set(
        index=index,
        accel_m_s2=reading.accel_m_s2,
        gyro_rad_s=reading.gyro_rad_s,
        euler_rad=euler_zyx_from_quat(reading.quat_wxyz),
        temperature_c=reading.temperature_c,
        base_id=base_id,
    )


def make(options: SimulatorOptions, now_ns: int) -> Imu61xCanModule:
    """Return a device for the options. Raises ValueError for an unsupported option."""
    options.chosen({"as in the manual": None})
    if not 1 <= options.rate_hz <= RATE_MAX_HZ:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected 1 … {RATE_MAX_HZ:g}")
    if options.message:
        raise ValueError(f"message {options.message!r}: expected no name, because the device has only one message")
    if not 0 <= options.node <= STANDARD_ID_MAX - SET_FRAMES + 1:
        raise ValueError(f"node {options.node}: expected the identifier of the first frame, or 0 for {BASE_ID}")
    hardware = Imu61xCanHardware(
        rate_hz=options.rate_hz,
        base_id=options.node or BASE_ID,
        bitrate=options.bitrate(BITRATE),
        **sensor_of(options),
    )
    return Imu61xCanModule(now_ns, hardware)


SIMULATOR = CanSimulator("imu61x-can", "Forsense IMU614 (IMU61x) on a CAN bus", make)
