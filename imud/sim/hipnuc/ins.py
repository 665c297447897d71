"""Values of a simulated HiPNUC device with GNSS."""

from math import cos, radians
from typing import Final

from imud.drivers.hipnuc.uart.codec import encode_frame
from imud.drivers.hipnuc.uart.commands import OutputMessage
from imud.drivers.hipnuc.uart.ins import WEEK_MS, pack_hi81, pack_hi83
from imud.model.sample import Measurement, Position
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sim.hipnuc.uart_settings import NO_UTC
from imud.sim.physics import Truth

RTK_FIXED, SATELLITES = 5, 21  # quality and satellites of the simulated position
# Start of the motion: a spherical Earth is exact enough for a motion of some metres
LATITUDE_RAD, LONGITUDE_RAD, HEIGHT_M, EARTH_RADIUS_M = radians(48.0), radians(11.0), 520.0, 6_371_000.0
GNSS_UTC_NS: Final = 1_800_000_000 * NS_PER_S  # UTC at the device time 0
NAVIGATING: Final = 3  # INS status
GPS_WEEK: Final = 2453


def ins_values(reading: Truth, device_ns: int) -> Measurement:
    """Return the values of a device that always has a position and UTC."""
    east_m, north_m, up_m = reading.position_enu_m
    radius_m = EARTH_RADIUS_M + HEIGHT_M
    place = Position(
        LATITUDE_RAD + north_m / radius_m, LONGITUDE_RAD + east_m / radius_m / cos(LATITUDE_RAD), HEIGHT_M + up_m,
        RTK_FIXED, SATELLITES,
    )  # fmt: skip
    return Measurement(
        0, 0, None, reading.accel_m_s2, reading.gyro_rad_s, reading.mag_t, reading.quat_wxyz, reading.euler_rad,
        reading.temperature_c, reading.pressure_pa, velocity_enu_m_s=reading.velocity_enu_m_s, position=place,
        heave_m=up_m, gnss_utc_ns=GNSS_UTC_NS + device_ns // NS_PER_MS * NS_PER_MS,
    )  # fmt: skip


def encode_ins(message: OutputMessage, reading: Truth, hi83_bitmap: int, device_ns: int, status: int) -> bytes:
    """Return an HI81 or HI83 frame. The device always has a position and UTC."""
    values = ins_values(reading, device_ns)
    status &= ~NO_UTC
    if message is OutputMessage.HI81:
        weeks, tow_ms = divmod(device_ns // NS_PER_MS, WEEK_MS)
        payload = pack_hi81(values, main_status=status, ins_status=NAVIGATING, week=GPS_WEEK + weeks, tow_ms=tow_ms)
    else:
        payload = pack_hi83(
            values, hi83_bitmap, main_status=status, ins_status=NAVIGATING, system_time_us=device_ns // NS_PER_US
        )
    return encode_frame(payload)
