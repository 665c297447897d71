"""MAIN_STATUS of a simulated HiPNUC module (HI91 bytes 1-2 since firmware 1.6.9), as far as it can be in it."""

from typing import Final

from imud.sim.physics.motion import Truth

STATIC_GYRO_RAD_S: Final = 0.02
GYRO_SETTLED_MS: Final = 5000
ATTITUDE_SETTLED_MS: Final = 1000
"""Assumed times after power-on until bias and attitude count as converged."""

GYRO_UNSETTLED, ATTITUDE_UNSETTLED = 1 << 3, 1 << 7
STATIC, MAG_AIDING, NO_UTC, SYNC_OUT = 1 << 9, 1 << 10, 1 << 11, 1 << 12


def main_status(reading: Truth, uptime_ms: int, *, nine_axis: bool, utc: bool) -> int:
    """The bits; a SOUT pulse goes before every frame."""
    status = SYNC_OUT
    if not utc:
        status |= NO_UTC
    if uptime_ms < GYRO_SETTLED_MS:
        status |= GYRO_UNSETTLED
    if uptime_ms < ATTITUDE_SETTLED_MS:
        status |= ATTITUDE_UNSETTLED
    if max(map(abs, reading.gyro_rad_s)) < STATIC_GYRO_RAD_S:
        status |= STATIC
    return status | MAG_AIDING if nine_axis else status
