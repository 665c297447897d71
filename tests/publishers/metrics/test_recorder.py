"""Metrics of the recorder and the flight recorder: each value of their status, and none without them."""

from collections.abc import Sequence

from prometheus_client.parser import text_string_to_metric_families as parse_text

from imud.contracts.status import FlightStatus, RecorderStatus
from imud.publishers.metrics.family import MetricType, Snapshot
from imud.publishers.metrics.publisher import Renderer
from imud.publishers.metrics.recorder import FLIGHT_FAMILIES, RECORDER_FAMILIES, RECORDINGS_FAMILIES
from tests.support.files import ROOT


def shown(*recorders: RecorderStatus, flights: Sequence[FlightStatus] = ()) -> dict[str, float]:
    """Values by name, and by what became of snapshots."""
    body = Renderer(pause=lambda: None).render(Snapshot(recorders=recorders, flights=flights), "").body.decode()
    lines = [line for metric in parse_text(body) for line in metric.samples]
    return {
        line.name + line.labels.get("result", ""): line.value
        for line in lines
        if line.name.startswith(("imud_recorder", "imud_recordings", "imud_flight"))
    }


def test_each_value_is_that_of_the_status() -> None:
    assert shown(RecorderStatus("a", "", 1, 2, 3, 4, 5, 6)) == {
        "imud_recorder_active": 1,
        "imud_recorder_written_bytes_total": 1,
        "imud_recorder_records_total": 2,
        "imud_recorder_records_dropped_total": 3,
        "imud_recorder_waiting_bytes": 4,
        "imud_recorder_files_removed_total": 5,
        "imud_recordings_bytes": 6,
    }
    assert shown(RecorderStatus("", "No space left on device", 1, 2, 3, 4, 5, 6))["imud_recorder_active"] == 0
    assert shown() == {}


def test_of_the_flight_recorder_too() -> None:
    assert shown(flights=[FlightStatus("", 90_500_000_000, 2, 3, 4, 5, 6, 7, 8)]) == {
        "imud_flight_recorder_active": 1,
        "imud_flight_recorder_kept_seconds": 90.5,
        "imud_flight_recorder_kept_bytes": 2,
        "imud_flight_recorder_records_dropped_total": 3,
        "imud_flight_recorder_snapshots_totalsaved": 4,
        "imud_flight_recorder_snapshots_totalfailed": 5,
        "imud_flight_recorder_snapshots_totalleft_out": 6,
        "imud_flight_recorder_snapshots_sent_total": 7,
        "imud_recordings_bytes": 8,
    }
    both = shown(RecorderStatus("a", "", 1, 2, 3, 4, 5, 6), flights=[FlightStatus("", 1, 2, 3, 4, 5, 6, 7, 5)])
    assert both["imud_recordings_bytes"] == 6  # with the present file
    full = FlightStatus("No space left on device", 0, 0, 0, 0, 0, 0, 0, 0)
    assert shown(flights=[full])["imud_flight_recorder_active"] == 0


def test_names_say_the_type_and_are_documented() -> None:
    page = (ROOT / "docs/metrics.md").read_text()
    for family in (*RECORDER_FAMILIES, *FLIGHT_FAMILIES, *RECORDINGS_FAMILIES):
        assert (family.type is MetricType.COUNTER) == family.name.endswith("_total")
        assert f"`{family.name}`" in page
