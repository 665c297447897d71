"""Outputs: each gives samples to readers and never makes the pipeline wait."""

from imud.kit.publisher import PublisherType
from imud.kit.table import Table

PUBLISHERS: Table[PublisherType] = Table(
    "publisher",
    {
        "socket": "imud.publishers.socket:PUBLISHER",
        "shm": "imud.publishers.shm:PUBLISHER",
        "metrics": "imud.publishers.metrics:PUBLISHER",
    },
)
