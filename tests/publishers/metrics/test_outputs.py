"""Metrics of outputs that send sentences: each value of each way out, and none without one."""

from prometheus_client.parser import text_string_to_metric_families as parse_text

from imud.contracts.status import OutputStatus
from imud.publishers.metrics.family import MetricType, Snapshot
from imud.publishers.metrics.outputs import OUTPUT_FAMILIES
from imud.publishers.metrics.publisher import Renderer


def shown(*outputs: OutputStatus) -> dict[tuple[str, str], float]:
    """Values by name and way out."""
    body = Renderer(pause=lambda: None).render(Snapshot(outputs=outputs), "").body.decode()
    lines = [line for metric in parse_text(body) for line in metric.samples]
    return {
        (line.name.removeprefix("imud_nmea0183_"), line.labels["output"]): line.value
        for line in lines
        if line.name.startswith("imud_nmea0183")
    }


def test_each_value_is_that_of_the_way_out() -> None:
    tcp, serial = "tcp 127.0.0.1:10110", "serial /dev/ttyUSB0"
    assert shown(OutputStatus(tcp, 1, 2, 3, ""), OutputStatus(serial, 4, 5, 0, "No such file or directory")) == {
        ("sentences_total", tcp): 1,
        ("sentences_dropped_total", tcp): 2,
        ("readers", tcp): 3,
        ("sentences_total", serial): 4,
        ("sentences_dropped_total", serial): 5,
        ("readers", serial): 0,
    }
    assert shown() == {}


def test_names_say_the_type() -> None:
    for family in OUTPUT_FAMILIES:
        assert (family.type is MetricType.COUNTER) == family.name.endswith("_total")
