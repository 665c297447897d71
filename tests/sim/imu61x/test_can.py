"""The simulated IMU61x on CAN compared with its true values. imud's codec decodes its frames."""

import itertools

import pytest

from imud.attitude.rotation import euler_zyx_from_quat
from imud.drivers.imu61x.can import Imu61xCanCodec, Imu61xCanOptions
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.can_module import SentFrame
from imud.sim.imu61x.can import Imu61xCanHardware, Imu61xCanModule

BEGIN_NS = 5_000_000_000
SECOND_NS = 1_000_000_000


def run(module: Imu61xCanModule, until_ns: int, step_ns: int = 700_000) -> list[SentFrame]:
    frames: list[SentFrame] = []
    for now_ns in range(BEGIN_NS, until_ns + 1, step_ns):
        done = module.advance(now_ns)
        assert all(frame.due_ns <= now_ns for frame in done)
        frames += done
    return frames


def decoded(frames: list[SentFrame]) -> list[Measurement]:
    codec = Imu61xCanCodec(Ledger(), Imu61xCanOptions())
    events = [event for f in frames for event in codec.feed_frame(f.can_id, f.extended, f.data, f.due_ns)]
    return [event for event in events if isinstance(event, Measurement)]


def test_values_are_the_truth_of_the_sample_instant() -> None:
    module = Imu61xCanModule(BEGIN_NS, Imu61xCanHardware(boot_ms=0, index=65530))
    frames = run(module, BEGIN_NS + SECOND_NS)
    measured = decoded(frames)
    assert len(measured) == pytest.approx(100, abs=1)
    assert [m.dev_ticks for m in measured[:8]] == [65530, 65531, 65532, 65533, 65534, 65535, 0, 1]
    for measurement, last in zip(measured, frames[4::5], strict=False):
        assert last.sample_ns is not None
        truth = module.hardware.motion.at((last.sample_ns - module.epoch_ns) / 1e9)
        assert measurement.gyro_rad_s == pytest.approx(truth.gyro_rad_s, abs=1e-6)
        assert measurement.accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=1e-5)
        assert measurement.euler_rad == pytest.approx(euler_zyx_from_quat(truth.quat_wxyz), abs=1e-6)
        assert measurement.temperature_c == pytest.approx(truth.temperature_c, abs=0.005001)
    module = Imu61xCanModule(BEGIN_NS, Imu61xCanHardware(boot_ms=0, index=500))
    run(module, BEGIN_NS + SECOND_NS)
    module.reboot(BEGIN_NS + SECOND_NS)
    measured = decoded(module.advance(BEGIN_NS + SECOND_NS + SECOND_NS // 10))
    assert measured[0].dev_ticks == 0


def test_frames_take_their_time_on_the_wire_and_the_crystal_runs_fast() -> None:
    module = Imu61xCanModule(BEGIN_NS, Imu61xCanHardware(boot_ms=0, rate_hz=200, skew_ppm=1000, bitrate=250_000))
    frames = run(module, BEGIN_NS + SECOND_NS)
    one = frames[:5]
    assert [b.due_ns - a.due_ns for a, b in itertools.pairwise(one)] == [480_000] * 4
    assert one[0].sample_ns is not None
    assert one[0].due_ns - one[0].sample_ns == 125_000 + 480_000
    assert module.counters() == {"samples_sent": 201, "frames_sent": 1005}
