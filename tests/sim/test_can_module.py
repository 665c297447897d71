"""Several simulated devices as one object, and their transfer to the kernel."""

import socket
from typing import Any

import pytest

from imud.contracts.codec import CodecEvent
from imud.drivers.imu61x.can import DRIVER
from imud.formats.can import RAW_FRAME
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim import CAN_SIMULATORS
from imud.sim.can_module import CanModules, FrameWire, SentFrame
from imud.sim.ports.can_port import CanPort
from imud.sim.sensor import SimulatorOptions

MS = 1_000_000
PERIOD_NS = 10 * MS


class Parrot:
    """A device that sends one frame at a time and stores the received frames."""

    def __init__(self, can_id: int, due_ns: int | None) -> None:
        self.epoch_ns = can_id
        self.heard: list[int] = []
        self.marks: list[int] = []
        self._can_id, self._due_ns = can_id, due_ns

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        self.heard.append(can_id)

    def advance(self, now_ns: int) -> list[SentFrame]:
        if self._due_ns is None or now_ns < self._due_ns:
            return []
        due_ns, self._due_ns = self._due_ns, None
        return [SentFrame(due_ns, self._can_id, False, b"")]

    def next_ns(self) -> int | None:
        return self._due_ns

    def counters(self) -> dict[str, int]:
        return {"frames_sent": int(self._due_ns is None), f"of_{self._can_id}": 1}

    def mark(self, now_ns: int) -> None:
        self.marks.append(now_ns)

    def reboot(self, now_ns: int) -> None:
        self._due_ns = now_ns


def test_several_modules_are_one_and_are_told_apart() -> None:
    first, second = Parrot(1, 20), Parrot(2, 10)
    both = CanModules([first, second])
    assert both.next_ns() == 10
    assert both.advance(5) == []
    assert [frame.can_id for frame in both.advance(30)] == [2, 1]
    assert (first.heard, second.heard) == ([2], [1])
    both.receive(7, False, b"", 31)
    assert (first.heard, second.heard) == ([2, 7], [1, 7])
    assert both.counters() == {"frames_sent": 2, "of_1": 1, "of_2": 1}
    assert both.next_ns() is None
    both.mark(40)
    both.reboot(50)
    assert (first.marks, second.marks, both.next_ns(), both.epoch_ns) == ([40], [40], 50, 1)
    with pytest.raises(ValueError, match="at least one"):
        CanModules([])

    made = [
        CAN_SIMULATORS["imu61x-can"].make(SimulatorOptions(boot_ms=0, node=node, at_once=True), 0) for node in (0, 201)
    ]
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with near, far:
        port = CanPort(CanModules(made), "vcan0", open_socket=lambda interface: near)
        due_ns = port.next_ns(0)
        port.step(due_ns, False)
        raw = [far.recv(64) for _ in range(10)]
        assert [RAW_FRAME.unpack(frame)[0] for frame in raw] == [101, 102, 103, 104, 105, 201, 202, 203, 204, 205]
        far.close()
        port.step(due_ns + PERIOD_NS, False)
        assert port.summary()["frames_refused"] == 10
    codec, events = DRIVER.make_codec(Ledger(), DRIVER.node_settings(201)), list[CodecEvent]()
    for frame in raw:
        can_id, size, data = RAW_FRAME.unpack(frame)
        events += codec.feed_frame(can_id, False, data[:size], 0)
    assert [type(event) for event in events] == [Measurement]
    with pytest.raises(ValueError, match="node 2045: expected"):
        CAN_SIMULATORS["imu61x-can"].make(SimulatorOptions(node=2045), 0)


@pytest.mark.parametrize("bitrate", [0, 500_000])
def test_frames_of_one_instant_leave_together_where_there_is_no_bit_rate(bitrate: int) -> None:
    wire = FrameWire(bitrate, 0)
    for number in range(5):
        wire.send(1000, number, False, bytes(8))
    assert len(wire.sent(1000)) == (5 if bitrate == 0 else 0)
    assert len(wire.sent(1000 + 5 * 240_000)) == (0 if bitrate == 0 else 5)


@pytest.mark.parametrize(("extended", "bits"), [(False, 120), (True, 140)])
def test_a_frame_takes_its_time(extended: bool, bits: int) -> None:
    """47 or 67 bits around the data, 64 of data, some stuff bits."""
    wire = FrameWire(500_000, 0)
    wire.send(1000, 1, extended, bytes(8))
    assert wire.next_ns() == 1000 + bits * 2000


IMPOSSIBLE: dict[str, list[dict[str, Any]]] = {
    "hipnuc-canopen": [{"rate_hz": 0.5}, {"rate_hz": 150}, {"message": "x"}, {"motion": "none"}, {"node": 128}],
    "hipnuc-j1939": [{"rate_hz": 0.5}, {"rate_hz": 500.0}, {"message": "x"}, {"motion": "none"}, {"node": 129}],
    "hipnuc-nmea2000": [{"rate_hz": 0.5}, {"rate_hz": 101.0}, {"message": "x"}, {"motion": "none"}, {"node": 254}],
    "imu61x-can": [{"rate_hz": 0.5}, {"rate_hz": 401}, {"message": "x"}, {"motion": "none"}, {"node": 2045}],
}


@pytest.mark.parametrize("name", CAN_SIMULATORS)
def test_impossible_options_are_refused(name: str) -> None:
    for options in IMPOSSIBLE[name]:
        with pytest.raises(ValueError, match=next(iter(options)).removesuffix("_hz")):
            CAN_SIMULATORS[name].make(SimulatorOptions(**options), 0)


@pytest.mark.parametrize("driver", CAN_SIMULATORS)
def test_a_device_sends_at_the_time_of_its_next_frame(driver: str) -> None:
    module = CAN_SIMULATORS[driver].make(SimulatorOptions(rate_hz=100.0), 0)
    now_ns = 0
    for _ in range(60):
        due_ns = module.next_ns()
        assert due_ns is not None
        assert due_ns >= now_ns
        now_ns = due_ns
        assert module.advance(now_ns)
