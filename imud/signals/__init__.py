"""Signals of devices on GPIO lines: SOUT, SIN, PPS, ALARM, reset, data ready."""
