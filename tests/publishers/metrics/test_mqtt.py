"""Metrics of the output `mqtt`: each value, and none without the output."""

from prometheus_client.parser import text_string_to_metric_families as parse_text

from imud.contracts.status import MqttStatus
from imud.publishers.metrics.family import MetricType, Snapshot
from imud.publishers.metrics.mqtt import MQTT_FAMILIES
from imud.publishers.metrics.publisher import Renderer


def shown(*statuses: MqttStatus) -> dict[str, float]:
    """Values by name, with the cause behind it."""
    body = Renderer(pause=lambda: None).render(Snapshot(mqtts=statuses), "").body.decode()
    lines = [line for metric in parse_text(body) for line in metric.samples]
    return {
        line.name.removeprefix("imud_mqtt_") + line.labels.get("cause", ""): line.value
        for line in lines
        if line.name.startswith("imud_mqtt")
    }


def test_each_value_is_that_of_the_output() -> None:
    status = MqttStatus("mqtt://a:1883", "", "", 1, 2, 3, 4, 5, 6, 7, {"age": 8, "space": 9}, 10, 11, 12)
    assert shown(status) == {
        "connected": 1, "spooling": 1, "queued_total": 1, "spooled_messages_total": 2, "sent_messages_total": 3,
        "acknowledged_messages_total": 4, "waiting_messages": 5, "spool_bytes": 6, "thinned_total": 7,
        "dropped_totalage": 8, "dropped_totalspace": 9, "reconnects_total": 10,
        "commands_total": 11, "commands_refused_total": 12,
    }  # fmt: skip
    assert shown() == {}


def test_what_does_not_work_is_zero() -> None:
    values = shown(MqttStatus("", "refused", "full", 0, 0, 0, 0, 0, 0, 0, {}, 0))
    assert (values["connected"], values["spooling"]) == (0, 0)


def test_names_say_the_type() -> None:
    for family in MQTT_FAMILIES:
        assert (family.type is MetricType.COUNTER) == family.name.endswith("_total")
