"""Forsense IMU61x on UART."""
