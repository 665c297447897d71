"""Logs of simulated CAN devices, as `candump -L` writes them."""

from collections.abc import Iterable

from imud.devices.imu61x.can.codec import encode_set
from imud.formats.can import CanFrame
from tests.support.captures import candump_line

BEGIN_NS = 1_763_717_507_000_000_000
PERIOD_NS = 10_000_000
FRAME_NS = 250_000


def imu61x_log(indices: Iterable[int]) -> str:
    """Samples of an IMU61x at rest, 100 a second by their index."""
    lines = []
    for index in indices:
        frames = encode_set(
            index=index,
            accel_m_s2=(0, 0, 9.80665),
            gyro_rad_s=(0, 0, 0),
            euler_rad=(0.1, 0.2, 0.3),
            temperature_c=25.5,
        )
        t_ns = BEGIN_NS + index * PERIOD_NS
        for place, (can_id, data) in enumerate(frames):
            lines.append(candump_line(CanFrame(can_id, False, data, t_ns + place * FRAME_NS)))
    return "".join(lines)
