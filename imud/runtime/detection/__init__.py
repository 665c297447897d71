"""Detection of the device on a link: searches without I/O, and the rounds that do their I/O."""

from imud.runtime.detection.can import CanDevice, CanFound, CanSearch, CanStep, CanSurvey
from imud.runtime.detection.steps import GaveUp, Listen
from imud.runtime.detection.stream import ASK_TRIES, QUIET_NS, Search, Step, StreamFound

__all__ = [
    "ASK_TRIES",
    "QUIET_NS",
    "CanDevice",
    "CanFound",
    "CanSearch",
    "CanStep",
    "CanSurvey",
    "GaveUp",
    "Listen",
    "Search",
    "Step",
    "StreamFound",
]
