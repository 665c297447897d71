"""Messages with samples in the requested convention: JSON, binary, `poll`, and `schema`."""

import asyncio
from collections.abc import Sequence
from math import radians, sqrt
from typing import Any
from unittest.mock import patch

import pytest
from msgspec.structs import replace

from imud.attitude.conventions import RFU_ENU, Convention
from imud.attitude.published import FrameOptions, MountingAxes, PublishedAxes, as_sent, published_frame
from imud.contracts.publisher import Batch, SlotBatch
from imud.formats import kernel
from imud.formats.slot import SLOT_BYTES, decode_slot
from imud.model.sample import Sample
from imud.publishers.socket.outbox import BinaryEncoding, Encoding, JsonEncoding
from imud.publishers.socket.server import SocketServer
from tests.support.socket_rig import Peer, in_server, sample

HALF = sqrt(0.5)
SENT = replace(
    sample("imu0", 1), accel_m_s2=(0.125, 9.75, -0.5), gyro_rad_s=(0.25, 0.5, -0.75), mag_t=(1e-5, 2e-5, 3e-5),
    quat_wxyz=(1.0, 0.0, 0.0, 0.0), euler_rad=(0.0, 0.0, 0.0),
)  # fmt: skip
"""Sample of a HiPNUC device (x right, y forward, z up) that points north."""
EXPECTED: dict[str | None, dict[str, Any]] = {
    None: {
        "accel_m_s2": [0.125, 9.75, -0.5], "gyro_rad_s": [0.25, 0.5, -0.75], "mag_t": [1e-5, 2e-5, 3e-5],
        "quat_wxyz": [1, 0, 0, 0], "euler_rad": [0, 0, 0],
    },
    "enu-flu": {
        "accel_m_s2": [9.75, -0.125, -0.5], "gyro_rad_s": [0.5, -0.25, -0.75], "mag_t": [2e-5, -1e-5, 3e-5],
        "quat_wxyz": [HALF, 0, 0, HALF], "euler_rad": [0, 0, radians(90)],
    },
    "ned-frd": {
        "accel_m_s2": [9.75, 0.125, 0.5], "gyro_rad_s": [0.5, 0.25, 0.75], "mag_t": [2e-5, 1e-5, -3e-5],
        "quat_wxyz": [1, 0, 0, 0], "euler_rad": [0, 0, 0],
    },
}  # fmt: skip
"""Expected values by requested convention."""


def published(samples: Sequence[Sample], frame: PublishedAxes | None = None) -> Batch:
    frame = frame or as_sent(RFU_ENU)
    rotation = frame.rotation
    return Batch("imu0", 0, list(samples) if rotation is None else rotation.samples(samples), frame)


def assert_is(values: dict[str, Any], convention: str | None) -> None:
    """Assert the values of a sample. A quaternion and its negative are equal."""
    for name, expected in EXPECTED[convention].items():
        found = list(values[name])
        if name == "quat_wxyz" and sum(a * b for a, b in zip(found, expected, strict=True)) < 0:
            found = [-value for value in found]
        assert found == pytest.approx(expected, abs=1e-12), (convention, name)
    assert (values["temperature_c"], values["seq"]) == (31.5, 1)


def members_of(one: Sample) -> dict[str, Any]:
    return {name: getattr(one, name) for name in Sample.__struct_fields__}


FRAMES = {
    "as sent": (SENT, as_sent(RFU_ENU)),
    "in ned-frd": (SENT, published_frame(None, Convention.NED_FRD, None, RFU_ENU)),
    "mounted upside down": (
        replace(
            SENT, accel_m_s2=(-0.125, 9.75, 0.5), gyro_rad_s=(-0.25, 0.5, 0.75), mag_t=(-1e-5, 2e-5, -3e-5),
            quat_wxyz=(0.0, 0.0, 1.0, 0.0), euler_rad=(radians(180), 0.0, 0.0),
        ),
        published_frame(FrameOptions(axes=MountingAxes(x="y", y="x", z="-z")), None, None, RFU_ENU),
    ),
}  # fmt: skip
"""One body, measured by devices with three configured conventions."""


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("convention", ["enu-flu", "ned-frd"])
@in_server()
async def test_a_client_gets_the_requested_convention(server: SocketServer, name: str, convention: str) -> None:
    """Yield the samples as JSON, as binary slots, and from `poll`."""
    lines, frames = await Peer.greeted(server), await Peer.greeted(server)
    assert (await lines.result("watch", convention=convention))["convention"] == convention
    assert (await frames.result("watch", encoding="binary", convention=convention))["convention"] == convention
    frames.framed = True
    one, frame = FRAMES[name]
    server.publish(published([one], frame))
    assert_is((await lines.message())["params"], convention)
    slot = await frames.body()
    assert len(slot) == SLOT_BYTES
    assert_is(members_of(decode_slot(slot, "imu0")), convention)
    polled = await lines.result("poll", convention=convention)
    assert polled["convention"] == convention
    assert_is(polled["samples"][0], convention)


@in_server()
async def test_clients_side_by_side_and_an_unknown_convention(server: SocketServer) -> None:
    plain, down, few = [await Peer.greeted(server) for _ in range(3)]
    assert "convention" not in await plain.result("watch")
    await down.result("watch", convention="ned-frd")
    await few.result("watch", convention="enu-flu", fields=["accel_m_s2"], rate_hz=1000)
    server.publish(published([SENT]))
    assert_is((await plain.message())["params"], None)
    assert_is((await down.message())["params"], "ned-frd")
    some = (await few.message())["params"]
    assert some == {"device": "imu0", "seq": 1, "t_ns": SENT.t_ns, "accel_m_s2": [9.75, -0.125, -0.5]}
    assert_is((await plain.result("poll"))["samples"][0], None)
    # a new watch without a convention replaces the old watch
    await down.result("watch")
    server.publish(published([SENT]))
    assert_is((await down.message())["params"], None)
    for method in ("watch", "poll"):
        code, message = await plain.error(method, convention="enu")
        assert code == -32602
        assert "enu" in message
        assert (await plain.result(method, convention=None)).get("convention") is None


@in_server()
async def test_schema_and_status_describe_the_conventions(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    known = (await peer.result("schema"))["devices"]["imu0"]
    assert known["frame"] == "sensor: x right, y forward, z up, right-handed"
    assert (known["convention"], known["heading"], known["declination_deg"]) == ("device", "magnetic", None)
    assert known["conventions"]["ned-frd"] == {
        "frame": "body: x forward, y right, z down (FRD)",
        "euler_convention": "ZYX: yaw about Z, then pitch about Y, then roll about X; yaw clockwise from above",
        "navigation_frame": "NED",
    }
    assert known["conventions"]["enu-flu"]["navigation_frame"] == "ENU"
    (status, _) = (await peer.result("status"))["devices"]
    assert status["frame"]["problem"] == ""
    both = known.keys() & status["frame"].keys()
    assert {name: status["frame"][name] for name in both} == {name: known[name] for name in both}


def test_a_batch_is_turned_once_for_all_clients() -> None:
    batch = published([SENT])
    assert batch.converted(None) is batch
    turned = batch.converted(Convention.NED_FRD)
    assert turned is batch.converted(Convention.NED_FRD)
    assert turned is not batch.converted(Convention.ENU_FLU)
    assert turned.packed is batch.converted(Convention.NED_FRD).packed
    down = published([SENT], published_frame(None, Convention.NED_FRD, None, RFU_ENU))
    assert down.converted(Convention.NED_FRD) is down, "published so already"
    batch = published([SENT, replace(SENT, seq=2)])
    plain = JsonEncoding(None, framed=False)
    encoding = JsonEncoding(None, framed=False, convention=Convention.NED_FRD)
    first, second = encoding.encode(batch)
    assert encoding.encode_one(batch, 1) == second
    assert first != plain.encode(batch)[0]
    assert b'"dropped":3' in encoding.with_dropped(first, "imu0", {"imu0": 3})
    assert encoding.message_bytes == len(second)
    binary = BinaryEncoding(Convention.NED_FRD)
    assert binary.message_bytes == BinaryEncoding.message_bytes
    assert list(binary.encode(batch)) == list(BinaryEncoding().encode(batch.converted(Convention.NED_FRD)))
    with patch.object(kernel, "present", kernel.Kernel(None)):
        assert list(binary.encode(batch)) == [binary.encode_one(batch, at) for at in range(len(batch.samples))]


@pytest.mark.parametrize("encoding", [BinaryEncoding(), BinaryEncoding(Convention.NED_FRD), JsonEncoding(None, False)])
def test_a_batch_of_slots_is_the_batch_of_its_samples(encoding: Encoding) -> None:
    whole = published([SENT, replace(SENT, seq=2)])
    packed = SlotBatch("imu0", 0, whole.packed, whole.frame)
    assert list(encoding.encode(packed)) == list(encoding.encode(whole))


@in_server()
async def test_a_slow_reader_gets_converted_samples_from_its_queue(server: SocketServer) -> None:
    """imud encodes these samples after `publish`. They have the convention too."""
    peer = await Peer.greeted(server)
    await peer.result("watch", convention="ned-frd", fields=["accel_m_s2"])
    count = 0
    while server.hub.clients()[0].queue_samples < 3:
        server.publish(published([SENT]))
        count += 1
    await asyncio.sleep(0)
    for message in await peer.messages(count):
        assert message["params"]["accel_m_s2"] == [9.75, 0.125, 0.5]
