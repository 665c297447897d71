"""Finds out what talks on a link, without I/O: on a line of bytes, and on a CAN bus."""

from imud.runtime.detection.can import CanDevice, CanFound, CanGaveUp, CanListen, CanSearch, CanStep, CanSurvey
from imud.runtime.detection.stream import ASK_TRIES, QUIET_NS, GaveUp, Listen, Search, Step, StreamFound

__all__ = [
    "ASK_TRIES",
    "QUIET_NS",
    "CanDevice",
    "CanFound",
    "CanGaveUp",
    "CanListen",
    "CanSearch",
    "CanStep",
    "CanSurvey",
    "GaveUp",
    "Listen",
    "Search",
    "Step",
    "StreamFound",
]
