"""Metrics of outputs that send sentences: each value of each port, and no metric without a port."""

from imud.contracts.status import OutputStatus
from imud.publishers.metrics.metric import Snapshot
from tests.support.metrics import shown


def test_each_metric_is_a_value_of_a_port() -> None:
    tcp, serial = "tcp 127.0.0.1:10110", "serial /dev/ttyUSB0"
    outputs = (OutputStatus(tcp, 1, 2, 3, ""), OutputStatus(serial, 4, 5, 0, "No such file or directory"))
    assert shown("imud_nmea0183_", Snapshot(outputs=outputs)) == {
        f"sentences_total {tcp}": 1, f"sentences_dropped_total {tcp}": 2, f"readers {tcp}": 3,
        f"sentences_total {serial}": 4, f"sentences_dropped_total {serial}": 5, f"readers {serial}": 0,
    }  # fmt: skip
    assert shown("imud_nmea0183_", Snapshot()) == {}
