"""Table of the metrics of outputs that send sentences; there are none where there is no such output."""

from collections.abc import Callable
from typing import Final

from imud.contracts.status import OutputStatus
from imud.publishers.metrics.family import NO_UNIT, Family, Lines, MetricType, Reader, Snapshot


def _output(read: Callable[[OutputStatus], float]) -> Reader:
    """A value of each way out."""

    def lines(snapshot: Snapshot) -> Lines:
        return [((status.name,), read(status)) for status in snapshot.outputs]

    return Reader(("output",), lines)


OUTPUT_FAMILIES: Final = (
    Family(
        "imud_nmea0183_sentences_total", MetricType.COUNTER, NO_UNIT, "Sentences sent.",
        _output(lambda status: status.sent),
    ),
    Family(
        "imud_nmea0183_sentences_dropped_total", MetricType.COUNTER, NO_UNIT,
        "Sentences that were not sent because the way out had no room or was away.",
        _output(lambda status: status.dropped),
    ),
    Family(
        "imud_nmea0183_readers", MetricType.GAUGE, NO_UNIT,
        "Clients of the TCP server; of a port or an address 1 while it takes what is sent, 0 while it does not.",
        _output(lambda status: status.readers),
    ),
)  # fmt: skip
