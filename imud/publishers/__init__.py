"""Registry of the outputs of samples and events."""

from imud.contracts.publisher import PublisherType
from imud.contracts.registry import PluginGroup, Registry

PUBLISHERS: Registry[PublisherType] = Registry(
    "output",
    {
        "socket": "imud.publishers.socket.server:PUBLISHER",
        "shm": "imud.publishers.shm:PUBLISHER",
        "metrics": "imud.publishers.metrics.publisher:PUBLISHER",
        "recorder": "imud.publishers.recorder.publisher:PUBLISHER",
        "nmea0183": "imud.publishers.nmea0183:PUBLISHER",
        "rules": "imud.publishers.rules.settings:PUBLISHER",
        "ros2": "imud.publishers.ros2.options:PUBLISHER",
        "nmea2000": "imud.publishers.nmea2000:PUBLISHER",
        "signalk": "imud.publishers.signalk.settings:PUBLISHER",
        "influx": "imud.publishers.influx.settings:PUBLISHER",
        "mqtt": "imud.fleet.settings:PUBLISHER",
    },
    # the configuration has these other keys at the top
    PluginGroup("imud.outputs", PublisherType, reserved=("devices", "log_level", "state_dir")),
)
