"""Simulated modules with known attitude: published samples, and events about contradictions."""

import asyncio
from itertools import pairwise
from math import degrees, radians
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from imud.attitude import rotation
from imud.attitude.conventions import FLU_LEVEL, RFU_ENU, Convention, EulerOrder, Heading
from imud.attitude.published import FrameOptions, MountingAngles, MountingAxes, mounting_of, published_frame
from imud.config.model import DeviceConfig
from imud.contracts.publisher import Batch
from imud.contracts.status import FrameStatus
from imud.device.health import DeviceEvents
from imud.device.watches import AttitudeWatch, StatusWatch
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.uart.codec import HipnucCodec, HipnucOptions, encode_hi91
from imud.links.memory import MemoryOptions
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger
from imud.model.sample import Sample, Sync, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.driver_clock import make_clock
from imud.sampling.path import PathContext, StreamPath
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings
from imud.sim.imu61x.uart import Imu61xHardware, Imu61xModule
from imud.sim.physics import Motion, Sine, Still, Swing, Truth
from imud.sim.sensor import StreamModule
from tests.support.device_rig import DeviceRig, DeviceRigs, play
from tests.support.event_loops import VirtualClock

BODY_DEG = (5.0, -10.0, 30.0)
"""Roll, pitch, yaw of the body in enu-flu: left side up 5°, nose up 10°, front 30° left of east."""
STEP_S = 0.01


def in_body(frame: FrameOptions, euler_deg: Vector3 = BODY_DEG, device: Any = RFU_ENU) -> Still:
    """Return the motion of a mounted sensor in a body at rest. `Still` uses the order 312."""
    roll, pitch, yaw = euler_deg
    body = rotation.matrix_from_quat(rotation.quat_from_euler_zyx((radians(roll), radians(pitch), radians(yaw))))
    sensor = rotation.quat_from_matrix(rotation.matrix_product(body, mounting_of(frame, device)))
    return Still(*rotation.euler312_from_quat(sensor))


class ZDown:
    """Return the motion of a sensor with x forward, y right, z down, in a level system with z down."""

    def __init__(self, motion: Motion) -> None:
        self._motion = motion

    def at(self, t_s: float) -> Truth:
        truth = self._motion.at(t_s)
        x, y, z = truth.accel_m_s2
        p, q, r = truth.gyro_rad_s
        flip = (0.0, 1.0, 0.0, 0.0)
        quat = rotation.quat_product(rotation.quat_product(flip, truth.quat_wxyz), flip)
        return truth._replace(accel_m_s2=(x, -y, -z), gyro_rad_s=(p, -q, -r), quat_wxyz=quat)


class Played:
    def __init__(self, rig: DeviceRig) -> None:
        self.samples = rig.samples
        self.events: list[Event] = [one for one in rig.events if one.kind is EventKind.ATTITUDE]
        self.changes = [one.message for one in rig.events if one.kind is EventKind.CONFIGURATION]
        status = rig.device.status().frame
        assert status is not None
        self.status: FrameStatus = status
        self.newest = rig.samples[-1]

    @property
    def euler_deg(self) -> Vector3:
        assert self.newest.euler_rad is not None
        roll, pitch, yaw = map(degrees, self.newest.euler_rad)
        return (roll, pitch, yaw)


def played(
    driver: str, motion: Motion, seconds: float = 12.0, identify: bool = False, coord: int = 0, **keys: Any
) -> Played:
    """Run a module on a link in memory in virtual time, with these keys of the configuration."""
    clock = VirtualClock()
    module: StreamModule
    if driver == "hipnuc-uart":
        module = HipnucModule(
            clock.now_ns(), ModuleSettings(att_mode=1, coord=coord), HipnucHardware(motion=motion, skew_ppm=0)
        )
    else:
        module = Imu61xModule(clock.now_ns(), hardware=Imu61xHardware(motion=motion, skew_ppm=0))
    rigs = DeviceRigs(clock.host)
    rigs.add(DeviceConfig("bow", driver, None, identify, "memory", MemoryOptions(baud=115_200), **keys))
    results: list[Played] = []

    async def story(made: list[DeviceRig]) -> None:
        (rig,) = made
        heard = 0
        for number in range(int(seconds / STEP_S)):
            await asyncio.sleep(STEP_S)
            now_ns = clock.now_ns()
            for data in rig.link.written[heard:]:
                module.receive(data, now_ns)
            heard = len(rig.link.written)
            for burst in module.advance(now_ns):
                rig.link.feed(burst.data, now_ns)
            if number % 10 == 0:
                rig.tick()
        results.append(Played(rig))

    play(rigs, story, clock)
    return results[0]


def axes(x: str, y: str, z: str) -> FrameOptions:
    return FrameOptions(axes=MountingAxes(x=x, y=y, z=z))  # type: ignore[arg-type]  # names of axes


MOUNTINGS = {
    "as the manual draws it": FrameOptions(), "on its side": axes("y", "z", "x"), "upside down": axes("y", "x", "-z"),
    "turned 90° in yaw": axes("x", "y", "z"),  # a module with x right, y forward
    "by angles": FrameOptions(euler=MountingAngles(roll_deg=90, pitch_deg=20, yaw_deg=-70)),
    "by a quaternion": FrameOptions(quat_wxyz=[0.5, -0.5, 0.5, -0.5]),
}  # fmt: skip


@pytest.mark.parametrize("name", MOUNTINGS)
def test_a_module_in_any_mounting_shows_the_attitude_of_the_body(name: str) -> None:
    frame = MOUNTINGS[name]
    straight = played("hipnuc-uart", in_body(FrameOptions()), 2.0, frame=FrameOptions())
    made = played("hipnuc-uart", in_body(frame), frame=frame)
    assert made.euler_deg == pytest.approx(BODY_DEG, abs=1e-3)
    assert made.newest.accel_m_s2 == pytest.approx(straight.newest.accel_m_s2, abs=1e-4)
    assert made.newest.mag_t == pytest.approx(straight.newest.mag_t, abs=1e-10)
    assert made.newest.gyro_rad_s == pytest.approx((0, 0, 0), abs=1e-6)
    up = rotation.matrix_from_quat(made.newest.quat_wxyz or (0, 0, 0, 0))[2]
    assert made.newest.accel_m_s2 == pytest.approx([9.8 * one for one in up], abs=1e-3)
    assert (made.events, made.status.problem) == ([], "")


def test_the_same_body_in_ned_frd_and_without_the_keys() -> None:
    frame = MOUNTINGS["on its side"]
    made = played("hipnuc-uart", in_body(frame), 2.0, frame=frame, convention=Convention.NED_FRD)
    assert made.euler_deg == pytest.approx((5.0, 10.0, 60.0), abs=1e-3), "nose up, and 60° clockwise from north"
    assert (made.status.convention, made.status.navigation_frame) == ("ned-frd", "NED")
    assert "z down" in made.status.frame
    # bit-identical to the samples of a path without rotation
    motion = in_body(FrameOptions())
    made = played("hipnuc-uart", motion, 2.0)
    truth = motion.at(0.0)
    assert made.newest.quat_wxyz == pytest.approx(truth.quat_wxyz, abs=1e-6)
    assert made.newest.euler_rad == pytest.approx(truth.euler_rad, abs=1e-6)
    assert made.newest.accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=1e-5)
    assert (made.status.convention, made.status.frame) == ("device", RFU_ENU.words)
    assert made.status.euler_convention == DRIVERS["hipnuc-uart"].euler_convention
    assert set(made.status.conventions) == {"enu-flu", "ned-frd"}


def test_declination_and_heading_reference() -> None:
    """imud reads the mode of the module: nine axes, so that the heading is magnetic."""
    motion = in_body(FrameOptions())
    plain = played("hipnuc-uart", motion, 2.0, identify=True)
    assert plain.status.heading is Heading.MAGNETIC
    true = played("hipnuc-uart", motion, 2.0, identify=True, declination_deg=7.0)
    assert true.status.heading is Heading.TRUE
    assert true.status.declination_deg == 7.0
    assert true.euler_deg[2] == pytest.approx(plain.euler_deg[2] - 7.0, abs=1e-4), "yaw is counter-clockwise"
    assert true.euler_deg[:2] == pytest.approx(plain.euler_deg[:2], abs=1e-4)
    relative = played("imu61x-uart", motion, 2.0, declination_deg=7.0)
    assert relative.status.heading is Heading.RELATIVE
    assert (
        relative.status.problem == "declination_deg is configured, but yaw is measured from the direction at power-on"
    )


def test_z_down_and_a_wrong_order_of_angles_are_detected() -> None:
    """The axes of an IMU61x are uncertain: with z down the event names the right option."""
    motion = ZDown(in_body(FrameOptions(), device=FLU_LEVEL))
    wrong = played("imu61x-uart", motion, 20.0)
    (event,) = wrong.events
    assert event.detail["contradiction"] == "z-axis"
    assert event.detail["angle_deg"] == pytest.approx(180, abs=0.5)
    assert "set frame: {z_down: true}" in event.message
    assert wrong.status.problem == event.message, "as long as it is so"
    right = played("imu61x-uart", motion, 20.0, frame=FrameOptions(z_down=True))
    assert (right.events, right.status.problem) == ([], "")
    assert right.euler_deg == pytest.approx(BODY_DEG, abs=1e-3)
    made = played("imu61x-uart", in_body(FrameOptions(), device=FLU_LEVEL), frame=FrameOptions(z_down=True))
    (event,) = made.events
    assert "remove z_down from frame" in event.message
    tilted = in_body(FrameOptions(), (20.0, -15.0, 30.0), FLU_LEVEL)
    assert played("imu61x-uart", tilted).events == []
    made = played("imu61x-uart", tilted, frame=FrameOptions(euler_order=EulerOrder.ZXY))
    (event,) = made.events
    assert event.detail["contradiction"] == "euler-order"
    assert "{euler_order: zyx}" in event.message


@pytest.mark.parametrize(
    ("is_so", "said"),
    [
        ("upside down", FrameOptions()), ("as the manual draws it", axes("y", "x", "-z")),
        ("on its side", axes("y", "-x", "z")), ("on its side", axes("y", "-z", "-x")),
        ("by angles", FrameOptions(level_roll_deg=1.0)),
        ("as the manual draws it", FrameOptions(euler=MountingAngles(roll_deg=90))),
        ("as the manual draws it", FrameOptions(quat_wxyz=[0.5, -0.5, 0.5, -0.5])),
    ],
)  # fmt: skip
def test_a_wrong_mounting_is_detected(is_so: str, said: FrameOptions) -> None:
    motion = in_body(MOUNTINGS[is_so])
    made = played("hipnuc-uart", motion, frame=said)
    (event,) = made.events
    assert (event.detail["contradiction"], made.status.problem) == ("mounting", event.message)
    arm = played("hipnuc-uart", motion, frame=replace(said, level_at_rest=False))
    assert arm.events == [], "a body that need not stand level"


def test_a_replaced_device_is_checked_again() -> None:
    """A replaced device with another driver has a new path: its contradictions raise events again."""
    events: list[Event] = []
    config = DeviceConfig("bow", "auto", None, False, "memory", MemoryOptions(), frame=FrameOptions())
    watch = AttitudeWatch(config, DeviceEvents("bow", Ledger(), events.append))
    sensor = in_body(MOUNTINGS["upside down"]).at(0.0)
    paths: list[Any] = [
        SimpleNamespace(frame=published_frame(FrameOptions(), None, None, RFU_ENU), newest=None) for _ in range(2)
    ]

    def rest(path: Any) -> None:
        for number in range(200):
            path.newest = Sample(
                "bow", number, number * 10**8, 0, Sync.ARRIVAL, 0, 0, accel_m_s2=sensor.accel_m_s2,
                gyro_rad_s=sensor.gyro_rad_s, quat_wxyz=sensor.quat_wxyz, euler_rad=sensor.euler_rad,
            )  # fmt: skip
            watch.tick(number * 10**8, path)

    driver = DRIVERS["hipnuc-uart"]
    settings: Any = SimpleNamespace(values={}, shown={})
    for number, path in enumerate(paths, 1):
        path.newest = None
        watch.tick(0, path)
        status = watch.status(driver, path, settings)
        assert status is not None
        assert status.problem == "", "nothing is known of this device yet"
        rest(path)
        assert len(events) == number
        rest(path)
        assert len(events) == number


def test_a_moving_device_raises_no_event() -> None:
    """A wrongly mounted module that swings and never rests."""
    swing = Swing(roll=(Sine(0.3, 0.5), Sine(3.1, 0.0, 1.57)), pitch=(Sine(0.3, 0.4),), yaw=(Sine(0.5, 0.3),))
    assert played("hipnuc-uart", swing, 20.0, frame=FrameOptions()).events == []


def test_each_published_sample_is_rotated_once() -> None:
    """The acceleration in sensor axes stays available for the ALARM line."""
    frame = published_frame(MOUNTINGS["upside down"], None, None, RFU_ENU)
    clock, ledger, batches = VirtualClock(), Ledger(), list[Batch]()
    context = PathContext(
        "bow", 0, ledger, batches.append, lambda _message, _t_ns: None, lambda _frame: None, lambda: 0, clock.host,
        frame,
    )  # fmt: skip
    driver = DRIVERS["hipnuc-uart"]
    path = StreamPath(HipnucCodec(ledger, HipnucOptions()), make_clock("bow", None, driver, None), context)
    data = encode_hi91(
        system_time_ms=1, word_1_2=0, accel_m_s2=(1, 2, 3), gyro_rad_s=(0.25, 0.5, 0.75), mag_t=(1e-5, 2e-5, 3e-5),
        euler_rad=(0.0, 0.0, 0.0), quat_wxyz=(1, 0, 0, 0), temperature_c=20.0, pressure_pa=1e5,
    )  # fmt: skip
    path.on_data(data * 3, clock.now_ns())
    (batch,) = batches
    assert len(batch.samples) == 3
    for sample in batch.samples:
        assert sample.gyro_rad_s == pytest.approx((0.5, 0.25, -0.75), rel=1e-6)
    assert path.newest is not None
    assert path.newest.gyro_rad_s == pytest.approx((0.25, 0.5, 0.75), rel=1e-6)
    assert frame.rotation is not None
    assert frame.rotation.sample(path.newest) == batch.samples[-1]
    assert batch.frame is frame


@pytest.mark.parametrize("keys", [{}, {"declination_deg": 3.0}, {"frame": FrameOptions(level_roll_deg=1.0)}], ids=str)
@pytest.mark.parametrize("convention", Convention)
def test_both_coordinates_of_a_device_give_the_same_published_samples(
    convention: Convention, keys: dict[str, Any]
) -> None:
    """COORD 4: the device sends x forward, the navigation frame NWU, and the order 321."""
    both = [
        played("hipnuc-uart", in_body(FrameOptions()), 6.0, identify=True, coord=coord, convention=convention, **keys)
        for coord in (0, 4)
    ]
    manual, newer = both
    assert newer.euler_deg == pytest.approx(manual.euler_deg, abs=1e-3)
    for name in ("accel_m_s2", "gyro_rad_s", "mag_t", "quat_wxyz"):
        assert getattr(newer.newest, name) == pytest.approx(getattr(manual.newest, name), abs=1e-4)
    assert (newer.status, newer.events, newer.changes) == (manual.status, [], [])


def test_coordinates_are_described_and_an_unknown_value_is_reported() -> None:
    newer = played("hipnuc-uart", in_body(FrameOptions()), identify=True, coord=4)
    assert newer.euler_deg == pytest.approx((5, -10, 30 - 90), abs=1e-3)  # yaw counts from north
    assert newer.status.frame == "sensor: x forward, y left, z up, right-handed"
    assert newer.status.navigation_frame == "NWU"
    assert newer.status.euler_convention.startswith("ZYX (321)")
    assert (newer.status.problem, newer.changes) == ("", [])
    assert newer.events == []  # gravity agrees with the attitude
    unknown = played("hipnuc-uart", in_body(FrameOptions()), 4.0, identify=True, coord=2)
    (change,) = unknown.changes
    assert change == unknown.status.problem
    assert change.startswith("coordinates: expected 0 or 4 from the device (COORD), got 2: imud describes")
    assert unknown.status.navigation_frame == "ENU"


CLEAR_NS = 1 * 10**9
INTERVAL_NS = 1 * 10**9

TICK_NS = 100 * NS_PER_MS
OVER_RANGE, DISTURBED, AT_REST = 1 << 5, 1 << 4, 1 << 9


class FakePath:
    """A path with the status bits of the test."""

    def __init__(self) -> None:
        self.mask = self.status = 0
        self.last_sample_ns = 0

    def watch_status(self, mask: int) -> None:
        self.mask = mask

    def take_status(self) -> int:
        return self.status & self.mask


class WatchBench:
    def __init__(self) -> None:
        self.events: list[Event] = []
        self.watch = StatusWatch(DeviceEvents("bow", Ledger(), self.events.append))
        self.path: Any = FakePath()
        self.now_ns = 1000 * NS_PER_S

    def step(self, status: int | None, count: int = 1) -> list[str]:
        """Process samples with a status (None: no samples). Return the messages of the events."""
        before = len(self.events)
        for _ in range(count):
            self.now_ns += TICK_NS
            self.path.status = status or 0
            if status is not None:
                self.path.last_sample_ns = self.now_ns
            self.watch.tick(self.now_ns, DRIVERS["hipnuc-uart"], self.path)
        return [event.message for event in self.events[before:]]


def test_set_and_cleared_bits_raise_one_event_per_second() -> None:
    bench = WatchBench()
    assert (bench.step(AT_REST, 20), bench.step(OVER_RANGE)) == ([], ["status: accelerometer over range"])
    assert bench.events[-1].kind is EventKind.ALARM
    assert bench.events[-1].detail == {"accelerometer over range": True}
    assert bench.step(0, CLEAR_NS // TICK_NS) == []
    assert (bench.step(0, 3), bench.step(0, 100)) == (["status: cleared: accelerometer over range"], [])
    bench = WatchBench()
    bench.step(DISTURBED)
    assert (bench.step(None, 50), bench.step(DISTURBED, 5)) == ([], [])
    assert bench.step(0, 12) == ["status: cleared: magnetic disturbance"]
    bench = WatchBench()
    assert bench.step(DISTURBED | OVER_RANGE, 20)
    bench.path = FakePath()
    assert bench.step(AT_REST, 20) == []  # no bit of the previous device is cleared
    assert bench.step(DISTURBED) == ["status: magnetic disturbance"]
    assert bench.step(0, 20) == ["status: cleared: magnetic disturbance"]
    bench = WatchBench()
    bench.path.status = ~0
    bench.watch.tick(bench.now_ns, DRIVERS["imu61x-can"], bench.path)
    bench.watch.tick(bench.now_ns, None, None)
    assert bench.events == []
    bench = WatchBench()
    messages = [message for i in range(600) for message in bench.step(OVER_RANGE if i // 14 % 2 else DISTURBED)]
    times = [event.t_ns for event in bench.events]
    assert len(messages) > 30
    assert min(b - a for a, b in pairwise(times)) >= INTERVAL_NS
    other = WatchBench()
    other.step(DISTURBED | OVER_RANGE)
    other.step(DISTURBED, 10)
    assert (other.step(0), other.step(OVER_RANGE)) == (["status: cleared: accelerometer over range"], [])
    assert other.step(0, 9) == ["status: accelerometer over range, cleared: magnetic disturbance"]
