"""The simulated device replies, saves and resets settings, and rotates its axes as in the manual (chapters 2, 8)."""

from math import radians

import pytest

from imud.attitude.rotation import matrix_from_quat
from imud.drivers.hipnuc.uart import commands
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings, Output
from imud.sim.physics import Still
from tests.support.simulated_modules import FAST, HIPNUC_STILL, HipnucUartBench

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


@pytest.mark.parametrize(
    "line",
    [
        "LOG VERSION\n", "LOG VERSION\r\n", "\xff\x80\x01LOG VERSION\r\n", "\r\n\r\nLOG VERSION\n",
        "LOG D\xffLOG VERSION\n",
    ],
)  # fmt: skip
@pytest.mark.manual("B 2 line end")
def test_line_ends_and_garbage_before_a_command(line: str) -> None:
    bench = HipnucUartBench()
    bench.module.receive(line.encode("latin-1"), bench.now_ns)
    assert bench.text(30.0) == VERSION


@pytest.mark.parametrize(
    "line", ["", "HELLO", "log version", "LOG", "LOG VERSIONS", "LOG HI93 ONTIME 1", "CONFIG ATT", "AT+RST", "X" * 5000]
)
def test_unknown_commands_get_no_reply(line: str) -> None:
    bench = HipnucUartBench()
    assert bench.ask(line) == []
    assert bench.ask("LOG VERSION") == VERSION
    assert bench.module.settings == ModuleSettings()


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


@pytest.mark.parametrize("line", ["CONFIG ATT RST 4", "CONFIG YAW 2 0", "CONFIG YAW 1 181", "CONFIG YAW 1 nan"])
def test_bad_values_are_refused(line: str) -> None:
    assert HipnucUartBench().ask(line) == ["ERR"]
