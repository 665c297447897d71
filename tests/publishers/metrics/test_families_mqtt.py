"""Metrics of the output `mqtt`: each value, and no metric without the output."""

from imud.contracts.status import MqttStatus
from imud.publishers.metrics.metric import Snapshot
from tests.support.metrics import shown


def test_each_metric_is_a_value_of_the_output() -> None:
    status = MqttStatus("mqtt://a:1883", "", "", 1, 2, 3, 4, 5, 6, 7, {"age": 8, "space": 9}, 10, 11, 12, {"a": "no"})
    assert shown("imud_mqtt_", Snapshot(mqtts=(status,))) == {
        "connected": 1, "spooling": 1, "queued_total": 1, "spooled_messages_total": 2, "sent_messages_total": 3,
        "acknowledged_messages_total": 4, "waiting_messages": 5, "refused_topics": 1, "spool_bytes": 6,
        "thinned_total": 7, "dropped_total age": 8, "dropped_total space": 9, "reconnects_total": 10,
        "commands_total": 11, "commands_refused_total": 12,
    }  # fmt: skip
    assert shown("imud_mqtt_", Snapshot()) == {}


def test_a_failure_is_zero() -> None:
    status = MqttStatus("", "refused", "full", 0, 0, 0, 0, 0, 0, 0, {}, 0)
    values = shown("imud_mqtt_", Snapshot(mqtts=(status,)))
    assert (values["connected"], values["spooling"]) == (0, 0)
