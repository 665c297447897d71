"""Metrics of the recorders: each value of their status, and no metric without a recorder."""

from imud.contracts.status import FlightStatus, RecorderStatus
from imud.publishers.metrics.metric import Snapshot
from tests.support.metrics import shown

RECORDER = RecorderStatus("a", "", 1, 2, 3, 4, 5, 6)
FULL = "No space left on device"


def test_each_metric_is_a_value_of_the_status() -> None:
    recorders = Snapshot(recorders=(RECORDER,))
    assert shown("imud_recorder_", recorders) == {
        "active": 1, "written_bytes_total": 1, "records_total": 2, "records_dropped_total": 3, "waiting_bytes": 4,
        "files_removed_total": 5,
    }  # fmt: skip
    assert shown("imud_recordings_", recorders) == {"bytes": 6}
    full = Snapshot(recorders=(RecorderStatus("", FULL, 1, 2, 3, 4, 5, 6),))
    assert shown("imud_recorder_", full)["active"] == 0
    for prefix in ("imud_recorder_", "imud_recordings_", "imud_flight_"):
        assert shown(prefix, Snapshot()) == {}


def test_each_metric_is_a_value_of_the_flight_recorder() -> None:
    flights = Snapshot(flights=(FlightStatus("", 90_500_000_000, 2, 3, 4, 5, 6, 7, 8),))
    assert shown("imud_flight_recorder_", flights) == {
        "active": 1, "kept_seconds": 90.5, "kept_bytes": 2, "records_dropped_total": 3, "snapshots_total saved": 4,
        "snapshots_total failed": 5, "snapshots_total left_out": 6, "snapshots_sent_total": 7,
    }  # fmt: skip
    assert shown("imud_recordings_", flights) == {"bytes": 8}
    both = Snapshot(recorders=(RECORDER,), flights=(FlightStatus("", 1, 2, 3, 4, 5, 6, 7, 5),))
    assert shown("imud_recordings_", both) == {"bytes": 6}  # including the open file
    full = Snapshot(flights=(FlightStatus(FULL, 0, 0, 0, 0, 0, 0, 0, 0),))
    assert shown("imud_flight_recorder_", full)["active"] == 0
