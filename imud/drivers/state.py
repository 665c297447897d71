"""Types of the state of codecs (`imud.formats.state`) that several drivers share."""

from typing import Final

from imud.contracts.codec import UNKNOWN_TYPES_MAX
from imud.formats.state import Flag, Integer, Map, Maybe, Real

TIME: Final = Integer(-(1 << 61), 1 << 61)  # arrival time or difference of two, ns: 73 years
COUNT: Final = Integer(0, 1 << 53)
NUMBER: Final = Real(-1e18, 1e18)
SID: Final = Maybe(Integer(0, 0xFF))  # SID or sequence number of a frame
FLAG: Final = Flag()
UNKNOWN: Final = Map(Integer(0, (1 << 63) - 1), COUNT, UNKNOWN_TYPES_MAX)  # `unknown` of a codec
DAEMON: Final = "part of the daemon"
OPTIONS: Final = "from the options of the driver"
