"""Gateway that sends given messages with QoS 1 and waits for the acknowledgements."""

from collections.abc import Iterable
from typing import Any

import msgspec

from imud.fleet.accounts import GatewayState
from imud.fleet.messages import (
    STATE,
    VERSION,
    DropCause,
    FleetMessage,
    GatewayClock,
    Interval,
    Measures,
    MessageKind,
    Stream,
    encode_message,
    topic_of,
)
from imud.model.event import Event, EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS

LIMIT_S = 60.0
UTC_NS = 1_790_000_000_000_000_000


def samples_message(
    first: int, last: int, *, gateway: str = "gw", boot: str = "1", device: str = "bow", utc_ns: int = UTC_NS
) -> FleetMessage:
    """Return complete samples with these numbers at 1 kHz. `utc_ns` is the time of number 0."""
    samples = [
        Sample(
            device, seq, seq * NS_PER_MS, 500, Sync.EDGE, seq * NS_PER_MS + 10, utc_ns + seq * NS_PER_MS,
            accel_m_s2=(seq / 8, 0.0, 9.75), temperature_c=21.5,
        )
        for seq in range(first, last + 1)
    ]  # fmt: skip
    return FleetMessage(
        v=VERSION, gateway=gateway, boot=boot, device=device, kind=MessageKind.SAMPLES, begin=1, first=first, last=last,
        count=len(samples), utc_ns=samples[-1].utc_ns, samples=samples,
    )  # fmt: skip


def intervals_message(first: int, last: int, *, boot: str = "1", utc_ns: int = UTC_NS) -> FleetMessage:
    begin, end = first * NS_PER_MS, last * NS_PER_MS
    one = Interval(
        first, last, last - first + 1, begin, end, utc_ns + begin, utc_ns + end, 500, Sync.EDGE,
        {"accel_m_s2": Measures(mean=(1.0, 2.0, 3.0))},
    )  # fmt: skip
    made = samples_message(first, last, boot=boot, utc_ns=utc_ns)
    return msgspec.structs.replace(made, kind=MessageKind.INTERVALS, samples=[], intervals=[one])


def event_message(number: int, t_ns: int, *, boot: str = "1", utc_ns: int = UTC_NS) -> FleetMessage:
    made = samples_message(number, number, boot=boot)
    events = [Event(t_ns, "bow", EventKind.UP, "it is up")]
    return msgspec.structs.replace(made, kind=MessageKind.EVENTS, samples=[], events=events, utc_ns=utc_ns + t_ns)


def not_set(message: FleetMessage, utc_ns: int = 0) -> FleetMessage:
    """Return the message with an unsynchronized clock. `utc_ns` is its time at t_ns = 0."""
    return msgspec.structs.replace(message, clock=GatewayClock(0, utc_ns, synchronised=False))


def synchronised(message: FleetMessage, utc_ns: int = UTC_NS, *, t_ns: int = 0, error_ns: int = 1000) -> FleetMessage:
    return msgspec.structs.replace(message, clock=GatewayClock(t_ns, utc_ns, synchronised=True, error_ns=error_ns))


def dropped_message(first: int, last: int, *, gateway: str = "gw", boot: str = "1") -> FleetMessage:
    return msgspec.structs.replace(
        samples_message(first, last, gateway=gateway, boot=boot), kind=MessageKind.DROPPED, cause=DropCause.SPACE,
        samples=[],
    )  # fmt: skip


class SendingGateway:
    """MQTT client of the test. Synchronization: one thread."""

    def __init__(self, port: int) -> None:
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion

        self._client: Any = Client(CallbackAPIVersion.VERSION2, "sending", protocol=MQTTv5)
        self._client.max_inflight_messages_set(500)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def send(self, *messages: FleetMessage, stream: Stream = Stream.SAMPLES) -> None:
        self.publish((topic_of("mill", one.gateway, one.device, stream), encode_message(one)) for one in messages)

    def send_state(self, state: GatewayState, gateway: str = "gw") -> None:
        self.publish([(topic_of("mill", gateway, "", STATE), msgspec.json.encode(state))], retain=True)

    def publish(self, messages: Iterable[tuple[str, bytes]], *, retain: bool = False) -> None:
        """Publish payloads and wait until the broker acknowledges them."""
        for info in [self._client.publish(topic, payload, qos=1, retain=retain) for topic, payload in messages]:
            info.wait_for_publish(LIMIT_S)
            assert info.is_published()

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()
