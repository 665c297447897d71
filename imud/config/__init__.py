"""The configuration file: read and checked as a whole before any port is opened. Loading opens only that file.

    log_level, state_dir          keys of the daemon (`General`)
    socket, shm, metrics, …       one key per row of PUBLISHERS, with that row's settings
    devices:
      NAME:
        driver, identify, enabled, options        (`DeviceGeneral`; options are the driver's settings)
        lines                     GPIO lines (`imud.contracts.lines.DeviceLines`), as far as the driver has them
        rmc                       source of RMC sentences (`imud.utc.receivers.RmcOptions`), for devices with SIN/PPS
        frame                     how the sensor lies in its body (`imud.attitude.published.FrameOptions`)
        uart | replay | …         one key per row of LINKS, with that row's settings

A new row of a table is configurable without a change here. Errors name file, line and column, what was expected and
what is there; all that one pass finds are reported together.
"""

from imud.config.devices import DEVICE_NAME, DEVICES_MAX
from imud.config.model import Config, DeviceConfig, Differences, differences
from imud.config.reading import PROBLEMS_SHOWN, load, parse
from imud.config.schema import TABLES, DeviceGeneral, DriverRow, General, LinkRow, Row, Tables

__all__ = [
    "DEVICES_MAX",
    "DEVICE_NAME",
    "PROBLEMS_SHOWN",
    "TABLES",
    "Config",
    "DeviceConfig",
    "DeviceGeneral",
    "Differences",
    "DriverRow",
    "General",
    "LinkRow",
    "Row",
    "Tables",
    "differences",
    "load",
    "parse",
]
