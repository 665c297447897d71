"""Contract of the host's clocks: `HostClock` reads them, `SteadyTime` has CLOCK_MONOTONIC without its steering."""

from imud.host_clock.reader import HostClock
from imud.host_clock.steady_time import UNSTEERED, SteadyTime

__all__ = ["UNSTEERED", "HostClock", "SteadyTime"]
