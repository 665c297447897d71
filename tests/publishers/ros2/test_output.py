"""The output with robots: Cyclone DDS and Fast DDS in processes of their own; type hashes by rosbags."""

import asyncio
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from threading import Thread
from typing import Any

import msgspec
import pytest
from rosbags.typesys import Stores, get_typestore

from imud.contracts.publisher import Batch
from imud.model.sample import Sample
from imud.publishers.ros2.options import Ros2Options, Ros2Sending
from imud.publishers.ros2.output import TYPE_HASHES, Ros2Output
from tests.bridges.samples import FULL
from tests.support.publisher_context import FakeLatencies, publisher_context
from tests.support.socket_rig import device_status

HERE = Path(__file__).parent
LIMIT_S = 60
PERIOD_NS = 10_000_000  # between two samples
IMU = "sensor_msgs::msg::dds_::Imu_"
DOMAIN = 100 + os.getpid() % 100


def test_the_type_hashes_are_the_hashes_of_rosbags() -> None:
    """rosbags computes them from the definitions of ROS 2. The hash of Imu is also in the code of micro-ROS."""
    store = get_typestore(Stores.ROS2_JAZZY)
    assert {name: store.hash_rihs01(name) for name in TYPE_HASHES} == TYPE_HASHES
    assert TYPE_HASHES["sensor_msgs/msg/Imu"].startswith("RIHS01_7d9a00ff131080897a5ec7e26e315954")


class Bench:
    """A running output with the device `bow`."""

    def __init__(self, domain: int, **settings: Any) -> None:
        self.latencies = FakeLatencies()
        self.context = publisher_context(
            lambda: [device_status("bow", 0)], now_ns=time.monotonic_ns, latencies=self.latencies
        )
        self.domain = domain
        self.output = Ros2Output(Ros2Options(enabled=True, domain_id=domain, **settings), self.context)
        self.output.start()
        self.output.add_device("bow", 0)
        self.seq = 0

    def publish(self) -> Sample:
        self.seq += 1
        sample = msgspec.structs.replace(FULL, seq=self.seq, t_ns=self.seq * PERIOD_NS, utc_ns=self.seq * PERIOD_NS)
        self.output.publish(Batch("bow", 0, [sample]))
        return sample

    async def run(self, is_done: Callable[[], bool], *, publishes: bool = True) -> None:
        """Publish samples until `is_done`; without `publishes`, only wait."""
        end_s = time.monotonic() + LIMIT_S
        turn = 0
        while not is_done():
            assert time.monotonic() < end_s
            turn += 1
            if turn % 10 == 0:
                self.output.tick(time.monotonic_ns())
            if publishes:
                self.publish()
            await asyncio.sleep(0.01)

    @property
    def readers(self) -> int:
        return self.output.status()[0].readers


class Robot:
    """A process that prints each message that it receives as a line, until its standard input ends."""

    def __init__(self, *command: str) -> None:
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._lines: list[str] = []
        self._thread = Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        self._lines.extend(self._process.stdout)

    def messages(self, topic: str = "") -> list[str]:
        """Return the lines with this text until now."""
        return [line for line in self._lines if topic in line]

    def end(self) -> list[str]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(timeout=LIMIT_S)
        self._thread.join(LIMIT_S)
        self._process.stdout.close()
        return self._lines

    def kill(self) -> None:
        self._process.kill()
        self.end()


def cyclone(domain: int, *topics: str) -> Robot:
    pytest.importorskip("cyclonedds", reason="needs the package cyclonedds")
    return Robot(sys.executable, str(HERE / "cyclone_robot.py"), str(domain), *topics)


@pytest.mark.live
def test_cyclone_dds_receives_each_message() -> None:
    """Ledger: messages sent = messages received. The reader finds topics, types, hashes and the node."""

    async def scenario() -> tuple[Bench, list[str]]:
        bench = Bench(DOMAIN)
        topics = ["bow/imu/data", "bow/imu/mag", "bow/temperature", "bow/pressure", "bow/time_reference", "diagnostics"]
        robot = cyclone(DOMAIN, *topics)
        await bench.run(lambda: bench.readers == len(topics))
        assert bench.latencies.asked.keys() <= {"ros2"}
        await bench.run(lambda: len(robot.messages('"bow/imu/data"')) >= 200)
        # the robot requests lost messages again

        def received() -> int:
            return len(robot.messages('"source_ns"')) - len(robot.messages('"graph"'))

        await bench.run(lambda: received() == bench.output.status()[0].sent, publishes=False)
        counted = bench.output.status()[0]
        assert counted.dropped == 0
        lines = await asyncio.to_thread(robot.end)
        bench.output.close()
        assert bench.context.outputs.ports == {}
        return bench, [*lines, json.dumps({"topic": "sent", "message": counted.sent})]

    _, lines = asyncio.run(scenario())
    found: dict[str, list[Any]] = {}
    for line in map(json.loads, lines):
        found.setdefault(line["topic"], []).append(line.get("message"))
    names = {one["name"]: (one["type"], one["user_data"]) for one in found.pop("publication")}
    assert names["rt/bow/imu/data"] == (IMU, f"typehash={TYPE_HASHES['sensor_msgs/msg/Imu']};")
    assert "enclave=/;" in found.pop("participant")
    (node,) = found.pop("graph")[-1]["node_entities_info_seq"]
    assert (node["node_namespace"], node["node_name"], len(node["writer_gid_seq"])) == ("/", "imud", len(names))
    found.pop("ready")
    (sent,) = found.pop("sent")
    assert sum(map(len, found.values())) == sent
    imu, mag, reference = (found[f"bow/{name}"][-1] for name in ("imu/data", "imu/mag", "time_reference"))
    assert imu["header"]["frame_id"] == "bow"
    # FULL in enu-flu: x forward, y left, z up
    assert imu["linear_acceleration"] == {"x": -0.5, "y": -0.125, "z": 9.75}
    assert imu["angular_velocity_covariance"][::4] == [0.0] * 3
    assert imu["linear_acceleration_covariance"][::4] == pytest.approx([1e-4] * 3)
    assert mag["magnetic_field"]["z"] == pytest.approx(4e-5)
    assert found["bow/temperature"][0]["temperature"] == 31.5
    assert found["bow/pressure"][0]["fluid_pressure"] == 101325.0
    assert (reference["source"], reference["time_ref"]["nanosec"]) == ("gnss", 123456798)
    assert found["diagnostics"][0]["status"][0]["name"] == "imud: bow"


@pytest.mark.live
def test_a_killed_robot_is_replaced() -> None:
    """A robot that is killed does not stop the output; the next one receives again, at a lower rate."""

    async def scenario() -> list[str]:
        domain = DOMAIN + 1
        bench = Bench(domain, devices={"bow": Ros2Sending(rate_hz=20)})
        first = cyclone(domain, "bow/imu/data@sensor")
        await bench.run(lambda: bench.readers == 1)
        first.kill()
        second = cyclone(domain, "bow/imu/data")
        await bench.run(lambda: len(second.messages('"bow/imu/data"')) >= 20)
        lines = await asyncio.to_thread(second.end)
        bench.output.close()
        return [line for line in lines if '"bow/imu/data"' in line]

    stamps = [json.loads(line)["message"]["header"]["stamp"]["nanosec"] for line in asyncio.run(scenario())]
    assert len(stamps) >= 20
    assert {(after - before) % 1_000_000_000 for before, after in pairwise(stamps)} == {50_000_000}


@pytest.mark.live
@pytest.mark.parametrize("kind", ["reliable", "best_effort"])
def test_fast_dds_receives_each_message(tmp_path: Path, kind: str) -> None:
    """Fast DDS is the default of ROS 2. rosbags decodes the messages."""
    if not Path("/usr/include/fastdds").is_dir() or shutil.which("g++") is None:
        pytest.skip("needs the Debian packages libfastrtps-dev and g++ (make ros2-deps)")
    program = str(tmp_path / "fast_robot")
    built = ["g++", "-std=c++14", str(HERE / "fast_robot.cpp"), "-o", program, "-lfastrtps", "-lfastcdr"]
    subprocess.run(built, check=True, timeout=120)

    async def scenario() -> tuple[list[str], int]:
        bench = Bench(DOMAIN + 2 + (kind == "reliable"))
        robot = Robot(program, str(bench.domain), "rt/bow/imu/data", IMU, kind)
        await bench.run(lambda: len(robot.messages()) > 100)  # the first line is "ready"
        lines = await asyncio.to_thread(robot.end)
        dropped = bench.output.status()[0].dropped
        bench.output.close()
        return lines[1:], dropped

    lines, dropped = asyncio.run(scenario())
    store = get_typestore(Stores.ROS2_JAZZY)
    received: list[Any] = [store.deserialize_cdr(bytes.fromhex(line), "sensor_msgs/msg/Imu") for line in lines]
    assert {(one.header.frame_id, one.linear_acceleration.z) for one in received} == {("bow", 9.75)}
    stamps = [one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec for one in received]
    steps = [(after - before) // PERIOD_NS for before, after in pairwise(stamps)]
    assert all(step >= 1 for step in steps), "each message arrives once and in order"
    if kind == "reliable":
        assert sum(step - 1 for step in steps) <= dropped


def test_a_daemon_without_the_output_imports_only_its_options() -> None:
    code = "import sys, imud.publishers; [imud.publishers.PUBLISHERS[n] for n in ('ros2',)]; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "imud.publishers.ros2.options" in loaded
    assert not {"imud.publishers.ros2.output", "imud.publishers.ros2.participant", "imud.formats.rtps"} & set(loaded)
