"""Finds out what talks on a link, without I/O: on a line of bytes, and on a CAN bus."""

from imud.detect.can import CanDevice, CanFound, CanGaveUp, CanListen, CanSearch, CanStep, CanSurvey
from imud.detect.stream import ASK_TRIES, QUIET_NS, Found, GaveUp, Listen, Search, Step

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
    "Found",
    "GaveUp",
    "Listen",
    "Search",
    "Step",
]
