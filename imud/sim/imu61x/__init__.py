"""Simulated Forsense IMU61x devices."""
