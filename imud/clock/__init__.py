"""Conversion of device ticks to host time, with an error estimate. Pure: no I/O, every time is an argument."""

from imud.clock.sampler import SampleClock

__all__ = ["SampleClock"]
