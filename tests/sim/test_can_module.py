"""Several simulated devices as one object, their transfer to the kernel, and the frames of single devices."""

import socket
from collections.abc import Mapping
from typing import Any, Final

import pytest

from imud.attitude.rotation import euler_zyx_from_quat
from imud.contracts.codec import CodecEvent
from imud.contracts.driver import CanDriver
from imud.drivers import DRIVERS
from imud.drivers.imu61x.can import DRIVER, Imu61xCanCodec, Imu61xCanOptions
from imud.formats.can import RAW_FRAME
from imud.formats.j1939 import split
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim import CAN_SIMULATORS
from imud.sim.can_module import CanModules, FrameWire, SentFrame
from imud.sim.hipnuc.nmea2000 import SIMULATOR, HipnucNmea2000Module
from imud.sim.imu61x.can import Imu61xCanHardware, Imu61xCanModule
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


def test_a_frame_takes_its_time_and_frames_leave_together_where_there_is_no_bit_rate() -> None:
    for bitrate in (0, 500_000):
        wire = FrameWire(bitrate, 0)
        for number in range(5):
            wire.send(1000, number, False, bytes(8))
        assert len(wire.sent(1000)) == (5 if bitrate == 0 else 0)
        assert len(wire.sent(1000 + 5 * 240_000)) == (0 if bitrate == 0 else 5)
    # 47 or 67 bits around the data, 64 of data, some stuff bits
    for extended, size, bits in ((False, 8, 120), (True, 8, 140), (True, 64, 140 + 56 * 8 // 4)):
        wire = FrameWire(500_000, 0)
        wire.send(1000, 1, extended, bytes(size))
        assert wire.next_ns() == 1000 + bits * 2000


IMPOSSIBLE: dict[str, list[dict[str, Any]]] = {
    "hipnuc-canopen": [{"rate_hz": 0.5}, {"rate_hz": 150}, {"message": "x"}, {"motion": "none"}, {"node": 128}],
    "hipnuc-canfd": [{"rate_hz": 0.5}, {"rate_hz": 500.0}, {"message": "x"}, {"motion": "none"}, {"node": 129}],
    "hipnuc-j1939": [{"rate_hz": 0.5}, {"rate_hz": 500.0}, {"message": "x"}, {"motion": "none"}, {"node": 129}],
    "hipnuc-nmea2000": [{"rate_hz": 0.5}, {"rate_hz": 101.0}, {"message": "x"}, {"motion": "none"}, {"node": 254}],
    "imu61x-can": [{"rate_hz": 0.5}, {"rate_hz": 401}, {"message": "x"}, {"motion": "none"}, {"node": 2045}],
}


@pytest.mark.parametrize("name", CAN_SIMULATORS)
def test_impossible_options_are_refused(name: str) -> None:
    for options in IMPOSSIBLE[name]:
        with pytest.raises(ValueError, match=next(iter(options)).removesuffix("_hz")):
            CAN_SIMULATORS[name].make(SimulatorOptions(**options), 0)


@pytest.mark.parametrize("name", [name for name in CAN_SIMULATORS if name != "hipnuc-canfd"])
def test_frames_of_a_sample_take_their_time_at_the_bit_rate(name: str) -> None:
    module = CAN_SIMULATORS[name].make(SimulatorOptions(rate_hz=20.0, baud=250_000, boot_ms=0, noise="none"), BEGIN_NS)
    frames = [frame for frame in module.advance(BEGIN_NS + 1000 * MS) if frame.sample_ns is not None]
    first, second = (frame.due_ns for frame in frames[:2])
    assert frames[0].sample_ns == frames[1].sample_ns
    assert second - first == (140 if frames[0].extended else 120) * 4000


BEGIN_NS: Final = 5_000_000_000
SECONDS: Final = 5
TOLERANCES: Final[Mapping[str, Mapping[str, float]]] = {
    "hipnuc-canopen": {
        "accel_m_s2": 0.0050, "gyro_rad_s": 0.00088, "quat_wxyz": 0.000051, "euler_rad": 0.000088,
        "incli_rad": 0.000088, "pressure_pa": 0.51,
    },
    "hipnuc-canfd": {
        "accel_m_s2": 0.0024, "gyro_rad_s": 0.00054, "mag_t": 1.6e-8, "euler_rad": 9e-6, "quat_wxyz": 5.1e-5,
        "temperature_c": 0.0051,
    },
    "hipnuc-j1939": {
        "accel_m_s2": 0.0024, "gyro_rad_s": 0.00054, "mag_t": 1.6e-8, "euler_rad": 9e-6, "quat_wxyz": 5.1e-5,
        "temperature_c": 0.0051,
    },
    "hipnuc-nmea2000": {"euler_rad": 5.1e-5, "gyro_rad_s": 1.6e-8},
    "imu61x-can": {"gyro_rad_s": 1e-6, "accel_m_s2": 1e-5, "euler_rad": 1e-6, "temperature_c": 0.005001},
}  # fmt: skip
"""Resolution of each value on the wire. A driver that is not here has no test of its values."""


@pytest.mark.parametrize("name", CAN_SIMULATORS)
def test_values_are_the_truth_of_the_sample_instant(name: str) -> None:
    driver, rate_hz = DRIVERS[name], 20.0 if name == "hipnuc-nmea2000" else 100.0
    assert isinstance(driver, CanDriver)
    message = {"hipnuc-j1939": "all", "hipnuc-canfd": "canfd_old"}.get(name, "")
    options = SimulatorOptions(rate_hz=rate_hz, noise="none", boot_ms=0, message=message)
    module: Any = CAN_SIMULATORS[name].make(options, BEGIN_NS)
    frames = module.advance(BEGIN_NS + SECONDS * 1000 * MS)
    codec = driver.make_codec(Ledger(), driver.settings())
    instants, seen = {frame.due_ns: frame.sample_ns for frame in frames}, list[str]()
    for frame in frames:
        for event in codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.due_ns):
            if not isinstance(event, Measurement):
                continue
            sample_ns = instants[event.t_first_ns or frame.due_ns]
            assert sample_ns is not None
            truth = module.hardware.motion.at((sample_ns - module.epoch_ns) / 1e9)
            expected = {**truth._asdict(), "incli_rad": (truth.euler_rad[1], truth.euler_rad[0])}
            if name == "imu61x-can":
                expected["euler_rad"] = euler_zyx_from_quat(truth.quat_wxyz)
            elif name == "hipnuc-nmea2000":  # rate of turn only
                expected["gyro_rad_s"] = (float("nan"), float("nan"), truth.gyro_rad_s[2])
            for field, tolerance in TOLERANCES[name].items():
                if (value := getattr(event, field)) is not None:
                    seen.append(field)
                    assert value == pytest.approx(expected[field], abs=tolerance, nan_ok=True), field
    assert set(seen) == TOLERANCES[name].keys()
    assert seen.count("euler_rad") == pytest.approx(SECONDS * rate_hz, abs=2)
    assert codec.ledger.closes()
    assert codec.ledger.lost() == 0


SECOND_NS = 1_000_000_000


def made(**options: object) -> HipnucNmea2000Module:
    given = {"rate_hz": 20.0, "noise": "none", "boot_ms": 0, **options}
    module = SIMULATOR.make(SimulatorOptions(**given), BEGIN_NS)  # type: ignore[arg-type]  # a mapping of options
    assert isinstance(module, HipnucNmea2000Module)
    return module


@pytest.mark.parametrize(
    ("message", "pgns"), [("", [127250, 127251, 127257]), ("heading", [127250]), ("attitude", [127257])]
)
def test_what_it_sends(message: str, pgns: list[int]) -> None:
    module = made(message=message, node=5)
    frames = module.advance(BEGIN_NS + 20 * SECOND_NS)
    assert [split(f.can_id).pgn for f in frames[: len(pgns)]] == pgns
    assert {split(f.can_id).source for f in frames} == {5}
    sids = [f.data[0] for f in frames[:: len(pgns)]]
    assert sids[250:255] == [250, 251, 252, 0, 1]
    assert all(f.data[0] == sids[n // len(pgns)] for n, f in enumerate(frames))
    module.reboot(BEGIN_NS + 20 * SECOND_NS)
    due_ns = module.next_ns()
    assert due_ns is not None
    assert module.advance(due_ns)[0].data[0] == 0


def indices(frames: list[SentFrame]) -> list[int | None]:
    codec = Imu61xCanCodec(Ledger(), Imu61xCanOptions())
    events = [event for f in frames for event in codec.feed_frame(f.can_id, f.extended, f.data, f.due_ns)]
    return [event.dev_ticks for event in events if isinstance(event, Measurement)]


def test_the_index_has_16_bits_and_starts_again_after_a_restart() -> None:
    module = Imu61xCanModule(BEGIN_NS, Imu61xCanHardware(boot_ms=0, index=65530))
    found = indices(module.advance(BEGIN_NS + SECOND_NS))
    assert found[:8] == [65530, 65531, 65532, 65533, 65534, 65535, 0, 1]
    module.reboot(BEGIN_NS + SECOND_NS)
    assert indices(module.advance(BEGIN_NS + SECOND_NS + SECOND_NS // 10))[0] == 0
