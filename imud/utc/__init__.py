"""UTC: sources of RMC sentences, references from pulses and from the system clock, feeds of device and chronyd."""

from imud.contracts.registry import Registry
from imud.utc.receivers import MakeSource

RMC_SOURCES: Registry[MakeSource] = Registry(
    "RMC source",
    {
        "gpsd": "imud.utc.receivers:make_gpsd",
        "nmea": "imud.utc.receivers:make_nmea",
        "system": "imud.utc.system_clock:make",
    },
)
