"""Output `ros2`: topics of the devices for robots with ROS 2, as messages of DDS.

    batch ──as enu-flu──▶ rate of the device ──▶ a topic with readers? ──▶ CDR message (imud.bridges.ros2) ──▶ RTPS

Topics, coordinate frames and covariances are the same as in `imud export --to mcap --schema ros2`. A topic without a
reader costs no encoding. `ros_discovery_info` describes the node to other nodes, as rmw_dds_common does.
"""

import logging
from typing import Any, Final

from imud.attitude.conventions import Convention
from imud.bridges.channel import LiveDiagnosis, MessageChannel, MessageFrames, has_north
from imud.bridges.ros2 import CdrWriter, Ros2Dialect, time_reference
from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import Deviations, DeviceStatus, OutputStatus
from imud.formats.rtps import PREFIX_BYTES
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.publishers.ros2.options import Ros2Options
from imud.publishers.ros2.participant import RtpsParticipant
from imud.publishers.ros2.writer import RtpsWriter
from imud.publishers.thinning import Pace

log = logging.getLogger(__name__)

WHO: Final = "ros2"  # name of this output
LATENCY_NS: Final = 5_000_000  # maximum hold of samples for a reader, ns, the default of the shared memory
STATUS_NS: Final = NS_PER_S  # time between two diagnoses, as in diagnostic_updater
GRAPH_TOPIC: Final = "ros_discovery_info"
GRAPH_TYPE: Final = "rmw_dds_common/msg/ParticipantEntitiesInfo"
# Hashes of the types (REP-2016), computed from the definitions of common_interfaces. Types without a hash are not
# published: /tf would compete with the tree of the robot, and robots do not know imud_msgs.
TYPE_HASHES: Final = {
    "sensor_msgs/msg/Imu": "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "sensor_msgs/msg/MagneticField": "RIHS01_e80f32f56a20486c9923008fc1a1db07bbb273cbbf6a5b3bfa00835ee00e4dff",
    "sensor_msgs/msg/Temperature": "RIHS01_72514a14126ab9f8a9abec974c78e5610a367b59db5da355ff1fb982d5bad4b8",
    "sensor_msgs/msg/FluidPressure": "RIHS01_22dfb2b145a0bd5a31a1ac3882a1b32148b51d9b2f3bab250290d66f3595bc32",
    "sensor_msgs/msg/TimeReference": "RIHS01_dd66e84cf40bbb5d5a40472e6ecf2675a031334d4c426abdb2ad41801a8efc99",
    "sensor_msgs/msg/NavSatFix": "RIHS01_62223ab3fe210a15976021da7afddc9e200dc9ec75231c1b6a557fc598a65404",
    "geometry_msgs/msg/TwistStamped": "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    "diagnostic_msgs/msg/DiagnosticArray": "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    GRAPH_TYPE: "RIHS01_e725f4a506958c79f95dd693b965722c57b19cd18e7eff984f49561b93dc985d",
}


def dds_type(name: str) -> str:
    """Return the DDS type of `sensor_msgs/msg/Imu`: `sensor_msgs::msg::dds_::Imu_`."""
    package, folder, message = name.split("/")
    return f"{package}::{folder}::dds_::{message}_"


class Ros2Output:
    """Output of the topics. Synchronization: the event loop's thread only."""

    def __init__(self, settings: Ros2Options, context: PublisherContext) -> None:
        self._settings = settings
        self._context = context
        clock = context.clock
        self._participant = RtpsParticipant(
            settings.domain_id, settings.address, settings.node, clock.now_ns, clock.cpu_ns
        )
        self._participant.accepted_types = frozenset(map(dds_type, TYPE_HASHES))
        self._devices: dict[str, _PublishedDevice] = {}
        self._diagnosis = LiveDiagnosis()
        self._diagnostics = Ros2Dialect().diagnostics()
        self._status_ns = 0
        self._graph: RtpsWriter | None = None
        self._reports: RtpsWriter | None = None
        self._described: list[bytes] | None = None  # writers in the newest message about the node
        self._asked: list[str] = []

    def start(self) -> None:
        """Open the sockets. Raises ServerError."""
        self._participant.open()
        self._graph = self._participant.add(GRAPH_TOPIC, dds_type(GRAPH_TYPE), TYPE_HASHES[GRAPH_TYPE], is_kept=True)
        self._reports = added(self._participant, self._diagnostics)
        self._context.outputs.ports[WHO] = self.status
        log.info("ROS 2 node /%s in domain %d", self._settings.node, self._settings.domain_id)

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. Its topics appear with its first sample."""
        sending = self._settings.sending(name)
        if sending is not None:
            self._devices[name] = _PublishedDevice(self._participant, name, sending.rate_hz)

    def remove_device(self, name: str) -> None:
        device = self._devices.pop(name, None)
        if device is not None:
            device.close()

    event: Final = None  # no topic contains an event

    def publish(self, batch: Batch) -> None:
        """Send the due samples to the readers of each topic."""
        device = self._devices.get(batch.device)
        if device is not None and device.is_wanted:
            device.publish(batch.converted(Convention.ENU_FLU))

    def tick(self, now_ns: int) -> None:
        """Do the discovery, and describe the devices once per second."""
        self._participant.tick(now_ns)
        if now_ns - self._status_ns >= STATUS_NS:
            self._status_ns = now_ns
            statuses = [one for one in self._context.devices.status() if one.name in self._devices]
            for status in statuses:
                self._devices[status.name].describe(status)
            utc_ns = now_ns + self._context.clock.utc_offset_ns()
            if self._reports is not None and self._reports.readers:
                message = self._diagnostics.encode(self._diagnosis.of(statuses, utc_ns))
                if message is not None:
                    self._reports.write(message, utc_ns)
        self._describe_node(now_ns + self._context.clock.utc_offset_ns())
        wanted = [name for name, device in self._devices.items() if device.has_readers]
        if wanted != self._asked:
            self._asked = wanted
            if wanted:
                self._context.latencies.ask(WHO, LATENCY_NS, wanted)
            else:
                self._context.latencies.release(WHO)

    def status(self) -> list[OutputStatus]:
        """Return the state of the participant."""
        readers = sum(len(one.readers) for one in self._participant.writers if one is not self._graph)
        sent, dropped = self._participant.totals
        name = f"domain {self._settings.domain_id}"
        return [OutputStatus(name, sent, dropped, readers, self._participant.problem, self._participant.discarded)]

    def close(self) -> None:
        """End the participant. A second call does nothing."""
        self._participant.close()
        self._context.latencies.release(WHO)
        self._context.outputs.ports.pop(WHO, None)

    def _describe_node(self, utc_ns: int) -> None:
        """Send the node and its writers if the writers changed (rmw_dds_common, ParticipantEntitiesInfo)."""
        writers = [one.entity for one in self._participant.writers if one is not self._graph]
        if writers == self._described or self._graph is None:
            return
        self._described = writers
        guid = self._participant.guid
        made = CdrWriter().octets(guid).number("I", 1).text("/").text(self._settings.node)
        made.number("I", 0).number("I", len(writers))
        for entity in writers:
            made.octets(guid[:PREFIX_BYTES] + entity)
        self._graph.write(made.done(), utc_ns)


def added(participant: RtpsParticipant, channel: MessageChannel[Any]) -> RtpsWriter:
    """Add the writer of a channel."""
    name = channel.schema.name
    return participant.add(f"rt{channel.topic}", dds_type(name), TYPE_HASHES[name])


class _PublishedDevice:
    """Topics of one device."""

    def __init__(self, participant: RtpsParticipant, name: str, rate_hz: float | None) -> None:
        self._participant, self._name = participant, name
        self._pace = Pace(rate_hz) if rate_hz is not None else None
        self._newest_ns = 0
        self._frames: MessageFrames | None = None
        self._channels: list[MessageChannel[Sample]] = []
        self._writers: dict[str, RtpsWriter] = {}
        self._is_probe_due = False

    @property
    def has_readers(self) -> bool:
        return any(one.readers for one in self._writers.values())

    @property
    def is_wanted(self) -> bool:
        """Whether a sample has a reader, or can add a topic."""
        return self._is_probe_due or self.has_readers

    def describe(self, status: DeviceStatus) -> None:
        """Set the coordinate frames and the noise. The next sample adds missing topics."""
        frames = MessageFrames(self._name, has_north=has_north(status), deviations=status.noise or Deviations())
        if frames != self._frames:
            self._frames = frames
            channels = [*Ros2Dialect().samples(frames), time_reference(frames)]
            self._channels = [one for one in channels if one.schema.name in TYPE_HASHES]
        self._is_probe_due = len(self._writers) < len(self._channels)

    def publish(self, batch: Batch) -> None:
        if self._is_probe_due:
            self._is_probe_due = False
            self._probe(batch.samples[-1])
        wanted = [
            (one.encode, writer)
            for one in self._channels
            if (writer := self._writers.get(one.topic)) is not None and writer.readers
        ]
        for sample in batch.samples:
            if self._pace is not None:
                step_ns, self._newest_ns = sample.t_ns - self._newest_ns, sample.t_ns
                if not self._pace.is_due(sample.t_ns, step_ns):
                    continue
            for encode, writer in wanted:
                message = encode(sample)
                if message is not None:
                    writer.write(message, sample.utc_ns)

    def _probe(self, sample: Sample) -> None:
        """Add the topics for which the device sends values."""
        for one in self._channels:
            if one.topic not in self._writers and one.encode(sample) is not None:
                self._writers[one.topic] = added(self._participant, one)

    def close(self) -> None:
        for writer in self._writers.values():
            self._participant.remove(writer)
        self._writers.clear()
