"""Metrics of the recorder: each value of its status, and none without a recorder."""

from prometheus_client.parser import text_string_to_metric_families as parse_text

from imud.contracts.status import RecorderStatus
from imud.publishers.metrics.family import MetricType, Snapshot
from imud.publishers.metrics.publisher import Renderer
from imud.publishers.metrics.recorder import RECORDER_FAMILIES
from tests.support.files import ROOT


def shown(*recorders: RecorderStatus) -> dict[str, float]:
    """Values by name."""
    body = Renderer(pause=lambda: None).render(Snapshot(recorders=recorders), "").body.decode()
    lines = [line for metric in parse_text(body) for line in metric.samples]
    return {line.name: line.value for line in lines if line.name.startswith("imud_recorder")}


def test_each_value_is_that_of_the_status() -> None:
    assert shown(RecorderStatus("a", "", 1, 2, 3, 4, 5)) == {
        "imud_recorder_active": 1,
        "imud_recorder_written_bytes_total": 1,
        "imud_recorder_records_total": 2,
        "imud_recorder_records_dropped_total": 3,
        "imud_recorder_waiting_bytes": 4,
        "imud_recorder_files_removed_total": 5,
    }
    assert shown(RecorderStatus("", "No space left on device", 1, 2, 3, 4, 5))["imud_recorder_active"] == 0
    assert shown() == {}


def test_names_say_the_type_and_are_documented() -> None:
    page = (ROOT / "docs/metrics.md").read_text()
    for family in RECORDER_FAMILIES:
        assert (family.type is MetricType.COUNTER) == family.name.endswith("_total")
        assert f"`{family.name}`" in page
