"""Publishers: outputs of samples and events that never make the pipeline wait."""

from imud.contracts.publisher import PublisherType
from imud.contracts.table import Table

PUBLISHERS: Table[PublisherType] = Table(
    "publisher",
    {
        "socket": "imud.publishers.socket.publisher:PUBLISHER",
        "shm": "imud.publishers.shm.publisher:PUBLISHER",
        "metrics": "imud.publishers.metrics.publisher:PUBLISHER",
        "recorder": "imud.publishers.recorder.publisher:PUBLISHER",
        "nmea0183": "imud.publishers.nmea0183.publisher:PUBLISHER",
        "mqtt": "imud.publishers.mqtt.publisher:PUBLISHER",
    },
)
