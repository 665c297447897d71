"""JSON messages: each message is valid for its schema (library jsonschema) and contains the values of the sample."""

import json
from typing import Any

import msgspec
import pytest
from jsonschema import Draft202012Validator

from imud.attitude.conventions import UNSETTLED_BIT
from imud.bridges import channel as bridge
from imud.bridges.channel import MessageChannel, MessageFrames, StampedEvent
from imud.bridges.json import JsonDialect, status_channel
from imud.contracts.status import Deviations
from imud.model.event import Event, EventKind
from imud.model.sample import Position, Sample
from tests.bridges.samples import BARE, EVENT, FULL, UTC_NS
from tests.support.socket_rig import device_status

DIALECT = JsonDialect()
BOW = MessageFrames("bow")
STAMP = {"sec": 1_790_000_000, "nsec": 123_456_789}


def channels(frames: MessageFrames = BOW) -> dict[str, MessageChannel[Sample]]:
    return {channel.topic: channel for channel in DIALECT.samples(frames)}


def read(channel: MessageChannel[Any], item: object) -> Any:
    data = channel.encode(item)
    assert data is not None
    message = json.loads(data)
    schema = json.loads(channel.schema.data)
    assert schema["title"] == channel.schema.name
    if item is not BARE:  # NaN is null; no Foxglove schema allows null
        Draft202012Validator(schema).validate(message)
    assert set(message) <= set(schema["properties"]) or channel.schema.name == "imud.DeviceStatus"
    return message


def test_position_in_degrees() -> None:
    channel = channels()["/bow/fix"]
    fix = read(channel, FULL)
    assert (fix["latitude"], fix["longitude"], fix["altitude"]) == pytest.approx(
        (28.64788975654, -71.61972439135, 42.5)
    )
    assert (channel.schema.name, fix["timestamp"], fix["position_covariance_type"]) == (
        "foxglove.LocationFix",
        STAMP,
        0,
    )
    invalid = msgspec.structs.replace(FULL, position=Position(0.5, -1.25, quality=0))
    assert (channel.encode(BARE), channel.encode(invalid)) == (None, None)


def test_messages_and_schemas() -> None:
    assert read(channels()["/bow/imu/data"], FULL) == {
        "timestamp": STAMP, "frame_id": "bow", "orientation": {"x": 0.5, "y": -0.5, "z": 0.5, "w": 0.5},
        "angular_velocity": {"x": 0.25, "y": 0.5, "z": -0.75},
        "linear_acceleration": {"x": 0.125, "y": -0.5, "z": 9.75},
    }  # fmt: skip
    assert read(channels()["/bow/imu/data"], BARE) == {
        "timestamp": {"sec": 1_790_000_000, "nsec": 133_456_789},
        "frame_id": "bow",
        "angular_velocity": {"x": 0.0, "y": None, "z": 1.0},
    }
    for name in ("imu/mag", "temperature", "pressure", "attitude"):
        assert channels()[f"/bow/{name}"].encode(BARE) is None
    made = channels(MessageFrames("bow", deviations=Deviations(gyro_rad_s=0.5, mag_t=2.0, pressure_pa=10.0)))
    imu = read(made["/bow/imu/data"], FULL)
    assert imu["angular_velocity_covariance"] == [0.25, 0, 0, 0, 0.25, 0, 0, 0, 0.25]
    assert "linear_acceleration_covariance" not in imu
    unsettled = msgspec.structs.replace(FULL, status=1 << UNSETTLED_BIT)
    assert "orientation" in imu
    assert "orientation" not in read(made["/bow/imu/data"], unsettled)
    assert made["/bow/attitude"].encode(unsettled) is None
    assert read(made["/bow/imu/mag"], FULL)["magnetic_field_covariance"][4] == 4.0
    assert read(made["/bow/pressure"], FULL) == {
        "timestamp": STAMP, "frame_id": "bow", "fluid_pressure": 101325.0, "variance": 100.0
    }  # fmt: skip
    made = channels()
    assert read(made["/bow/imu/mag"], FULL)["magnetic_field"] == {"x": 1e-5, "y": -2e-5, "z": 4e-5}
    assert read(made["/bow/temperature"], FULL) == {"timestamp": STAMP, "frame_id": "bow", "temperature": 31.5}
    assert made["/bow/temperature"].encode(FULL) is None  # the same value again, without a pause
    channel = channels(MessageFrames("bow", has_north=False))["/bow/attitude"]
    assert channel.schema.name == "foxglove.FrameTransform"
    assert read(channel, FULL) == {
        "timestamp": STAMP, "parent_frame_id": "bow_level", "child_frame_id": "bow",
        "translation": {"x": 0.0, "y": 0.0, "z": 0.0}, "rotation": {"x": 0.5, "y": -0.5, "z": 0.5, "w": 0.5},
    }  # fmt: skip
    message = read(channels()["/bow/stamp"], FULL)
    assert message.pop("timestamp") == STAMP
    assert message == {
        "seq": 7, "t_ns": FULL.t_ns, "t_err_ns": 12_000, "sync": "edge", "t_rx_ns": FULL.t_rx_ns, "utc_ns": UTC_NS,
        "t_dev_ns": 5_000_000, "euler_rad": [0.1, 0.2, 0.3], "incli_rad": [0.01, 0.02], "status": 3,
        "pps_age_ms": 40, "edge_seq": 9, "velocity_enu_m_s": [1.5, -2.5, 0.25], "heave_m": -0.125,
        "position": {"latitude_rad": 0.5, "longitude_rad": -1.25, "height_m": 42.5, "quality": 4, "satellites": 17},
        "gnss_utc_ns": UTC_NS + 9,
    }  # fmt: skip
    assert "t_dev_ns" not in read(channels()["/bow/stamp"], BARE)
    said = {field for channel in channels().values() for field in channel.fields}
    assert said == set(Sample.__struct_fields__) - {"device"}
    assert DIALECT.events().schema.name == "foxglove.Log"
    message = read(DIALECT.events(), StampedEvent(EVENT, UTC_NS))
    assert message == {
        "timestamp": STAMP, "level": 3, "message": 'loss: lost 3, "damaged"', "name": "bow", "file": "", "line": 0
    }  # fmt: skip
    long = StampedEvent(Event(1, "bow", EventKind.UP, "x" * 5000), UTC_NS)
    assert read(DIALECT.events(), long).items() >= {"level": 2, "message": f"up: {4091 * 'x'}…"}.items()
    losses = read(DIALECT.losses("bow"), bridge.LossCounts(1, UTC_NS, "bow", 100, 1, 2, 3, 4, 5))
    assert losses == {
        "timestamp": STAMP, "samples": 100, "lost_gap_device": 1, "lost_crc": 2, "lost_overrun": 3, "lost_queue": 4,
        "lost_unknown": 5,
    }  # fmt: skip
    status = read(status_channel("bow"), (device_status("bow", 0), UTC_NS))
    assert (status["state"], status["rate_hz"], status["clock"]["sync"]) == ("running", 1000.0, "regression")
    bow = bridge.Diagnosis("bow", bridge.DiagnosisLevel.WARN, "searching", "17", {"t_err_ns": "12000"})
    assert read(DIALECT.diagnostics(), bridge.Diagnoses(UTC_NS, (bow,))) == {
        "header": {"stamp": STAMP, "frame_id": ""},
        "status": [
            {
                "level": 1, "name": "imud: bow", "message": "searching", "hardware_id": "17",
                "values": [{"key": "t_err_ns", "value": "12000"}],
            }
        ],
    }  # fmt: skip
    for name in ["imu/data", "imu/mag", "temperature", "pressure", "attitude", "stamp"]:
        Draft202012Validator.check_schema(json.loads(channels()[f"/bow/{name}"].schema.data))
    schema = json.loads(channels()["/bow/imu/data"].schema.data)
    number = {"type": "number"}
    assert schema["required"] == ["timestamp"]
    assert schema["properties"]["timestamp"]["required"] == ["sec", "nsec"]
    assert schema["properties"]["angular_velocity"] == {
        "type": "object", "properties": {"x": number, "y": number, "z": number}, "description": "rad/s"
    }  # fmt: skip
    assert schema["properties"]["angular_velocity_covariance"] == {
        "type": "array", "items": number, "minItems": 9, "maxItems": 9, "description": "rad²/s²"
    }  # fmt: skip
    fields = json.loads(channels()["/bow/stamp"].schema.data)["properties"]
    assert (fields["t_err_ns"]["type"], fields["incli_rad"]["items"]) == ("integer", number)
    assert [name for name, field in fields.items() if not field.get("description") and name != "timestamp"] == []
    diagnoses = json.loads(DIALECT.diagnostics().schema.data)["properties"]["status"]["items"]["properties"]
    assert diagnoses["values"]["items"]["properties"] == {"key": {"type": "string"}, "value": {"type": "string"}}
