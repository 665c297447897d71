"""A HI91 frame of a module at rest, for tests that do not care what is in it."""

from imud.devices.hipnuc.uart.codec import encode_hi91

HI91_BYTES = 82


def hi91(ms: int, accel_z_m_s2: float = 9.8) -> bytes:
    """The frame at `ms` of device time."""
    return encode_hi91(
        system_time_ms=ms,
        accel_m_s2=(0.0, 0.0, accel_z_m_s2),
        gyro_rad_s=(0.0, 0.0, 0.0),
        mag_t=(0.0, 0.0, 0.0),
        euler_rad=(0.0, 0.0, 0.0),
        quat_wxyz=(1.0, 0.0, 0.0, 0.0),
        temperature_c=20.0,
        pressure_pa=1e5,
    )
