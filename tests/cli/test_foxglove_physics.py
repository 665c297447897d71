"""ROS 2 messages of the Foxglove server are equal to the motion of the simulated device.

The motion of the device is known, and its truth file contains the time of each sample. The test compares each message
with the ideal measurement at this time: values, units, axes, coordinate frames, and the time stamp error.
"""

import asyncio
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from math import hypot
from typing import Any, NamedTuple
from unittest.mock import Mock

import pytest

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.physics import FIELD_ENU_T, GRAVITY_M_S2, MOTIONS, Truth
from tests.cli.conftest import Cli, imud_process
from tests.cli.protocol_client import ProtocolClient, connected
from tests.support.daemon_process import RunningDaemon, daemon_with_module

pytestmark = pytest.mark.live

SAMPLES = 100
ENOUGH = 50
TOPICS = {
    "/bow/imu/data": "sensor_msgs/msg/Imu", "/bow/imu/mag": "sensor_msgs/msg/MagneticField",
    "/bow/temperature": "sensor_msgs/msg/Temperature", "/bow/pressure": "sensor_msgs/msg/FluidPressure",
    "/tf": "tf2_msgs/msg/TFMessage", "/bow/stamp": "imud_msgs/msg/SampleStamp",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}  # fmt: skip
NOISE = {"accel_m_s2": 0.5, "gyro_rad_s": 0.25, "mag_t": 2.0, "attitude_rad": 0.125, "temperature_c": 3.0}

Messages = dict[str, list[tuple[int, Any]]]


class Seen(NamedTuple):
    messages: Messages
    stale: Any
    truth: dict[int, Truth]


@contextmanager
def served(daemon: RunningDaemon) -> Iterator[str]:
    with imud_process("foxglove", "--port", 0, "--rate", 0, "--socket", daemon.socket) as process:
        while (found := re.search(r"ws://\S+", line := process.err.readline())) is None:
            assert line, "it ended"
        yield found[0]
        process.end(signal.SIGTERM)


async def look(client: ProtocolClient, messages: Messages) -> None:
    for topic, schema in TOPICS.items():
        await client.subscribe(topic)
        assert (client.channels[topic]["schemaName"], client.channels[topic]["encoding"]) == (schema, "cdr")
        messages[topic] = []
    while len(messages["/bow/imu/data"]) < SAMPLES or not all(messages.values()):
        topic, t_ns, message = await client.receive(lambda topic, *_: topic)
        messages[topic].append((t_ns, message))


async def watch(url: str, daemon: RunningDaemon) -> tuple[Messages, Any]:
    messages: Messages = {}
    async with connected(url) as client:
        await look(client, messages)
        daemon.process.terminate()
        while True:
            _, _, message = await client.receive(lambda topic, *_: topic == "/diagnostics")
            if message.status[0].level == message.status[0].STALE:
                return messages, message


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    folder = tmp_path_factory.mktemp("foxglove")
    options = ["--motion", "swing", "--no-noise", "--boot", "0", "--truth", str(folder / "truth.csv")]
    with daemon_with_module(folder, *options, noise=NOISE) as daemon, served(daemon) as url:
        messages, stale = asyncio.run(watch(url, daemon))
    head, _, *rows = (folder / "truth.csv").read_text().splitlines()
    epoch_ns, motion = int(head.partition("=")[2]), MOTIONS["swing"](GRAVITY_M_S2)
    taken = [list(map(int, row.split(",")[:2])) for row in rows]
    return Seen(messages, stale, {ms: motion.at((t_ns - epoch_ns) / NS_PER_S) for t_ns, ms in taken})


def utc_ns(header: Any) -> int:
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)


def xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def forward_left_up(sensor: tuple[float, float, float]) -> tuple[float, float, float]:
    """Convert a vector of the device (x right, y forward) to the axes of REP-103."""
    right, forward, up = sensor
    return forward, -right, up


def turned(quaternion: Any, vector: Any) -> tuple[float, float, float]:
    w, (x, y, z), (a, b, c) = quaternion.w, xyz(quaternion), xyz(vector)
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
        2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c,
        2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )


def by_time(seen: Seen, topic: str) -> dict[int, Any]:
    return dict(seen.messages[topic])


def paired(seen: Seen, topic: str, other: str) -> list[tuple[Any, Any]]:
    """Return pairs of messages of two topics with equal times, between the first and last message of `other`."""
    others = by_time(seen, other)
    first, last = min(others), max(others)
    return [(one, others[t_ns]) for t_ns, one in seen.messages[topic] if first <= t_ns <= last]


def with_truth(seen: Seen, topic: str) -> list[tuple[Any, Truth]]:
    """Return the messages of a topic with the true values at their time."""
    found = [(one, seen.truth[stamp.t_dev_ns // NS_PER_MS]) for one, stamp in paired(seen, topic, "/bow/stamp")]
    assert found
    return found


def test_the_time_specific_force_and_turn_rate_of_every_message_are_those_of_the_measurement(seen: Seen) -> None:
    for topic, messages in seen.messages.items():
        for t_ns, message in messages:
            header = message.transforms[0].header if topic == "/tf" else message.header
            assert utc_ns(header) == t_ns, topic
    offsets = {utc_ns(stamp.header) - stamp.t_ns for _, stamp in seen.messages["/bow/stamp"]}
    assert max(offsets) - min(offsets) < NS_PER_S, "CLOCK_REALTIME minus CLOCK_MONOTONIC"
    for _, stamp in seen.messages["/bow/stamp"]:
        assert stamp.t_err_ns > 0
        assert stamp.t_ns <= stamp.t_rx_ns
    assert {one.sync for _, one in seen.messages["/bow/stamp"]} <= {0, 1}, "no edge, no UTC"
    found = with_truth(seen, "/bow/imu/data")
    assert len(found) >= ENOUGH
    for imu, truth in found:
        assert imu.header.frame_id == "bow"
        assert xyz(imu.linear_acceleration) == pytest.approx(forward_left_up(truth.accel_m_s2), abs=0.01)
        assert xyz(imu.angular_velocity) == pytest.approx(forward_left_up(truth.gyro_rad_s), abs=0.005)
    forces = [hypot(*xyz(imu.linear_acceleration)) for imu, _ in found]
    assert sum(forces) / len(forces) == pytest.approx(GRAVITY_M_S2, rel=0.05)
    turning = [hypot(*xyz(imu.angular_velocity)) for imu, _ in found]
    assert max(turning) > 0.1, "it moves, or the axes would not be seen"


def test_the_attitude_turns_the_field_to_north_and_diagnostics_have_state_and_losses(seen: Seen) -> None:
    for field, truth in with_truth(seen, "/bow/imu/mag"):
        assert xyz(field.magnetic_field) == pytest.approx(forward_left_up(truth.mag_t), abs=2e-7)
    found = paired(seen, "/bow/imu/mag", "/bow/imu/data")
    assert len(found) >= ENOUGH
    for field, imu in found:
        assert turned(imu.orientation, field.magnetic_field) == pytest.approx(FIELD_ENU_T, abs=5e-7)
    ups = [turned(imu.orientation, imu.linear_acceleration)[2] for _, imu in seen.messages["/bow/imu/data"]]
    assert sum(ups) / len(ups) == pytest.approx(GRAVITY_M_S2, rel=0.05)
    for message, imu in paired(seen, "/tf", "/bow/imu/data"):
        (one,) = message.transforms
        assert (one.header.frame_id, one.child_frame_id) == ("enu", "bow")
        assert (one.transform.rotation.w, *xyz(one.transform.rotation)) == (imu.orientation.w, *xyz(imu.orientation))
    for _, array in seen.messages["/diagnostics"]:
        (bow,) = array.status
        assert (bow.name, bow.message.partition(":")[0]) == ("imud: bow", "ok")
        assert {one.key: one.value for one in bow.values}.keys() >= {"state", "t_err_ns", "rate_hz", "lost_crc"}
    (bow,) = seen.stale.status
    assert (bow.name, bow.level) == ("imud: bow", bow.STALE)
    assert "daemon" in bow.message


def test_an_open_address_needs_an_option_and_gives_a_warning(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    cli.refuses("--rate: expected samples per second, or 0 for every sample, got -0.5", "foxglove", "--rate", "-0.5")
    cli.refuses("without a password; add --open", "foxglove", "--address", "0.0.0.0")
    server, relay = Mock(return_value=Mock(url="ws://0.0.0.0:8765")), Mock()
    monkeypatch.setattr("imud.web.foxglove.FoxgloveServer", server)
    monkeypatch.setattr("imud.web.foxglove.Relay", relay)
    for address, more, rate_hz in (("0.0.0.0", ["--open", "--rate", "0"], None), ("127.0.0.1", ["--rate", "7"], 7.0)):
        err = cli("foxglove", "--address", address, *more).err
        assert (err.count("\n"), relay.call_args.kwargs["rate_hz"]) == (1 + (address == "0.0.0.0"), rate_hz)
    assert relay.return_value.run.call_count == server.return_value.close.call_count == 2
