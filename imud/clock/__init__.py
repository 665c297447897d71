"""Time: device ticks to host time, with an honest error. Pure: no I/O, every time is an argument."""

from imud.clock.sampler import SampleClock

__all__ = ["SampleClock"]
