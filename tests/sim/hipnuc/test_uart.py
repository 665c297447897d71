"""The simulated device follows chapter 3 of the manual, and the codec decodes its frames."""

from itertools import pairwise
from math import degrees, hypot
from typing import TypeVar

import pytest

from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart import HipnucModule, make
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings, Output
from imud.sim.physics import Noise, Still, swing
from imud.sim.sensor import SimulatorOptions
from tests.support.simulated_modules import BEGIN_NS, FAST, HIPNUC_STILL, HipnucUartBench, unpack_hi91

T = TypeVar("T")


@pytest.mark.manual("B 3.2 factory output")
def test_frames_and_their_times() -> None:
    frames = HipnucUartBench().frames(1000.0)
    assert len(frames) == pytest.approx(100, abs=1)
    assert {after.system_time_ms - before.system_time_ms for before, after in pairwise(frames)} == {10}

    module = HipnucModule(BEGIN_NS)
    assert module.advance(BEGIN_NS + 500 * NS_PER_MS) == []
    assert unpack_hi91(module.advance(BEGIN_NS + 520 * NS_PER_MS)[0].data).system_time_ms == 510

    (frame, *_) = HipnucUartBench(hardware=HIPNUC_STILL).frames(20.0)
    assert hypot(*frame.accel_g) == pytest.approx(1.0, abs=1e-6)
    assert frame.gyro_deg_s == (0.0, 0.0, 0.0)

    settings = ModuleSettings(baud=115_200)
    for burst in HipnucUartBench(settings, HipnucHardware(processing_ns=125_000)).wait(50.0):
        assert burst.sample_ns
        assert burst.due_ns - burst.sample_ns == 125_000 + 82 * 10 * NS_PER_S // 115_200

    bench = HipnucUartBench(FAST)
    for _ in range(50):
        next_ns = bench.module.next_ns()
        assert next_ns is not None
        assert bench.module.advance(next_ns - 1) == []
        assert len(bench.module.advance(next_ns)) == 1

    coarse, fine = HipnucUartBench(FAST), HipnucUartBench(FAST)
    assert coarse.wait(60.0) == [burst for _ in range(240) for burst in fine.wait(0.25)]

    bench = HipnucUartBench(ModuleSettings(hi91=Output(20), hi92=Output(50)))
    sizes = [len(burst.data) for burst in bench.wait(1000.0)]
    assert (sizes.count(82), sizes.count(54)) == pytest.approx((50, 20), abs=1)


@pytest.mark.parametrize("skew_ppm", [-50_000.0, 0.0, 123.4])
def test_samples_stand_on_milliseconds_of_its_own_crystal(skew_ppm: float) -> None:
    bench = HipnucUartBench(FAST, HipnucHardware(skew_ppm=skew_ppm, processing_ns=0))
    bursts = bench.wait(1000.0)
    assert len(bursts) == pytest.approx(1000 * (1 + skew_ppm / 1e6), abs=2)
    for burst in bursts:
        assert burst.sample_ns
        assert burst.device_ms == unpack_hi91(burst.data).system_time_ms
        true_ms = (burst.sample_ns - BEGIN_NS) / NS_PER_MS * (1 + skew_ppm / 1e6)
        assert true_ms == pytest.approx(burst.device_ms, abs=2e-6)


@pytest.mark.parametrize("skew_ppm", [-333.3, 50_000.0])
def test_settings_changed_at_the_instant_of_a_sample_repeat_none(skew_ppm: float) -> None:
    bench = HipnucUartBench(FAST, HipnucHardware(skew_ppm=skew_ppm))
    instants = [burst.sample_ns or 0 for burst in bench.wait(200.0)][50:]
    bench = HipnucUartBench(FAST, HipnucHardware(skew_ppm=skew_ppm))
    for instant_ns in instants:
        bench.module.receive(b"LOG ENABLE\r\n", instant_ns)
    times = [unpack_hi91(burst.data).system_time_ms for burst in bench.wait(300.0) if burst.sample_ns]
    assert {after - before for before, after in pairwise(times)} == {1}


def test_frame_carries_the_truth_of_its_instant() -> None:
    motion = swing()
    for burst in HipnucUartBench(FAST, HipnucHardware(motion=motion)).wait(100.0):
        assert burst.sample_ns
        truth, frame = motion.at((burst.sample_ns - BEGIN_NS) / NS_PER_S), unpack_hi91(burst.data)
        assert frame.accel_g == pytest.approx([value / 9.8 for value in truth.accel_m_s2], abs=1e-6)
        assert frame.gyro_deg_s == pytest.approx([degrees(value) for value in truth.gyro_rad_s], abs=1e-4)
        assert frame.mag_ut == pytest.approx([value * 1e6 for value in truth.mag_t], abs=1e-5)
        assert frame.euler_deg == pytest.approx([degrees(value) for value in truth.euler_rad], abs=1e-4)
        assert frame.quat_wxyz == pytest.approx(truth.quat_wxyz, abs=1e-6)
        assert frame.pressure_pa == pytest.approx(truth.pressure_pa, abs=0.01)
        assert frame.temperature_c == round(truth.temperature_c)
    bench = HipnucUartBench(ModuleSettings(baud=115_200, hi91=Output(1)))
    bursts = bench.wait(1000.0)
    assert len(bursts) == pytest.approx(115_200 / 820, abs=2)
    ends = [burst.due_ns for burst in bursts]
    assert min(b - a for a, b in pairwise(ends)) >= 82 * 10 * NS_PER_S // 115_200
    assert all(burst.sample_ns and burst.due_ns - burst.sample_ns < 50 * NS_PER_MS for burst in bursts)
    assert bench.module.counters()["frames_dropped"] > 800


@pytest.mark.parametrize(("uptime_ms", "first"), [(0, 510), (8192 * 3 - 505, 3)])
def test_pps_stamp_free_runs_and_wraps_at_8192(uptime_ms: int, first: int) -> None:
    frames = HipnucUartBench(hardware=HipnucHardware(uptime_ms=uptime_ms, skew_ppm=0)).frames(9000.0)
    assert frames[0].word_1_2 == pytest.approx(first, abs=10)
    assert all(frame.word_1_2 == frame.system_time_ms % 8192 for frame in frames)
    assert min(frame.word_1_2 for frame in frames) < 10


@pytest.mark.manual("B 3.3.1 system_time", "B 2.2.5 ONMARK 1")
def test_main_status_noise_the_end_of_32_bits_and_pulses() -> None:
    bench = HipnucUartBench(hardware=HipnucHardware(motion=Still(), firmware=169, skew_ppm=0))
    early, late = bench.frames(20.0)[0], bench.frames(6000.0)[-1]
    assert early.word_1_2 == 1 << 3 | 1 << 7 | 1 << 9 | 1 << 11 | 1 << 12
    assert late.word_1_2 == 1 << 9 | 1 << 11 | 1 << 12
    assert bench.ask("CONFIG ATT MODE 1") == ["OK"]
    assert bench.frames(20.0)[0].word_1_2 & 1 << 10
    assert not HipnucUartBench(hardware=HipnucHardware(firmware=169)).frames(20.0)[0].word_1_2 & 1 << 9

    clean = HipnucUartBench(hardware=HIPNUC_STILL).frames(50.0)
    noisy = HipnucUartBench(hardware=HipnucHardware(motion=HIPNUC_STILL.motion, skew_ppm=0, noise=Noise(1))).frames(
        50.0
    )
    assert all(a.accel_g != b.accel_g and a.quat_wxyz == b.quat_wxyz for a, b in zip(clean, noisy, strict=True))

    frames = HipnucUartBench(hardware=HipnucHardware(uptime_ms=2**32 - 700)).frames(1000.0)
    times = [frame.system_time_ms for frame in frames]
    assert times[0] > 2**32 - 250
    assert times[-1] < 1000

    bench = HipnucUartBench(hardware=HipnucHardware(skew_ppm=0))
    bench.wait(125.0)
    bench.module.mark(bench.now_ns)
    frame = bench.frames(40.0)[-1]
    assert frame.word_1_2 == frame.system_time_ms - 625
    bench = HipnucUartBench()
    assert bench.ask("UNLOGALL") == ["OK"]
    assert bench.ask("LOG HI91 ONMARK 1") == ["OK"]
    assert bench.wait(1000.0) == []
    marked_ns = bench.now_ns
    bench.module.mark(marked_ns)
    (burst,) = bench.wait(30.0)
    assert burst.sample_ns == marked_ns
    late_ns = burst.due_ns - marked_ns - 125_000 - 82 * 10 * NS_PER_S // 115_200
    assert abs(late_ns) <= bench.module.hardware.mark_spread_ns
    bench.module.receive(b"LOG IMU91 ONMARK ONCE\r\n", bench.now_ns)
    kinds = [burst.sample_ns is None for burst in bench.wait(30.0)]
    assert sorted(kinds) == [False, True]
    assert bench.wait(1000.0) == []


@pytest.mark.parametrize("message", ["HI91", "HI92"])
def test_codec_reads_every_frame(message: str) -> None:
    module, ledger = make(SimulatorOptions(rate_hz=1000, message=message, noise="none"), BEGIN_NS), Ledger()
    codec = DRIVER.make_codec(ledger, DRIVER.settings())
    for burst in module.advance(BEGIN_NS + NS_PER_S):
        (event,) = codec.feed(burst.data)
        assert isinstance(event, Measurement)
        assert burst.sample_ns
        truth = module.hardware.motion.at((burst.sample_ns - BEGIN_NS) / NS_PER_S)
        assert event.accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=3e-3)
        assert event.gyro_rad_s == pytest.approx(truth.gyro_rad_s, abs=6e-4)
        assert event.quat_wxyz == pytest.approx(truth.quat_wxyz, abs=1e-4)
    assert ledger.frames_good == pytest.approx(499, abs=1)
    assert ledger.closes()


@pytest.mark.parametrize(
    ("rate_hz", "message", "baud"),
    [(1, "", 115_200), (100, "hi91", 115_200), (200, "HI92", 115_200), (200, "HI91", 230_400), (1000, "", 921_600)],
)
def test_baud_follows_from_the_rate(rate_hz: float, message: str, baud: int) -> None:
    assert make(SimulatorOptions(rate_hz=rate_hz, message=message), 0).baud == baud


@pytest.mark.parametrize(
    "options",
    [
        SimulatorOptions(rate_hz=0), SimulatorOptions(rate_hz=-1), SimulatorOptions(rate_hz=2000),
        SimulatorOptions(rate_hz=300), SimulatorOptions(rate_hz=float("nan")), SimulatorOptions(baud=57_600),
        SimulatorOptions(message="HI93"), SimulatorOptions(motion="dance"),
    ],
)  # fmt: skip
def test_impossible_options_are_refused(options: SimulatorOptions) -> None:
    with pytest.raises(ValueError, match="expected"):
        make(options, 0)
