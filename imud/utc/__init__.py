"""UTC from outside: sources of RMC sentences, what the kernel and PPS edges say of UTC, the feed of chrony."""

from imud.contracts.table import Table
from imud.utc.source import MakeSource

RMC_SOURCES: Table[MakeSource] = Table(
    "RMC source",
    {
        "gpsd": "imud.utc.gpsd:make",
        "nmea": "imud.utc.nmea_port:make",
        "system": "imud.utc.system_clock:make",
    },
)
