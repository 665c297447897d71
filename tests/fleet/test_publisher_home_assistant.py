"""Discovery messages for Home Assistant: its keys, and templates that return the right values for real messages of
imud.

Home Assistant uses Jinja2 templates, and the test renders them with Jinja2. The keys are from its documentation
("MQTT", sections "Device discovery payload" and "Availability").
"""

import json
import re
from pathlib import Path

import msgspec
import pytest

from imud.contracts.status import DeviceState, DeviceStatus
from imud.fleet.messages import FleetMessage, MessageKind, encode_message
from imud.fleet.publisher import discovery_of, discovery_topic
from imud.fleet.settings import DeviceSending
from imud.fleet.statistics import summed_up
from imud.fleet.streams import Gateway
from imud.model.sample import Sample
from tests.fleet.test_publisher import PublisherBench
from tests.support.socket_rig import device_status, sample

jinja2 = pytest.importorskip("jinja2", reason="jinja2 is not installed (extra dev)")

GATEWAY = Gateway("mill", "gw-17", "b")
# Required keys of an entity by platform, in addition to `platform` and `unique_id`
REQUIRED = {"binary_sensor": {"state_topic"}, "sensor": {"state_topic"}}


def status(**changes: object) -> DeviceStatus:
    return msgspec.structs.replace(device_status("bow", 0), **changes)


def rendered(template: str, payload: bytes) -> str:
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=False)
    return str(environment.from_string(template).render(value_json=json.loads(payload)))


def parts(sending: DeviceSending | None = None) -> dict[str, dict[str, str]]:
    made = json.loads(msgspec.json.encode(discovery_of(GATEWAY, status(), sending or DeviceSending())))
    found: dict[str, dict[str, str]] = made["components"]
    return found


def statistics(samples: list[Sample]) -> bytes:
    interval = summed_up(samples)
    assert interval is not None
    message = FleetMessage(
        v=1, gateway="gw-17", boot="b", device="bow", kind=MessageKind.INTERVALS, begin=1, first=1, last=len(samples),
        count=len(samples), utc_ns=0, intervals=[interval],
    )  # fmt: skip
    return encode_message(message)


def test_the_configuration_has_what_home_assistant_requires() -> None:
    made = json.loads(msgspec.json.encode(discovery_of(GATEWAY, status(identity={"product": "HI14"}), DeviceSending())))
    assert made["device"]["model"] == "HI14"
    assert made["device"]["identifiers"]
    assert made["origin"]["name"] == "imud"
    ids = [part["unique_id"] for part in made["components"].values()]
    assert len(set(ids)) == len(ids) == 7
    for part in made["components"].values():
        assert REQUIRED[part["platform"]] <= part.keys()
    assert re.fullmatch(r"homeassistant/device/[a-zA-Z0-9_-]+/config", discovery_topic(GATEWAY, "bow"))
    topics = {discovery_topic(Gateway("s", gateway, ""), device) for gateway, device in (("a", "b_c"), ("a_b", "c"))}
    topics.add(discovery_topic(Gateway("t", "a", ""), "b_c"))
    assert len(topics) == 3
    assert "roll" not in parts(DeviceSending(rate_hz=None))
    assert "roll" not in parts(DeviceSending(values=["rms"]))


def test_values_are_rendered() -> None:
    found = parts()
    running = msgspec.json.encode(status(state=DeviceState.RUNNING, temperature_c=41.26, rate_hz=99.96))
    assert rendered(found["temperature"]["value_template"], running) == "41.3"
    assert rendered(found["rate"]["value_template"], running) == "100.0"
    silent = msgspec.json.encode(status(temperature_c=None))
    assert rendered(found["temperature"]["value_template"], silent) == ""
    payload = statistics([msgspec.structs.replace(sample("bow", 1), euler_rad=(0.1, -0.2, 3.0))])
    # 0.1 · 180/π = 5.7296, -0.2 · 180/π = -11.459, 3 · 180/π = 171.887
    assert rendered(found["roll"]["value_template"], payload) == "5.73"
    assert rendered(found["pitch"]["value_template"], payload) == "-11.46"
    assert rendered(found["yaw"]["value_template"], payload) == "171.89"
    template = found["roll"]["value_template"]
    assert rendered(template, statistics([msgspec.structs.replace(sample("bow", 1), euler_rad=None)])) == ""
    assert rendered(template, b'{"kind": "dropped", "first": 1}') == ""


def test_entities_expire() -> None:
    made = discovery_of(GATEWAY, status(), DeviceSending(rate_hz=0.5, batch_s=1.0), 20.0)
    components = json.loads(msgspec.json.encode(made))["components"]
    # three intervals of the state messages, and of the statistics
    assert {name: part["expire_after"] for name, part in components.items()} == {
        "condition": 60, "problem": 60, "rate": 60, "temperature": 60, "roll": 6, "pitch": 6, "yaw": 6,
    }  # fmt: skip
    made = discovery_of(GATEWAY, status(), DeviceSending(rate_hz=100.0, batch_s=0.1))
    assert json.loads(msgspec.json.encode(made))["components"]["roll"]["expire_after"] == 1


@pytest.mark.parametrize(("state", "availability"), [(state, state == "running") for state in DeviceState])
def test_values_are_unavailable_without_samples(state: DeviceState, availability: bool) -> None:
    components = json.loads(msgspec.json.encode(discovery_of(GATEWAY, status(), DeviceSending())))["components"]
    payload = msgspec.json.encode(status(state=state))
    for name in ("temperature", "roll", "pitch", "yaw"):
        assert components[name]["availability_mode"] == "all"
        of_gateway, of_samples = components[name]["availability"]
        assert of_gateway["topic"] == "imud/mill/gw-17/state"
        assert of_samples["topic"] == "imud/mill/gw-17/bow/status"
        assert rendered(of_samples["value_template"], payload) == ("online" if availability else "offline")
    for name in ("condition", "problem", "rate"):
        assert "availability" not in components[name], "the state of a device without samples is current"


@pytest.mark.live
def test_availability_follows_birth_and_last_will(tmp_path: Path) -> None:
    bench = PublisherBench(tmp_path, home_assistant=True)
    bench.start()
    bench.tick()
    topic = discovery_topic(Gateway("default", "gw", ""), "imu0")
    bench.broker.wait_for(topic)
    bench.output.remove_device("imu0")
    bench.statuses = []
    bench.tick()
    bench.broker.wait_for(topic, lambda payload: not payload)  # imud removes the device from Home Assistant
    sent = bench.close()
    first = next(json.loads(payload) for one, payload, retain in sent if one == topic and payload and retain)
    (availability,) = first["availability"]
    births = [payload for one, payload, _ in sent if one == availability["topic"]]
    assert bench.broker.will is not None
    assert bench.broker.will.topic == availability["topic"]
    assert rendered(availability["value_template"], births[0]) == "online"
    assert rendered(availability["value_template"], bench.broker.will.payload) == "offline"
