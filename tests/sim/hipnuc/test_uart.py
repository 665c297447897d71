"""The simulated device follows chapter 3 of the manual, and the codec decodes its frames.
The simulated device replies, saves and resets settings, and rotates its axes as in the manual (chapters 2, 8).
Pins of the simulated device follow the manual, sections 1.2 and 2.2.4, in step with its frames."""

from itertools import pairwise
from math import cos, degrees, hypot, radians
from typing import TypeVar

import pytest

from imud.attitude.rotation import matrix_from_quat
from imud.drivers.hipnuc.uart import commands
from imud.drivers.hipnuc.uart.codec import HipnucCodec, HipnucOptions
from imud.drivers.hipnuc.uart.commands import AlarmAxis, alarm, sout_divider
from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart import HipnucModule, make
from imud.sim.hipnuc.uart_settings import AlarmSetting, HipnucHardware, ModuleSettings, Output
from imud.sim.physics import Noise, Still, swing
from imud.sim.sensor import Burst, Pin, PinEdge, SimulatorOptions
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
    coarse, fine = HipnucUartBench(FAST), HipnucUartBench(FAST)
    assert coarse.wait(60.0) == [burst for _ in range(240) for burst in fine.wait(0.25)]
    bench = HipnucUartBench(ModuleSettings(hi91=Output(20), hi92=Output(50)))
    sizes = [len(burst.data) for burst in bench.wait(1000.0)]
    assert (sizes.count(82), sizes.count(54)) == pytest.approx((50, 20), abs=1)
    for settings in (ModuleSettings(hi91=Output(10), hi92=Output(7)), ModuleSettings(hi91=Output(), hi92=Output(10))):
        module = HipnucModule(BEGIN_NS, settings)
        for _ in range(20):
            next_ns = module.next_ns()
            assert next_ns is not None
            assert (module.advance(next_ns - 1), module.advance(next_ns)[0].due_ns) == ([], next_ns)


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


def test_impossible_options_are_refused_and_the_baud_rate_follows_from_the_rate() -> None:
    for options in (
        SimulatorOptions(rate_hz=0), SimulatorOptions(rate_hz=-1), SimulatorOptions(rate_hz=2000),
        SimulatorOptions(rate_hz=300), SimulatorOptions(rate_hz=float("nan")), SimulatorOptions(baud=57_600),
        SimulatorOptions(message="HI93"), SimulatorOptions(motion="dance"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="expected"):
            make(options, 0)
    for rate_hz, message, baud in (
        (1, "", 115_200), (100, "hi91", 115_200), (200, "HI92", 115_200), (200, "HI91", 230_400), (1000, "", 921_600),
    ):  # fmt: skip
        assert make(SimulatorOptions(rate_hz=rate_hz, message=message), 0).baud == baud


VERSION = ["PNAME=HI14R3", "BUILD=Oct 15 2024", "UUID=043995698D6E1708", "APP_VER=156", "BL_VER=109", "OK"]


def test_the_vendors_probe_split_long_and_early_commands() -> None:
    bench = HipnucUartBench()
    for _ in range(3):
        assert bench.ask("LOG DISABLE") == ["OK"]
    assert bench.wait(100.0) == []
    assert bench.ask("LOG VERSION") == VERSION
    assert bench.ask("LOG ENABLE") == ["OK"]
    assert len(bench.frames(100.0)) == 10
    bench = HipnucUartBench()
    for byte in b"LOG VERSION\r\n":
        bench.module.receive(bytes([byte]), bench.now_ns)
    assert bench.text(30.0) == VERSION
    identity = [1, 0, 0, 0, 1, 0, 0, 0, 1]
    fits, too_long = ("CONFIG IMU URFR " + ",".join(f"{n:.{digits}f}" for n in identity) for digits in (9, 10))
    assert len(fits) <= 128 < len(too_long)
    assert HipnucUartBench().ask(fits) == ["OK"]
    assert HipnucUartBench().ask(too_long) == []
    bench = HipnucUartBench()
    bench.module.receive(b"REBOOT\r\nLOG VERSION\r\n", bench.now_ns)
    assert bench.ask("LOG VERSION", 800.0) == []
    bench.reboot()
    assert bench.ask("LOG VERSION") == VERSION


def test_replies_stand_between_whole_frames() -> None:
    bench = HipnucUartBench(FAST)
    for _ in range(20):
        bench.module.receive(b"LOG VERSION\r\n", bench.now_ns)
        bench.now_ns += 3 * NS_PER_MS
    bursts = bench.wait(40.0)
    text = [burst.data for burst in bursts if burst.sample_ns is None]
    assert text == ["".join(f"{line}\r\n" for line in VERSION).encode()] * 20
    ends = [burst.due_ns - len(burst.data) * 10 * NS_PER_S // 921_600 for burst in bursts]
    assert all(start >= before.due_ns - 1 for start, before in zip(ends[1:], bursts, strict=False))
    bench = HipnucUartBench(hardware=HipnucHardware(mag_bias_t=(14.14e-6, -2.08e-6, -8.75e-6)))
    assert bench.ask("LOG MAGCONFIG") == ["MB=14.14, -2.08, -8.75", "OK"]
    assert bench.ask("LOG USRCONFIG")[0] == "ATT_MODE: 0"
    assert bench.ask("CONFIG ATT MODE 1") == ["OK"]
    assert bench.ask("LOG USRCONFIG")[0] == "ATT_MODE: 1"


@pytest.mark.manual("B 2 line end")
def test_line_ends_garbage_unknown_commands_and_bad_values() -> None:
    for line in (
        "LOG VERSION\n", "LOG VERSION\r\n", "\xff\x80\x01LOG VERSION\r\n", "\r\n\r\nLOG VERSION\n",
        "LOG D\xffLOG VERSION\n",
    ):  # fmt: skip
        bench = HipnucUartBench()
        bench.module.receive(line.encode("latin-1"), bench.now_ns)
        assert bench.text(30.0) == VERSION
    for line in (
        "", "HELLO", "log version", "LOG", "LOG VERSIONS", "LOG HI93 ONTIME 1", "CONFIG ATT", "AT+RSTX", "X" * 5000,
    ):  # fmt: skip
        bench = HipnucUartBench()
        assert bench.ask(line) == []
        assert bench.ask("LOG VERSION") == VERSION
        assert bench.module.settings == ModuleSettings()
    for line in ("CONFIG ATT RST 4", "CONFIG YAW 2 0", "CONFIG YAW 1 181", "CONFIG YAW 1 nan"):
        assert HipnucUartBench().ask(line) == ["ERR"]


def test_reboot_baud_rate_and_factory_reset() -> None:
    bench = HipnucUartBench()
    assert bench.ask("LOG HI91 ONTIME 0.02") == ["OK"]
    assert bench.ask("SAVECONFIG") == ["OK"]
    assert bench.ask("LOG HI91 ONTIME 0.1") == ["OK"]
    assert bench.ask("LOG DISABLE") == ["OK"]
    assert bench.ask("REBOOT", 500.0) == []
    frames = bench.frames(1000.0)
    assert len(frames) == pytest.approx(50, abs=1)
    assert frames[0].system_time_ms == 520
    bench = HipnucUartBench(ModuleSettings(baud=9600, hi91=Output(100)), HipnucHardware(skew_ppm=0, processing_ns=0))
    bench.wait(100.0 + 41.5 * 10 / 9.6)
    bench.module.receive(b"REBOOT\r\n", bench.now_ns)
    (burst,) = bench.wait(300.0)
    assert len(burst.data) == 41
    assert burst.sample_ns is None
    bench = HipnucUartBench()
    assert bench.ask("SERIALCONFIG 921600") == ["OK"]
    assert bench.module.baud == 115_200
    assert "BAUD: 921600" in bench.ask("LOG COMCONFIG")
    bench.reboot()
    assert bench.module.baud == 115_200
    assert bench.ask("SERIALCONFIG 921600") == ["OK"]
    assert bench.ask("SAVECONFIG") == ["OK"]
    assert bench.module.baud == 115_200
    bench.reboot()
    assert bench.module.baud == 921_600
    bench = HipnucUartBench(FAST)
    assert bench.ask("CONFIG ATT MODE 1") == ["OK"]
    assert bench.ask("FRESET") == ["OK"]
    assert bench.module.baud == 921_600
    bench.reboot()
    assert (bench.module.settings, bench.module.baud) == (ModuleSettings(), 115_200)
    assert len(bench.frames(1000.0)) == pytest.approx(100, abs=1)


@pytest.mark.parametrize("mounting", commands.Mounting)
@pytest.mark.manual("B 2.2.4 URFR")
def test_urfr_turns_vectors_and_attitude_after_save_and_reboot(mounting: commands.Mounting) -> None:
    bench = HipnucUartBench(hardware=HIPNUC_STILL)
    before = bench.frames(20.0)[-1]
    assert bench.ask(commands.mounting(mounting).name) == ["OK"]
    assert bench.frames(20.0)[-1].accel_g == before.accel_g
    bench.ask("SAVECONFIG")
    bench.reboot()
    after = bench.frames(20.0)[-1]
    for old, new in ((before.accel_g, after.accel_g), (before.mag_ut, after.mag_ut)):
        back = [sum(c * value for c, value in zip(row, new, strict=True)) for row in mounting.value]  # B = C · U
        assert back == pytest.approx(old, abs=1e-5)
    up = matrix_from_quat((after.quat_wxyz[0], *after.quat_wxyz[1:]))[2]  # type: ignore[arg-type]  # four floats
    assert after.accel_g == pytest.approx(up, abs=1e-5)  # the attitude rotates with the axes: the force still points up


def test_coordinates_4_have_x_forward_and_nwu() -> None:
    plain, nwu = (HipnucUartBench(ModuleSettings(coord=coord), HIPNUC_STILL).frames(20.0)[-1] for coord in (0, 4))
    right, forward, up = plain.accel_g
    assert nwu.accel_g == pytest.approx((forward, -right, up), abs=1e-6)
    w, x, y, z = nwu.quat_wxyz
    assert matrix_from_quat((w, x, y, z))[2] == pytest.approx(nwu.accel_g, abs=1e-5)
    assert nwu.euler_deg[2] == pytest.approx(plain.euler_deg[2], abs=0.2)  # both count from north


@pytest.mark.manual("B 2.2.4 ATT RST 2", "B 2.2.4 ATT RST 5", "B 2.2.4 ATT RST 3", "B 2.2.4 YAW 1", "B 2.2.4 YAW 0")
def test_levels_and_yaw() -> None:
    bench = HipnucUartBench(hardware=HIPNUC_STILL)
    assert bench.frames(20.0)[-1].euler_deg == pytest.approx((2.0, -3.0, 40.0), abs=1e-4)
    assert bench.ask("CONFIG ATT RST 2") == ["OK"]
    levelled = bench.frames(20.0)[-1]
    assert levelled.euler_deg == pytest.approx((0.0, 0.0, 40.0), abs=1e-4)
    assert abs(levelled.accel_g[0]) > 0.01
    assert bench.ask("CONFIG ATT RST 5") == ["OK"]
    assert bench.frames(20.0)[-1].euler_deg == pytest.approx((2.0, -3.0, 40.0), abs=1e-4)
    bench = HipnucUartBench(hardware=HIPNUC_STILL)
    assert bench.ask("CONFIG ATT RST 3") == ["OK"]
    frame = bench.frames(20.0)[-1]
    assert frame.euler_deg == pytest.approx((0.0, 0.0, 40.0), abs=1e-4)
    assert frame.accel_g == pytest.approx((0.0, 0.0, 1.0), abs=1e-5)
    steep = HipnucUartBench(hardware=HipnucHardware(motion=Still(radians(2), radians(6), 0.0)))
    assert steep.ask("CONFIG ATT RST 3") == ["ERR"]
    assert steep.frames(20.0)[-1].euler_deg[1] == pytest.approx(6.0, abs=1e-4)
    turned = HipnucUartBench(hardware=HipnucHardware(motion=Still(radians(-177), radians(1), 0.0)))
    assert turned.ask("CONFIG ATT RST 3") == ["OK"]
    roll, pitch, _ = turned.frames(20.0)[-1].euler_deg
    assert abs(roll) == pytest.approx(180.0, abs=1e-4)
    assert pitch == pytest.approx(0.0, abs=1e-4)
    bench = HipnucUartBench(hardware=HIPNUC_STILL)
    bench.ask("CONFIG ATT RST 2")
    bench.ask("SAVECONFIG")
    bench.reboot()
    assert bench.frames(20.0)[-1].euler_deg == pytest.approx((0.0, 0.0, 40.0), abs=1e-4)
    bench = HipnucUartBench(hardware=HIPNUC_STILL)
    for command, yaw_deg in (("CONFIG YAW 1 16", 16.0), ("CONFIG YAW 0 1.5", 17.5), ("CONFIG YAW 1 -170", -170.0)):
        assert bench.ask(command) == ["OK"]
        assert bench.frames(20.0)[-1].euler_deg == pytest.approx((2.0, -3.0, yaw_deg), abs=1e-4)
    bench.ask("SAVECONFIG")
    bench.reboot()
    assert bench.frames(20.0)[-1].euler_deg == pytest.approx((2.0, -3.0, 40.0), abs=1e-4)


HIGH_NS = 80_000  # SOUT pulse, 80 us


def pulses(edges: list[PinEdge], pin: Pin) -> list[tuple[PinEdge, PinEdge]]:
    mine = [edge for edge in edges if edge.pin is pin]
    mine = mine[not mine[0].rising : len(mine) - mine[-1].rising]  # without incomplete pulses at both ends
    assert [edge.rising for edge in mine] == [True, False] * (len(mine) // 2)
    return list(zip(mine[::2], mine[1::2], strict=True))


def run(bench: HipnucUartBench, duration_ms: float) -> tuple[list[Burst], list[PinEdge]]:
    bursts = bench.wait(duration_ms)
    return bursts, bench.module.pins(bench.now_ns)


@pytest.mark.parametrize("settings", [ModuleSettings(), FAST, ModuleSettings(baud=115_200, hi91=Output(1))])
@pytest.mark.manual("B 1.2.2 SOUT", "B 2.2.4 PMUX2 SOUT")
def test_each_frame_has_its_pulse_right_before_it(settings: ModuleSettings) -> None:
    bench = HipnucUartBench(settings)
    bursts, edges = run(bench, 1000.0)
    wire_ns, found = 82 * 10 * NS_PER_S // settings.baud, pulses(edges, Pin.SOUT)[: len(bursts)]
    assert len(bursts) > 90
    for burst, (rise, fall) in zip(bursts, found, strict=True):
        assert (fall.due_ns, fall.due_ns - rise.due_ns) == (burst.due_ns - wire_ns, HIGH_NS)
        assert rise.sample_ns == fall.sample_ns == burst.sample_ns
        assert rise.due_ns >= (burst.sample_ns or 0)


def test_which_frames_have_a_pulse_and_how_long_it_is() -> None:
    bench = HipnucUartBench(ModuleSettings(baud=115_200, hi91=Output(1)))
    _, edges = run(bench, 1000.0)
    assert bench.module.frames_dropped > 800
    assert len(pulses(edges, Pin.SOUT)) == pytest.approx(bench.module.frames_sent, abs=6)  # frames in the buffer
    bench = HipnucUartBench(ModuleSettings(baud=921_600, hi91=Output(10), hi92=Output(10)))
    bursts, edges = run(bench, 1000.0)
    assert len(bursts) == pytest.approx(200, abs=2)
    for burst, (_, fall) in zip(bursts, pulses(edges, Pin.SOUT), strict=True):
        assert fall.due_ns == burst.due_ns - len(burst.data) * 10 * NS_PER_S // 921_600
    bench = HipnucUartBench()
    bench.ask("UNLOGALL")
    bench.module.pins(bench.now_ns)
    assert bench.ask("LOG VERSION")[-1] == "OK"
    assert bench.module.pins(bench.now_ns) == []
    _, edges = run(HipnucUartBench(hardware=HipnucHardware(processing_ns=30_000, skew_ppm=0)), 100.0)
    for rise, fall in pulses(edges, Pin.SOUT):
        assert (fall.due_ns - rise.due_ns, rise.due_ns) == (30_000, rise.sample_ns)


def test_edges_come_in_order_whatever_the_steps() -> None:
    settings = ModuleSettings(hi91=Output(5), hi92=Output(7), baud=921_600, alarm_x=AlarmSetting(-1, 1, True))
    whole, bench = run(HipnucUartBench(settings), 500.0)[1], HipnucUartBench(settings)
    steps = [edge for _ in range(2500) for edge in run(bench, 0.2)[1]]
    assert steps == whole
    assert all(after.due_ns >= before.due_ns for before, after in pairwise(whole))
    assert {edge.pin for edge in whole} == set(Pin)
    bench = HipnucUartBench(ModuleSettings(alarm_y=AlarmSetting(-3, 3, True)))
    edges: list[PinEdge] = []
    while bench.now_ns < BEGIN_NS + 1500 * NS_PER_MS:
        next_ns = bench.module.next_pin_ns()
        assert next_ns is not None
        assert next_ns > bench.now_ns
        bench.now_ns = next_ns
        found = bench.module.pins(next_ns)
        assert all(edge.due_ns == next_ns for edge in found)
        edges += found
    assert len(edges) > 200


@pytest.mark.parametrize("divider", [1, 8, 64])
@pytest.mark.manual("B 2.2.4 divider")
def test_every_nth_pulse_is_repeated(divider: int) -> None:
    bench = HipnucUartBench()
    assert bench.ask(sout_divider(divider).payload.decode().strip()) == ["OK"]
    bench.module.pins(bench.now_ns)
    _, edges = run(bench, 2000.0)
    sout = [rise.due_ns for rise, _ in pulses(edges, Pin.SOUT)]
    divided = [rise.due_ns for rise, _ in pulses(edges, Pin.SOUT_DIV)]
    assert len(divided) == pytest.approx(200 / divider, abs=1)
    assert set(divided) <= set(sout)
    assert {sout.index(after) - sout.index(before) for before, after in pairwise(divided)} == {divider}


@pytest.mark.manual("B 2.2.4 PMUX4 SOUT_DIV")
def test_dividers_and_pins_that_nobody_watches() -> None:
    bench = HipnucUartBench(hardware=HIPNUC_STILL)
    bench.wait(45.0)  # within eight pulses
    bench.module.pins(bench.now_ns)
    assert bench.ask("CONFIG PMUX4 DIV20", 0.5) == []
    rises = [rise.due_ns for rise, _ in pulses(run(bench, 1000.0)[1], Pin.SOUT_DIV)]
    assert rises[0] - bench.now_ns + 1000 * NS_PER_MS == pytest.approx(20 * 10 * NS_PER_MS, abs=10 * NS_PER_MS)
    _, edges = run(HipnucUartBench(), 1000.0)
    periods = [(b.due_ns - a.due_ns) / NS_PER_MS for (a, _), (b, _) in pairwise(pulses(edges, Pin.SOUT_DIV))]
    assert periods == pytest.approx([80.0] * len(periods), rel=1e-4)  # manual, PMUX4
    assert len(periods) >= 11
    bench = HipnucUartBench(FAST)
    bench.wait(10_000.0)
    assert len(bench.module.pins(bench.now_ns)) <= 8192


@pytest.mark.manual("B 2.2.4 alarm level")
def test_alarm_follows_the_angles() -> None:
    motion = swing()
    bench = HipnucUartBench(hardware=HipnucHardware(motion=motion, skew_ppm=0))
    assert bench.ask(alarm(AlarmAxis.Y, -5, 5, enabled=True).payload.decode().strip()) == ["OK"]
    edges = [edge for edge in run(bench, 20_000.0)[1] if edge.pin is Pin.ALARM]
    assert len(edges) > 4
    level = edges.pop(0).rising  # the angle was out of range before the alarm was set
    assert level
    for edge in edges:
        assert edge.rising is not level
        level, t_s = edge.rising, (edge.due_ns - BEGIN_NS) / NS_PER_S
        rolls = [degrees(motion.at(t_s - back_s).euler_rad[0]) for back_s in (0.0, 0.0101)]
        assert (abs(rolls[0]) > 5) is edge.rising
        assert (abs(rolls[1]) > 5) is not edge.rising  # the device checks the angle every 10 ms
    bench = HipnucUartBench(ModuleSettings(alarm_y=AlarmSetting(-1, 1, True)), HIPNUC_STILL)
    run(bench, 100.0)
    assert bench.ask("CONFIG PMUX5 Y,-1,1,0,0") == ["OK"]
    assert [edge.rising for edge in bench.module.pins(bench.now_ns) if edge.pin is Pin.ALARM] == [False]
    bench = HipnucUartBench(ModuleSettings(alarm_y=AlarmSetting(-1, 1, True)), HIPNUC_STILL)
    edges = run(bench, 105.0)[1]
    rise_ns = edges[-1].due_ns + 10 * NS_PER_MS  # without skew, SOUT falls every 10 ms: here it is high or rises soon
    bench.now_ns = rise_ns - 40_000
    bench.module.reboot(bench.now_ns)
    edges += bench.module.pins(bench.now_ns)
    for pin in Pin:
        levels = [edge.rising for edge in edges if edge.pin is pin]
        assert not levels or levels[-1] is False
    assert [edge.pin for edge in edges[-2:]] == [Pin.SOUT, Pin.ALARM]
    assert edges[-1].due_ns == edges[-2].due_ns == bench.now_ns
    assert all(edge.pin is not Pin.SOUT for edge in run(bench, 499.0)[1])  # still booting


@pytest.mark.parametrize(
    ("alarm_x", "alarm_y", "expected"),
    [
        (AlarmSetting(-5, 5, True), AlarmSetting(), True),  # X is pitch: 7°
        (AlarmSetting(-5, 5, False), AlarmSetting(), False),
        (AlarmSetting(-8, 8, True), AlarmSetting(-3, 3, True), False),  # Y is roll: 2°
        (AlarmSetting(-8, 8, True), AlarmSetting(2.5, 5, True), True),
        (AlarmSetting(8, 9, True), AlarmSetting(), True),  # below the range
    ],
)
def test_which_angle_alarms(alarm_x: AlarmSetting, alarm_y: AlarmSetting, expected: bool) -> None:
    hardware = HipnucHardware(motion=Still(radians(2), radians(7), 0.0))
    _, edges = run(HipnucUartBench(ModuleSettings(alarm_x=alarm_x, alarm_y=alarm_y), hardware), 100.0)
    assert [edge.rising for edge in edges if edge.pin is Pin.ALARM] == [True] * expected


@pytest.mark.manual("B 1.2.1 delay of the answer", "B 2.2.4 PMUX1 SIN")
def test_a_trigger_is_answered_125_us_later_on_average() -> None:
    bench = HipnucUartBench(ModuleSettings(baud=921_600, hi91=Output(on_mark=True)))
    delays, wire_ns = [], 82 * 10 * NS_PER_S // 921_600
    for _ in range(300):
        marked_ns = bench.now_ns
        bench.module.mark(marked_ns)
        (burst,), edges = run(bench, 10.0)
        (pulse,) = pulses(edges, Pin.SOUT)
        assert burst.sample_ns == pulse[0].sample_ns == marked_ns
        assert burst.due_ns - wire_ns == pulse[1].due_ns == pulse[0].due_ns + HIGH_NS
        delays.append(pulse[1].due_ns - marked_ns)
    assert sum(delays) / len(delays) == pytest.approx(125_000, abs=2000)
    assert 20_000 < max(delays) - min(delays) <= 30_000
    bench = HipnucUartBench(ModuleSettings(hi91=Output(10), hi92=Output(on_mark=True)), HIPNUC_STILL)
    bench.now_ns += 15 * NS_PER_MS
    bench.module.mark(bench.now_ns)
    assert [burst.sample_ns for burst in bench.wait(10.0)] == [BEGIN_NS + ms * NS_PER_MS for ms in (510, 515)]
    bench = HipnucUartBench(FAST, HIPNUC_STILL)
    bench.wait(0.7)
    bench.module.mark(bench.now_ns)
    frame = bench.frames(3.0)[-1]
    assert frame.word_1_2 == 1  # the sample is 2 ms later; minus 0.7: 0.3, 1.3, 2.3 …
    bench = HipnucUartBench(FAST, HIPNUC_STILL)
    bench.module.reboot(bench.now_ns)
    bench.wait(100.0)
    bench.module.mark(bench.now_ns)
    (frame, *_) = bench.frames(405.0)
    assert frame.word_1_2 == frame.system_time_ms


@pytest.mark.parametrize("message", ["HI81", "HI83"])
def test_ins_messages_contain_the_true_position_and_velocity(message: str) -> None:
    options = SimulatorOptions(rate_hz=10, message=message, noise="none", boot_ms=0)
    module = make(options, 0)
    bursts = [burst for burst in module.advance(3 * NS_PER_S) if burst.sample_ns is not None]
    codec = HipnucCodec(Ledger(), HipnucOptions())
    assert len(bursts) >= 28
    for burst in bursts:
        (m,) = codec.feed(burst.data)
        assert isinstance(m, Measurement)
        assert burst.sample_ns is not None
        truth = module.hardware.motion.at(burst.sample_ns / NS_PER_S)
        east_m, north_m, up_m = truth.position_enu_m
        assert m.position is not None
        assert m.gnss_utc_ns is not None
        assert (m.position.quality, m.position.satellites, (m.status or 0) >> 16) == (5, 21, 3)
        assert (m.position.latitude_rad - radians(48)) * 6_371_520 == pytest.approx(north_m, abs=0.012)
        assert (m.position.longitude_rad - radians(11)) * 6_371_520 * cos(radians(48)) == pytest.approx(
            east_m, abs=0.012
        )
        assert m.position.height_m == pytest.approx(520 + up_m, abs=0.001)
        assert m.velocity_enu_m_s == pytest.approx(truth.velocity_enu_m_s, abs=0.0051)
        assert m.euler_rad == pytest.approx(truth.euler_rad, abs=9e-5)
        assert m.heave_m == (None if message == "HI81" else pytest.approx(up_m, abs=1e-6))
        assert m.gnss_utc_ns == 1_800_000_000 * NS_PER_S + (burst.device_ms or 0) * NS_PER_MS
        assert m.dev_ticks == (None if message == "HI81" else burst.device_ms)
