# mypy: ignore-errors
# the types of cyclonedds.idl are no types for mypy
"""A robot with Cyclone DDS: a process with IDL types that prints each received message as a line of JSON.

    python cyclone_robot.py DOMAIN TOPIC...     it ends with its standard input

The types are the public definitions of ROS 2, decoded by the CDR reader of Cyclone DDS.
"""

import json
import select
import sys
from dataclasses import asdict, dataclass
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Imu(IdlStruct, typename="sensor_msgs::msg::dds_::Imu_"):
    header: Header
    orientation: Quaternion
    orientation_covariance: array[float64, 9]
    angular_velocity: Vector3
    angular_velocity_covariance: array[float64, 9]
    linear_acceleration: Vector3
    linear_acceleration_covariance: array[float64, 9]


@dataclass
class MagneticField(IdlStruct, typename="sensor_msgs::msg::dds_::MagneticField_"):
    header: Header
    magnetic_field: Vector3
    magnetic_field_covariance: array[float64, 9]


@dataclass
class Temperature(IdlStruct, typename="sensor_msgs::msg::dds_::Temperature_"):
    header: Header
    temperature: float64
    variance: float64


@dataclass
class FluidPressure(IdlStruct, typename="sensor_msgs::msg::dds_::FluidPressure_"):
    header: Header
    fluid_pressure: float64
    variance: float64


@dataclass
class TimeReference(IdlStruct, typename="sensor_msgs::msg::dds_::TimeReference_"):
    header: Header
    time_ref: Time
    source: str


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    header: Header
    status: sequence[DiagnosticStatus]


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    data: array[uint8, 16]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    node_namespace: str
    node_name: str
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


TYPES: dict[str, type[Any]] = {
    "imu/data": Imu, "imu/data_raw": Imu, "imu/mag": MagneticField, "temperature": Temperature,
    "pressure": FluidPressure, "time_reference": TimeReference, "diagnostics": DiagnosticArray,
}  # fmt: skip
EVENTUALLY = Policy.Reliability.Reliable(duration(milliseconds=100))
RELIABLE = Qos(EVENTUALLY, Policy.Durability.Volatile, Policy.History.KeepLast(5000))
SENSOR = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5000))
KEPT = Qos(EVENTUALLY, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))


def main(domain: int, topics: list[str]) -> None:
    participant = DomainParticipant(domain)
    readers = [
        ("graph", DataReader(participant, Topic(participant, "ros_discovery_info", ParticipantEntitiesInfo), qos=KEPT))
    ]
    for where in topics:
        name, _, kind = where.partition("@")
        type_ = next(one for end, one in TYPES.items() if name.endswith(end))
        found = DataReader(participant, Topic(participant, f"rt/{name}", type_), qos=SENSOR if kind else RELIABLE)
        readers.append((where, found))
    publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    others = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
    print(json.dumps({"topic": "ready"}), flush=True)
    has_ended = False
    while not has_ended:
        has_ended = bool(select.select([sys.stdin], [], [], 0.02)[0])
        for one in publications.take(100):
            if one.topic_name.startswith("rt/"):
                data = one.qos[Policy.Userdata].data.decode() if Policy.Userdata in one.qos else ""
                found_one = {"name": one.topic_name, "type": one.type_name, "user_data": data, "key": str(one.key)}
                print(json.dumps({"topic": "publication", "message": found_one}), flush=True)
        for other in others.take(100):
            if Policy.Userdata in other.qos:
                message = other.qos[Policy.Userdata].data.decode()
                print(json.dumps({"topic": "participant", "message": message}), flush=True)
        for where, reader in readers:
            for sample in reader.take(500):
                if type(sample).__name__ != "InvalidSample":
                    line = {"topic": where, "message": asdict(sample), "source_ns": sample.sample_info.source_timestamp}
                    print(json.dumps(line, default=list), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
