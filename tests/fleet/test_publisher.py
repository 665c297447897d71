"""Complete output with a broker in memory: births and states, content of the queue, problems."""

import json
import struct
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zstandard

from imud.contracts.lines import UtcReference
from imud.contracts.publisher import Batch
from imud.contracts.setting import OnDifference, SettingDifference, SettingsState, SettingsStatus
from imud.contracts.status import DeviceState, DeviceStatus
from imud.fleet.publisher import MqttPublisher, discovery_topic
from imud.fleet.settings import Broker, MqttOptions, broker_of
from imud.fleet.streams import Gateway
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.model.options import wrong_values
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.fleet.fake_broker import FakeBroker
from tests.support.event_loops import VirtualClock
from tests.support.publisher_context import publisher_context
from tests.support.signal_bench import HandWorkers
from tests.support.socket_rig import device_status, sample

pytestmark = pytest.mark.live


class PublisherBench:
    """Output without the thread of the writer: the test runs its work. The thread of the sender runs."""

    def __init__(self, path: Path, **settings: object) -> None:
        self.clock, self.broker = VirtualClock(), FakeBroker(blocks=True)
        self.events: list[Event] = []
        self.statuses: list[DeviceStatus] = [device_status("imu0", 0)]
        self.asked = 0
        self.workers = HandWorkers()
        self.reference: UtcReference | None = None
        self.context = publisher_context(
            self._status, 77, self.clock.now_ns, raise_event=self.events.append, utc_offset_ns=lambda: 99,
            utc_reference=lambda: self.reference,
        )  # fmt: skip
        made = msgspec.convert({"spool_directory": str(path), "gateway": "gw", **settings}, MqttOptions)
        self.output = MqttPublisher(
            made, self.context, connect=self.broker.connect, start_worker=self.workers.start,
            host_name=lambda: "host.example",
        )  # fmt: skip

    def _status(self) -> list[DeviceStatus]:
        self.asked += 1
        return self.statuses

    def tick(self, seconds: float = 1.0) -> None:
        self.clock.advance(round(seconds * NS_PER_S))
        self.output.tick(self.clock.now_ns())
        self.workers[0].work()

    def start(self, device_id: int = 0, device: str = "imu0") -> None:
        self.output.add_device(device, device_id)
        self.output.start()

    def close(self) -> list[tuple[str, bytes, bool]]:
        """Close the output. Return all sent messages."""
        self.output.close()
        self.output.close()
        return [one for connection in self.broker.connections for one in connection.sent]


def test_birth_states_and_farewell(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, devices={"imu0": {"settings": False}})
    bench.statuses = [msgspec.structs.replace(device_status("imu0", 0), settings={"rate_hz": "50"})]
    bench.start()
    bench.tick()
    bench.broker.wait_for("imud/default/gw/imu0/schema")
    sent = bench.close()
    topics = {topic: json.loads(payload) for topic, payload, retain in sent if retain}
    assert {"imud/default/gw/state", "imud/default/gw/imu0/status", "imud/default/gw/imu0/schema"} == set(topics)
    assert json.loads(sent[0][1])["online"] is True
    assert json.loads(sent[0][1])["boot"] == "000000000000004d"
    farewell = {"v": 1, "online": False, "boot": "000000000000004d", "reason": "imud stopped"}
    assert topics["imud/default/gw/state"] == farewell
    assert topics["imud/default/gw/imu0/schema"]["slot"]["bytes"] == 320
    assert topics["imud/default/gw/imu0/status"]["state"] == "running"
    assert bench.broker.will is not None
    will = json.loads(bench.broker.will.payload)
    assert (will["online"], will["reason"]) == (False, "connection lost")


def test_states_are_published_after_events_and_periodically(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, status_s=60)
    bench.start()
    bench.tick()
    assert bench.asked == 1
    for _ in range(50):
        bench.tick()
        bench.output.event(Event(0, "imu0", EventKind.MARK, "pulse"))
    assert bench.asked == 1
    bench.output.event(Event(0, "imu0", EventKind.DOWN, "gone"))
    bench.statuses = [msgspec.structs.replace(bench.statuses[0], state=DeviceState.MISSING)]
    bench.tick()
    bench.broker.wait_for("imud/default/gw/imu0/status", lambda payload: b'"missing"' in payload)
    assert bench.asked == 2
    for _ in range(30):
        bench.tick()
    assert (bench.asked, bench.events) == (3, [])
    bench.close()


def test_a_removed_device_leaves_no_retained_state(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path)
    bench.start()
    bench.tick()
    bench.output.remove_device("imu0")
    bench.statuses = []
    bench.tick()
    bench.tick(100)
    sent = [topic for topic, payload, _ in bench.close() if not payload]
    assert set(sent) <= {"imud/default/gw/imu0/status", "imud/default/gw/imu0/schema"}
    assert bench.output.status().broker == ""


def test_a_device_removed_between_two_runs_leaves_no_retained_state(tmp_path: Path) -> None:
    """The broker acknowledges the removal in the fourth run."""
    removed = []
    for device, answers in (("imu0", 99), ("imu1", 0), ("imu1", 0), ("imu1", 99), ("imu1", 99)):
        bench = PublisherBench(tmp_path, home_assistant=True)
        bench.broker.answers, bench.broker.window = answers, 20
        bench.statuses = [msgspec.structs.replace(device_status(device, 0), settings={"rate_hz": "50"})]
        bench.start(device=device)
        bench.tick()
        bench.broker.wait_for(f"imud/default/gw/{device}/schema")
        bench.tick()
        removed.append({topic for topic, payload, _ in bench.close() if not payload})
    topics = {f"imud/default/gw/imu0/{leaf}" for leaf in ("status", "schema", "settings")}
    topics.add(discovery_topic(Gateway("default", "gw", ""), "imu0"))
    assert removed == [set(), topics, topics, topics, set()]


def test_settings_are_published_when_they_change(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, devices={"imu0": {"status": False}})
    topic = "imud/default/gw/imu0/settings"

    def declare(state: SettingsState, read_ns: int, **differences: SettingDifference) -> None:
        declared = SettingsStatus(state, OnDifference.REPORT, differences=differences, read_ns=read_ns)
        status = msgspec.structs.replace(device_status("imu0", 0), settings={"rate_hz": "50"}, declared=declared)
        bench.statuses = [status]
        bench.output.event(Event(0, "imu0", EventKind.CONFIGURATION, "x"))
        bench.tick()

    bench.start()
    declare(SettingsState.AGREE, 1)
    bench.broker.wait_for(topic)
    declare(SettingsState.AGREE, 2)  # another reading without a difference
    declare(SettingsState.DIFFER, 3, rate_hz=SettingDifference(100, 50))
    bench.broker.wait_for(topic, lambda payload: b'"differ"' in payload)
    bench.output.remove_device("imu0")
    bench.tick()
    bench.broker.wait_for(topic, lambda payload: not payload)
    messages = bench.close()
    assert {one for one, _, retain in messages if retain} == {"imud/default/gw/state", topic}
    sent = [json.loads(payload) for one, payload, _ in messages if one == topic and payload]
    assert [one["state"] for one in sent] == ["agree", "differ"]
    assert sent[1]["differences"] == {"rate_hz": {"declared": 100, "actual": 50}}
    assert sent[1]["actual"] == {"rate_hz": "50"}


def test_only_configured_devices_are_queued(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, devices={"imu0": {}})
    for name in ("imu0", "imu1"):
        bench.output.add_device(name, 0)
    bench.output.start()
    for name in ("imu0", "imu1"):
        bench.output.publish(Batch(name, 0, [sample(name, 1), sample(name, 2)]))
        bench.output.event(Event(0, name, EventKind.LOSS, "x"))
    assert bench.output.status().queued == 3
    bench.output.event(Event(0, "", EventKind.CONFIGURATION, "x"))
    assert (bench.output.status().queued, bench.context.outputs.mqtts) == (4, [bench.output.status])
    bench.close()
    assert bench.context.outputs.mqtts == []


def test_a_failed_spool_or_a_refused_topic_causes_an_event_and_the_output_continues(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path / "spool")
    bench.start()
    database = tmp_path / "spool" / "spool.db"
    bench.output.publish(Batch("imu0", 0, [sample("imu0", 1)]))
    bench.tick()
    for path in tmp_path.glob("spool/spool.db*"):
        path.write_bytes(b"\xff" * 10_000)
    for _ in range(20):
        bench.output.event(Event(0, "imu0", EventKind.LOSS, "x"))
        bench.tick(20)
    messages = [event.message for event in bench.events]
    assert any("the spool failed" in one for one in messages), messages
    assert any("the spool works again" in one for one in messages), messages
    assert sum("the spool was damaged" in one for one in messages) == 1, messages
    assert all(event.kind is EventKind.MQTT and not event.device for event in bench.events)
    assert database.exists()
    bench.broker.refuses = {"imud/default/gw/imu0/events"}
    while len(bench.output.status().refused) != 1:
        bench.output.event(Event(0, "imu0", EventKind.LOSS, "x"))
        bench.tick()
    bench.tick()
    assert bench.events[-1].message.startswith("the broker refuses messages of imud/default/gw/imu0/events: Not auth")
    bench.close()


def test_an_internal_error_in_a_thread_ends_the_daemon(tmp_path: Path) -> None:
    first, second = PublisherBench(tmp_path), PublisherBench(tmp_path)
    first.output.start()
    with pytest.raises(ServerError, match="another imud process"):
        second.output.start()  # two outputs cannot use one spool
    (tmp_path / "file").touch()
    with pytest.raises(ServerError, match=r"expected a directory that imud can write; set mqtt\.spool_directory"):
        PublisherBench(tmp_path / "file").output.start()
    first.workers[0].failed(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        first.output.tick(0)
    first.close()
    second.output.start()
    second.close()


def test_the_host_name_is_the_default_gateway_name(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, gateway="")
    bench.output.start()
    bench.close()
    assert bench.broker.will is not None
    assert bench.broker.will.topic == "imud/default/host/state"
    for name in ("Gerät", "localhost", "localhost.localdomain", "localhost6"):
        odd = MqttPublisher(
            MqttOptions(spool_directory=str(tmp_path)), bench.context, connect=bench.broker.connect,
            host_name=name.__str__,
        )  # fmt: skip
        with pytest.raises(ServerError, match=f"mqtt.gateway: expected 1 to 64 .* '{name.partition('.')[0]}'"):
            odd.start()
    with pytest.raises(ValueError, match="gateway: expected a name that no other gateway has"):
        MqttOptions(gateway="IP6-localhost")


def test_without_the_extra_only_this_output_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    output = MqttPublisher(MqttOptions(spool_directory=str(tmp_path)), PublisherBench(tmp_path).context)
    with pytest.raises(ServerError, match=r"cannot import paho; install the extra mqtt: .* install 'imud\[mqtt\]'$"):
        output.start()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"brokers": []}, "brokers: expected a list of 1 to 16"),
        ({"brokers": ["http://a"]}, "expected a URL such as mqtts://"),
        ({"brokers": ["mqtt://user:secret@a"]}, "no user"), ({"brokers": ["mqtt://a:99999"]}, "expected a URL"),
        ({"brokers": ["mqtt://a/path"]}, "expected a URL"), ({"site": "a/b"}, "site: expected letters, digits"),
        ({"key_file": "/k"}, "key_file: expected cert_file as well"),
        ({"password_file": "/p"}, "password_file: expected user as well"),
        ({"devices": {"a b": {}}}, "devices: expected names of devices"),
        (
            {"devices": {"*": {"rate_hz": 0.001}}},
            'devices: expected a number from 0.01 to 100, or null, got 0.001, at "*.rate_hz"',
        ),
        ({"devices": {"*": {"whole": "xml"}}}, 'expected one of "none", "json", "slots", got "xml", at "*.whole"'),
        ({"devices": {"*": {"wole": "json"}}}, "wole"), ({"version": "3.1"}, "version: expected"),
    ],
)  # fmt: skip
def test_bad_settings_are_named(given: Mapping[str, Any], words: str) -> None:
    (wrong,) = wrong_values(MqttOptions, given)
    assert words in str(wrong)


@pytest.mark.parametrize(
    ("url", "broker"),
    [
        ("mqtt://a", Broker("a", 1883, False, False, "/mqtt")),
        ("mqtts://a.example", Broker("a.example", 8883, True, False, "/mqtt")),
        ("ws://10.0.0.1:8080/x", Broker("10.0.0.1", 8080, False, True, "/x")),
        ("wss://[::1]", Broker("::1", 443, True, True, "/mqtt")),
    ],
)
def test_urls_of_brokers_and_names_of_devices(url: str, broker: Broker) -> None:
    assert (broker_of(url), broker_of(broker.name)) == (broker, broker)
    settings = msgspec.convert({"devices": {"bow": {"rate_hz": 5}, "*": {"rate_hz": 2}}}, MqttOptions)
    assert [getattr(settings.sending(name), "rate_hz", None) for name in ("bow", "mast")] == [5, 2]
    alone = msgspec.convert({"devices": {"bow": {}}}, MqttOptions)
    assert alone.sending("mast") is None


def test_birth_and_messages_contain_the_state_of_the_wall_clock(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path)
    bench.start()
    bench.reference = UtcReference(100, 40)
    bench.tick(1000)  # more than status_s
    bench.output.event(Event(1, "imu0", EventKind.UP, "it is up"))
    bench.tick()
    bench.broker.wait_for("imud/default/gw/imu0/events")
    sent = [(topic, json.loads(payload)) for topic, payload, _ in bench.close()]
    first, *others = [found["clock"] for topic, found in sent if topic.endswith("/state") and found["online"]]
    assert (first["synchronised"], first["utc_offset_ns"], first["error_ns"]) == (False, 99, None)
    others += [found["clock"] for topic, found in sent if topic.endswith("/events")]
    assert len(others) >= 2
    for one in others:
        assert (one["synchronised"], one["utc_offset_ns"], one["error_ns"]) == (True, 100, 40)
        assert one["t_ns"] > first["t_ns"]


def fields_by_schema(slot: bytes, layout: Mapping[str, Any]) -> dict[str, Any]:
    order = {"little-endian": "<", "big-endian": ">"}[layout["byte_order"]]
    found: dict[str, Any] = {}
    for field in layout["fields"]:
        values = struct.unpack_from(f"{order}{field['count']}{field['code']}", slot, field["offset"])
        found[field["name"]] = values if field["count"] > 1 else values[0]
    for name, bit in layout["present_bits"].items():
        if not found["present"] & bit:
            found.pop(name, None)
    found["sync"] = {code: name for name, code in layout["sync_codes"].items()}[found["sync"]]
    return found


def test_slots_can_be_decoded_with_the_published_schema(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, devices={"*": {"whole": "slots", "rate_hz": None}})
    bench.start(3)
    sent = [
        Sample(
            "imu0", seq, seq * NS_PER_MS, 7, Sync.EDGE, seq * NS_PER_MS + 5, 1_800_000_000 * NS_PER_S + seq,
            accel_m_s2=(seq / 3, -0.1, 9.8), temperature_c=20.5,
        )
        for seq in (1, 2, 3)
    ]  # fmt: skip
    bench.output.publish(Batch("imu0", 3, sent))
    for _ in range(3):
        bench.tick()
    bench.broker.wait_for("imud/default/gw/imu0/samples")
    topics = {topic: payload for topic, payload, _ in bench.close()}
    layout = json.loads(topics["imud/default/gw/imu0/schema"])["slot"]
    payload = topics["imud/default/gw/imu0/samples"]
    begin = 8 + int.from_bytes(payload[6:8], "little")  # "IMUB", version, 0, length of the header (docs/fleet.md)
    slots, size = zstandard.ZstdDecompressor().decompress(payload[begin:]), 256
    assert (payload[4], layout["bytes"]) == (1, 320)  # version 1: the other bytes of each slot are 0
    assert len(slots) == 3 * size
    for at, one in enumerate(sent):
        found = fields_by_schema(slots[at * size : (at + 1) * size] + bytes(64), layout)
        assert {name: found[name] for name in ("seq", "t_ns", "t_rx_ns", "utc_ns", "device_id", "sync")} == {
            "seq": one.seq, "t_ns": one.t_ns, "t_rx_ns": one.t_rx_ns, "utc_ns": one.utc_ns, "device_id": 3,
            "sync": "edge",
        }  # fmt: skip
        assert (found["accel_m_s2"], found["temperature_c"]) == (one.accel_m_s2, 20.5)
        assert not {"gyro_rad_s", "mag_t", "quat_wxyz", "euler_rad", "pressure_pa", "t_dev_ns"} & set(found)
        assert found["crc32"] == zlib.crc32(slots[at * size : at * size + 252])


def test_status_without_current_samples_has_no_values(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, status_s=3600)
    topic = "imud/default/gw/imu0/status"
    device = msgspec.structs.replace(device_status("imu0", 0), temperature_c=21.5, expected_rate_hz=0.5)
    bench.statuses = [device]
    bench.start()
    bench.output.publish(Batch("imu0", 0, [sample("imu0", 1)]))
    for _ in range(6):
        bench.tick()
    bench.broker.wait_for(topic, lambda payload: json.loads(payload)["temperature_c"] == 21.5)
    for _ in range(2):
        bench.tick()  # more than three periods of 2 s
    bench.broker.wait_for(topic, lambda payload: json.loads(payload)["temperature_c"] is None)
    asked = bench.asked
    for _ in range(5):
        bench.tick()
    assert bench.asked == asked, "imud publishes the loss once"

    def temperatures() -> list[float | None]:
        messages = [message for connection in bench.broker.connections for message in connection.sent]
        return [json.loads(payload)["temperature_c"] for name, payload, _ in messages if name == topic]

    bench.output.publish(Batch("imu0", 0, [sample("imu0", 2)]))
    bench.tick()
    bench.broker.wait_for(topic, lambda _payload: temperatures() == [21.5, None, 21.5])
    bench.close()


def test_missing_acknowledgement_is_a_problem(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, devices={"imu0": {"rate_hz": None, "whole": "json"}})
    bench.broker.answers = 0
    bench.start()
    bench.output.event(Event(0, "imu0", EventKind.MARK, "pulse"))
    for _ in range(3):
        bench.tick()
    assert bench.output.status().waiting == 1
    assert "no delivery" not in bench.output.status().problem
    bench.clock.advance(8 * NS_PER_S)
    problem = bench.output.status().problem
    assert "no delivery for 10 s: 1 messages wait" in problem or "expected an acknowledgement" in problem
    bench.close()


def test_state_contains_its_interval(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, status_s=5)
    bench.start()
    bench.tick()
    bench.broker.wait_for("imud/default/gw/state", lambda payload: json.loads(payload).get("status_s") == 5.0)
    bench.close()
