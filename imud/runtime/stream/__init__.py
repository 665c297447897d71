"""Devices that send bytes by themselves: UART, RS-232, a replay."""
