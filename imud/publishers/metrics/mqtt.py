"""Table of the metrics of the output `mqtt`; there are none where there is no such output."""

from collections.abc import Callable
from typing import Final

from imud.contracts.status import MqttStatus
from imud.publishers.metrics.family import BYTES, NO_UNIT, Family, Lines, MetricType, Reader, Snapshot, Unit, each


def _mqtt(read: Callable[[MqttStatus], float]) -> Reader:
    """A value of the output."""
    return each(lambda snapshot: snapshot.mqtts, read)


def _dropped(snapshot: Snapshot) -> Lines:
    return [((cause,), count) for status in snapshot.mqtts for cause, count in status.dropped.items()]


def _counter_of(name: str, words: str, read: Callable[[MqttStatus], float]) -> Family:
    return Family(f"imud_mqtt_{name}_total", MetricType.COUNTER, NO_UNIT, words, _mqtt(read))


def _gauge_of(name: str, unit: Unit, words: str, read: Callable[[MqttStatus], float]) -> Family:
    return Family(f"imud_mqtt_{name}", MetricType.GAUGE, unit, words, _mqtt(read))


MQTT_FAMILIES: Final = (
    _gauge_of("connected", NO_UNIT, "1 while a broker is connected, else 0.", lambda status: bool(status.broker)),
    _gauge_of(
        "spooling", NO_UNIT, "1 while the spool can be written, 0 while the disk does not let it.",
        lambda status: not status.spool_problem,
    ),
    _counter_of("queued", "Samples and events given to the output.", lambda status: status.queued),
    _counter_of("spooled_messages", "Messages written to the spool.", lambda status: status.spooled),
    _counter_of("sent_messages", "Messages sent, those sent again included.", lambda status: status.sent),
    _counter_of("acknowledged_messages", "Messages that the broker has taken.", lambda status: status.acknowledged),
    _gauge_of("waiting_messages", NO_UNIT, "Messages in the spool.", lambda status: status.waiting),
    _gauge_of("spool_bytes", BYTES, "Room that the spool uses.", lambda status: status.spool_bytes),
    _counter_of(
        "thinned", "Samples of which only statistics are left, for want of room in the spool.",
        lambda status: status.thinned,
    ),
    Family(
        "imud_mqtt_dropped_total", MetricType.COUNTER, NO_UNIT, "Samples and events that were dropped, by cause.",
        Reader(("cause",), _dropped),
    ),
    _counter_of("reconnects", "Connections to a broker after the first.", lambda status: status.reconnects),
    _counter_of("commands", "Requests for actions that were carried out, or tried.", lambda status: status.commands),
    _counter_of("commands_refused", "Requests for actions that were refused.", lambda status: status.commands_refused),
)  # fmt: skip
