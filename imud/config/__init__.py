"""The configuration file: imud reads and checks the whole file before it opens a port.

    log_level, state_dir          keys of the daemon (`General`)
    socket, shm, metrics, …       a key per row of PUBLISHERS, with the options of this row
    devices:
      NAME:
        driver, identify, enabled, options        (`DeviceGeneral`; `options` are the options of the driver)
        lines                     GPIO lines (`imud.contracts.lines.DeviceLines`) that the driver supports
        rmc                       source of RMC sentences (`imud.utc.receivers.RmcOptions`), for devices with SIN/PPS
        frame                     mounting of the sensor (`imud.attitude.published.FrameOptions`)
        uart | replay | …         a key per row of LINKS, with the options of this row

A new row of a registry needs no change here. Errors name file, line, column, the expected and the received value. imud
reports all problems together.
"""

from imud.config.model import Config, DeviceConfig, Differences, differences
from imud.config.reading import DEVICE_NAME, DEVICES_MAX, PROBLEMS_SHOWN, content_of, load, load_options, parse
from imud.config.schema import TABLES, DeviceGeneral, General, Tables

__all__ = [
    "DEVICES_MAX",
    "DEVICE_NAME",
    "PROBLEMS_SHOWN",
    "TABLES",
    "Config",
    "DeviceConfig",
    "DeviceGeneral",
    "Differences",
    "General",
    "Tables",
    "content_of",
    "differences",
    "load",
    "load_options",
    "parse",
]
