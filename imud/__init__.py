"""imud owns inertial sensors and gives every program clean, time-stamped, accounted-for samples."""

__version__ = "0.1.0"
