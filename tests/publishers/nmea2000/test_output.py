"""Complete output on a socket in place of the CAN interface: messages, rates, a slow bus, and an absent interface.
The package `nmea2000` and the driver `hipnuc-nmea2000` read the messages."""

import asyncio
import errno
import math
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import can
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nmea2000 import NMEA2000Decoder

from imud.attitude.conventions import Heading
from imud.contracts.publisher import Batch
from imud.contracts.status import FrameStatus
from imud.drivers.hipnuc.nmea2000 import HipnucNmea2000Codec, HipnucNmea2000Options
from imud.formats.can import EXTENDED_ID_MAX, RAW_FRAME, pack_frame
from imud.formats.j1939 import J1939Id, join, split
from imud.host import netlink
from imud.host.netlink import CanDetails
from imud.model.errors import LinkError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement, Sample, Sync, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.nmea2000 import Nmea2000Options, output, port
from imud.publishers.nmea2000.address import NodeFrame
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.publisher_context import FakeLatencies, publisher_context
from tests.support.socket_rig import device_status

Frame = tuple[int, bytes]
# Attitude in the axes of HiPNUC: right side down by 10°, bow up by 5°, heading 45°
LEFT_45: Vector3 = (math.radians(10), math.radians(5), math.radians(-45))


class Bus:
    """A datagram socket with frames of a CAN socket. The kernel accepts `room` frames."""

    def __init__(self, near: socket.socket) -> None:
        self._near, self.room, self.error = near, 10_000, errno.ENOBUFS
        self.fileno, self.close, self.recv = near.fileno, near.close, near.recv

    def send(self, frame: bytes) -> int:
        if not self.room:
            raise OSError(self.error, "")
        self.room -= 1
        return self._near.send(frame)


class Rig:
    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, heading: Heading = Heading.TRUE, declination_deg: float | None = 3.0,
        **settings: object,
    ) -> None:  # fmt: skip
        self.clock, self.problem, self.opened = VirtualClock(), "", list[tuple[str, bool]]()
        monkeypatch.setattr(port, "open_bus", self._open)
        monkeypatch.setattr(port, "interface_problem", lambda _interface: self.problem)
        frame = FrameStatus("", "device", "", "", heading, declination_deg, {})
        statuses = [msgspec.structs.replace(device_status("bow", 0), frame=frame)]
        context = publisher_context(lambda: statuses, 1, self.clock.now_ns, latencies=FakeLatencies())
        self.context = context
        self.output = output.Nmea2000(msgspec.convert(settings, Nmea2000Options), self.context)
        self.output.start()
        self.output.add_device("bow", 0)
        self.seq = 0

    def _open(self, interface: str, loopback: bool) -> Any:
        near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        near.setblocking(False)
        self.far.setblocking(False)
        self.opened.append((interface, loopback))
        self.bus = Bus(near)
        return self.bus

    def tick(self, ms: int = 1000) -> None:
        self.clock.advance(ms * NS_PER_MS)
        self.output.tick(self.clock.now_ns())

    def settle(self) -> "Rig":
        """Open the interface, and discard the claim and the heartbeat."""
        self.tick(1)
        self.tick(500)
        self.received()
        return self

    def publish(self, count: int = 1, euler: Vector3 | None = LEFT_45, gyro_z: float = -0.1) -> None:
        """Publish samples at 100 Hz, one per batch."""
        for _ in range(count):
            self.seq += 1
            t_ns = self.seq * 10 * NS_PER_MS
            sample = Sample(
                "bow", self.seq, t_ns, 0, Sync.ARRIVAL, t_ns, t_ns, euler_rad=euler, gyro_rad_s=(0.0, 0.0, gyro_z)
            )
            self.output.publish(Batch("bow", 0, [sample]))

    def received(self) -> list[Frame]:
        found: list[Frame] = []
        while True:
            try:
                can_id, size, data = RAW_FRAME.unpack(self.far.recv(100))
            except BlockingIOError:
                return found
            found.append((can_id & EXTENDED_ID_MAX, data[:size]))

    def close(self) -> None:
        self.output.close()
        self.output.close()
        if self.opened:
            self.far.close()


def fields(frames: list[Frame]) -> dict[int, dict[str, Any]]:
    """Return the fields of the newest message of each PGN, read by the package `nmea2000`."""
    decoder = NMEA2000Decoder()
    found: dict[int, dict[str, Any]] = {}
    for can_id, data in frames:
        message = decoder.decode(can.Message(arbitration_id=can_id, is_extended_id=True, data=data))
        if message is not None:
            found[message.PGN] = {field.id: field.value for field in message.fields}
    return found


@pytest.mark.parametrize(
    ("heading", "declination_deg", "expected"),
    [
        (Heading.TRUE, 3.0, (42.0, 3.0, "Magnetic")), (Heading.TRUE, None, (45.0, None, "True")),
        (Heading.MAGNETIC, None, (45.0, None, "Magnetic")), (Heading.UNKNOWN, None, (None, None, None)),
    ],
)  # fmt: skip
def test_two_decoders_read_the_motion(
    monkeypatch: pytest.MonkeyPatch, heading: Heading, declination_deg: float | None, expected: tuple[Any, ...]
) -> None:
    @in_loop
    async def run() -> None:
        rig = Rig(monkeypatch, heading, declination_deg).settle()
        rig.publish()
        frames = rig.received()
        assert [can_id for can_id, _ in frames] == [0x09F11280, 0x09F11380, 0x0DF11980]
        assert {data[0] for _, data in frames} == {0}  # one SID
        found = fields(frames)
        degrees, variation, reference = expected
        shown = found[127250]
        assert shown["heading"] == (None if degrees is None else pytest.approx(math.radians(degrees), abs=1e-4))
        assert shown["variation"] == (None if variation is None else pytest.approx(math.radians(variation), abs=1e-4))
        assert reference is None or shown["reference"] == reference
        assert found[127251]["rate"] == pytest.approx(0.098857, abs=1e-6)  # 0.1 cos 10° / cos 5°
        assert found[127257]["roll"] == pytest.approx(math.radians(10), abs=1e-4)
        assert found[127257]["pitch"] == pytest.approx(math.radians(5), abs=1e-4)
        codec = HipnucNmea2000Codec(Ledger(), HipnucNmea2000Options())
        events = [event for can_id, data in frames for event in codec.feed_frame(can_id, True, data, 1)]
        (measured,) = (event for event in [*events, *codec.flush()] if isinstance(event, Measurement))
        assert measured.euler_rad is not None
        assert measured.euler_rad[:2] == pytest.approx(LEFT_45[:2], abs=1e-4)
        rig.close()

    run()


@in_loop
async def test_each_message_has_its_own_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, messages={"heading": 20.0, "attitude": 1.0}, address=40, instance=7).settle()
    rig.publish(200)
    pgns = [split(can_id).pgn for can_id, _ in rig.received()]
    assert (pgns.count(127250), pgns.count(127257), len(pgns)) == (40, 2, 42)
    rig.publish(30, euler=None)
    assert fields(rig.received())[127250]["heading"] is None
    rig.output.publish(Batch("mast", 1, [Sample("mast", 1, NS_PER_S * 9, 0, Sync.ARRIVAL, 0, 0)]))
    assert rig.received() == []
    rig.output.remove_device("bow")
    rig.publish(100)
    assert rig.received() == []
    for flag in (0, 0xC000_0000, 0xA000_0000):  # a frame with 11 bits, a remote frame, an error frame
        rig.far.send(RAW_FRAME.pack(join(J1939Id(6, 60928, 40)) | flag, 8, bytes(8)))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert rig.received() == []
    rig.far.send(pack_frame(join(J1939Id(6, 60928, 40)), True, bytes(8)))  # a node with a higher priority
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert [split(can_id).source for can_id, _ in rig.received()] == [41]
    rig.close()
    assert rig.context.kept == {"nmea2000": 41}
    assert rig.context.outputs.ports == {}


@in_loop
async def test_product_information_passes_a_short_queue_of_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, share_interface=True).settle()
    assert rig.opened == [("can0", False)]
    sent = rig.output.status()[0].sent
    rig.bus.room = 10
    rig.far.send(pack_frame(join(J1939Id(6, 59904, 9, 128)), True, (126996).to_bytes(3, "little")))
    frames: list[Frame] = []
    while len(frames) < 20:
        await asyncio.sleep(0)
        frames += rig.received()
        rig.bus.room = 3
    assert fields(frames)[126996]["certificationLevel"] is None
    assert fields(frames)[126996]["modelId"] == "imud"
    assert rig.output.status()[0].sent == sent + 1
    rig.close()


@in_loop
async def test_a_bus_without_another_node_drops_old_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch).settle()
    rig.bus.room = 0
    rig.publish(50)  # five headings, five rates, one attitude
    assert rig.output.status()[0].dropped == 0
    rig.tick(251)
    (status,) = rig.output.status()
    assert (status.dropped, status.readers) == (11, 0)
    assert "accepts no frames" in status.problem
    rig.bus.room = 100
    rig.publish(10)
    assert [split(can_id).pgn for can_id, _ in rig.received()] == [127250, 127251]
    assert (rig.output.status()[0].problem, rig.output.status()[0].readers) == ("", 1)
    rig.bus.room = 0
    rig.publish(2000)
    assert rig.output.status()[0].dropped > 11 + 200  # the queue has a limit
    rig.close()


@in_loop
async def test_an_absent_interface_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch)
    rig.problem = "can0 is down"
    times: list[int] = []
    for second in range(64):
        looked = Mock(side_effect=lambda _name: rig.problem)
        monkeypatch.setattr(port, "interface_problem", looked)
        rig.tick()
        times += [second] * looked.call_count
    assert times[:5] == [0, 1, 3, 7, 15]
    assert rig.output.status()[0].problem == "can0 is down"
    rig.publish()
    assert (rig.output.status()[0].dropped, rig.opened) == (3, [])
    monkeypatch.setattr(port, "interface_problem", lambda _name: rig.problem)
    rig.problem = ""
    for _ in range(31):
        rig.tick()
    assert [split(can_id).pgn for can_id, _ in rig.received()] == [60928, 126993]
    rig.bus.room, rig.bus.error = 0, errno.ENETDOWN
    rig.publish(10)
    rig.far.close()
    assert "Network is down" in rig.output.status()[0].problem
    rig.tick()
    rig.tick()
    assert ([split(can_id).pgn for can_id, _ in rig.received()][:1], len(rig.opened)) == ([60928], 2)
    rig.problem = "can0 is bus-off"
    rig.tick()
    assert rig.output.status()[0].problem == "can0 is bus-off"
    rig.close()


@pytest.mark.parametrize(
    ("absence", "details", "words"),
    [
        ("can0 is down", None, "can0 is down"), ("", CanDetails(250_000, 0), ""), ("", CanDetails(None, None), ""),
        ("", CanDetails(500_000, 0), "can0: expected 250000 bit/s, got 500000; run `ip link set can0 down`"),
        ("", CanDetails(250_000, 3), "can0 is bus-off; check the bit rate"), ("", LinkError("gone"), "gone"),
    ],
)  # fmt: skip
def test_problems_of_an_interface(monkeypatch: pytest.MonkeyPatch, absence: str, details: object, words: str) -> None:
    monkeypatch.setattr(netlink, "absence", lambda _name: absence)
    monkeypatch.setattr(netlink, "can_details", Mock(side_effect=[details]))
    assert port.interface_problem("can0").startswith(words)


def test_the_unique_number_is_a_hash_of_the_host(tmp_path: Path) -> None:
    file = tmp_path / "machine-id"
    without = output.unique_number(file)
    file.write_text("0123456789abcdef0123456789abcdef\n")
    # sha256("imud nmea2000 0123456789abcdef0123456789abcdef"), first four bytes, little-endian, 21 bits
    assert output.unique_number(file) == 1579412 != without


@in_loop
async def test_second_node_with_name_is_in_status(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Replays of the NAME for 60 s: the status names the cause, data continue, and the log has one line."""
    rig = Rig(monkeypatch)
    rig.tick(1)
    rig.tick(500)
    can_id, name = rig.received()[0]  # the claim
    caplog.clear()
    for _ in range(120):
        rig.tick(500)
        for source in (128, 129, 130, 131):
            rig.far.send(pack_frame(can_id & ~0xFF | source, True, name))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    status = rig.output.status()[0]
    assert status.problem.startswith("another node has the NAME")
    assert (status.readers, status.discarded) == (1, 480)
    assert len(caplog.records) <= 2
    rig.tick(500)
    rig.received()
    rig.publish()
    assert 127250 in {split(can_id).pgn for can_id, _ in rig.received()}
    rig.close()


@in_loop
async def test_node_with_many_requests_is_in_status(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch).settle()
    request_id = join(J1939Id(6, 59904, 7, 128))
    for _ in range(50):
        rig.far.send(pack_frame(request_id, True, (126996).to_bytes(3, "little")))
    for _ in range(3):
        await asyncio.sleep(0)
    status = rig.output.status()[0]
    assert status.problem.startswith("the node with address 7 sends more than imud processes: 18 inputs")
    assert (status.readers, status.discarded) == (1, 18)
    assert len(rig.received()) == 20  # one reply of 20 frames
    rig.tick(11_000)
    assert rig.output.status()[0].problem == ""
    rig.close()


HOSTILE = st.tuples(st.integers(0, 0xFFFF_FFFF), st.binary(max_size=8))


def in_fresh_loop(test: Callable[[], Any]) -> None:
    in_loop(test)()


@given(st.lists(HOSTILE, max_size=20))
def test_hostile_frames_never_end_the_output(frames: list[tuple[int, bytes]]) -> None:
    with pytest.MonkeyPatch.context() as patch:

        async def run() -> None:
            rig = Rig(patch).settle()
            failures: list[object] = []
            asyncio.get_running_loop().set_exception_handler(lambda _loop, context: failures.append(context))
            for can_id, data in frames:
                rig.far.send(RAW_FRAME.pack(can_id, len(data), data))
            rig.far.send(b"short")
            for _ in range(3):
                await asyncio.sleep(0)
            rig.tick()
            assert (rig.output.status()[0].problem, failures) == ("", [])
            rig.close()

        in_fresh_loop(run)


@in_loop
async def test_messages_of_an_unopened_port_are_dropped() -> None:
    node = Mock(refused=1, problem="", ignored=0, claimed=None)
    node.peer_problem.return_value = ""
    node_port = port.NodePort(node, "can0", lambda: 0)
    node_port.put([None, [NodeFrame(1, b"")]])
    assert (node_port.status().dropped, node_port.status().problem) == (3, "not open yet")


def test_an_output_that_is_off_imports_only_its_options() -> None:
    words = "import sys\nfrom imud.publishers import PUBLISHERS\nPUBLISHERS['nmea2000'].settings()\n"
    found = subprocess.check_output([sys.executable, "-c", f"{words}print(*sys.modules)"], text=True).split()
    assert [name for name in found if name.startswith("imud.publishers.nmea2000")] == ["imud.publishers.nmea2000"]
    assert not {"imud.host.netlink", "imud.publishers.vessel"} & set(found)
