"""Simulated Forsense IMU61x, one module per link, as in `imud.devices.imu61x`."""
