"""The simulated IMU61x compared with the manual: modes, rates, RAM and flash, restart, calibration, wire time."""

import struct
from dataclasses import replace
from itertools import pairwise
from math import pi

import pytest

from imud.attitude.rotation import matrix_from_quat
from imud.contracts.script import Reply, ReplyFrame, Request
from imud.drivers.imu61x.uart import codec
from imud.drivers.imu61x.uart import commands as c
from imud.drivers.imu61x.uart.codec import Acknowledgement, Parameter, parse_acknowledgement
from imud.drivers.imu61x.uart.raw import RawCodec
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_S
from imud.sim import SIMULATORS
from imud.sim.imu61x.uart import RAW_LAYOUT, Imu61xModule, Imu61xSettings, ParameterRefused, changed, make
from imud.sim.physics import Noise, swing
from imud.sim.sensor import SimulatorOptions
from tests.support.simulated_modules import BEGIN_NS, IMU61X_STILL, Imu61xBench, imu61x_bench


def acknowledged(far: Imu61xBench, request: Request) -> int:
    outcome = far.ask(request)
    assert isinstance(outcome, Reply)
    reply = parse_acknowledgement(outcome.messages[-1])
    assert isinstance(reply, Acknowledgement)
    return reply.result


def parameter(far: Imu61xBench, which: Parameter) -> float:
    outcome = far.ask(c.read_parameter(which))
    assert isinstance(outcome, Reply)
    value = codec.parse_parameter(outcome.messages[-1])
    assert isinstance(value, codec.ParameterValue)
    return value.value


def test_the_frame_on_the_wire_by_the_offsets_of_table_4() -> None:
    """Decode the frame without the codec: 312 roll 2° about Y, pitch -3° about X, yaw 40° at rest."""
    module = Imu61xModule(BEGIN_NS, hardware=IMU61X_STILL)
    (burst,) = module.advance(BEGIN_NS + 517_000_000)
    data = burst.data
    assert data[:6] == bytes.fromhex("AA5502002C00")
    timer, pitch, roll, yaw, ax, ay, az, gx, gy, gz, temp = struct.unpack("<I10f", data[6:-4])
    assert (timer, burst.device_ms) == (510_000, 510)
    assert (roll, pitch, yaw) == pytest.approx((-2.998, 2.003, 39.895), abs=0.01)
    assert ((ax**2 + ay**2 + az**2) ** 0.5, (gx, gy, gz)) == (pytest.approx(9.8 / 9.80665, abs=1e-6), (0, 0, 0))
    assert 30 < temp < 40
    hardware = replace(IMU61X_STILL, motion=swing())
    far = Imu61xBench(hardware=hardware)
    assert far.samples(40)
    for burst in far.module.advance(far.now_ns + 3 * NS_PER_S):
        assert burst.sample_ns is not None
        truth = swing().at((burst.sample_ns - BEGIN_NS) / NS_PER_S)
        (sample,) = (event for event in far.codec.feed(burst.data) if not isinstance(event, ReplyFrame))
        for name in ("accel_m_s2", "gyro_rad_s"):
            assert getattr(sample, name) == pytest.approx(getattr(truth, name), abs=2e-6)
        quat = getattr(sample, "quat_wxyz", None)
        assert quat is not None
        for row, wanted in zip(matrix_from_quat(quat), matrix_from_quat(truth.quat_wxyz), strict=True):
            assert row == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("rate_hz", c.RATES_HZ)
@pytest.mark.manual("A 1 stream mode", "A 1.6 CMD 14, 21")
def test_it_streams_at_every_rate_of_the_manual(rate_hz: int) -> None:
    far = imu61x_bench(Imu61xSettings(baud=230400, rate_hz=rate_hz))
    far.wait(1000 - far.module.hardware.boot_ms)
    samples = far.samples(2000)
    assert len(samples) == pytest.approx(2 * rate_hz, abs=1)
    ticks = [sample.dev_ticks for sample in samples]
    assert {b - a for a, b in pairwise(ticks) if a is not None and b is not None} == {1_000_000 // rate_hz}
    assert far.module.frames_dropped == 0


@pytest.mark.manual("A 1 command mode")
def test_command_mode_is_silent_but_for_replies() -> None:
    far = imu61x_bench()
    assert acknowledged(far, c.output_mode(c.OutputMode.COMMAND)) == 0
    far.wait(20)
    assert far.wait(2000) == []
    outcome = far.ask(c.ask_status())
    assert isinstance(outcome, Reply)
    assert codec.parse_status(outcome.messages[-1]) == far.module.hardware.status
    assert parameter(far, Parameter.AHRS_RATE) == 100
    outcome = far.ask(c.ask_ahrs())
    assert isinstance(outcome, Reply)
    assert outcome.sample is not None
    assert far.samples(500) == []
    assert acknowledged(far, c.output_mode(c.OutputMode.STREAM)) == 0
    assert len(far.samples(1000)) in (99, 100)


@pytest.mark.manual("A 1.3 timer")
def test_listening_in_command_mode_the_full_wire_and_the_timer() -> None:
    """Table 3 note 1: at most 200 Hz at 115200 baud. The serial port can transfer 213 frames per second."""
    far = imu61x_bench(answers_while_streaming=False)
    far.send(c.ask_status().payload + c.factory_reset().payload)
    assert not any(isinstance(event, ReplyFrame) for event in far.wait(500))
    far = imu61x_bench(Imu61xSettings(rate_hz=400))
    assert len(far.samples(2000)) == pytest.approx(2 * 213, abs=4)
    assert far.module.frames_dropped > 300
    far = imu61x_bench(skew_ppm=1000.0, uptime_us=2**32 - 600_000)
    samples = far.samples(400)
    ticks = [sample.dev_ticks or 0 for sample in samples]
    assert any(b < a for a, b in pairwise(ticks))
    begin_ns = far.now_ns
    assert len(far.samples(10_000)) == pytest.approx(1001, abs=1)
    assert far.now_ns - begin_ns == 10 * NS_PER_S


def test_what_power_off_restart_and_factory_reset_change_and_cut() -> None:
    far = imu61x_bench()
    assert acknowledged(far, c.set_rate(50)) == 0
    far.restart()
    assert far.module.settings.rate_hz == 100
    acknowledged(far, c.set_rate(50))
    assert acknowledged(far, c.save()) == 0
    far.restart()
    assert parameter(far, Parameter.AHRS_RATE) == 50
    far = imu61x_bench()
    acknowledged(far, c.output_mode(c.OutputMode.COMMAND))
    acknowledged(far, c.save())
    far.restart()
    assert far.samples(1000) == []
    far = imu61x_bench()
    assert acknowledged(far, c.restart()) == 0
    assert far.wait(far.module.hardware.boot_ms - 20) == []
    samples = far.samples(200)
    assert len(samples) >= 15
    assert samples[0].dev_ticks is not None
    assert samples[0].dev_ticks <= 520_000
    far = imu61x_bench(Imu61xSettings(rate_hz=50), reset_acts_at_start=True)
    assert acknowledged(far, c.factory_reset()) == 0
    assert (far.module.settings.rate_hz, far.module.flash.rate_hz) == (50, 100)
    far.restart()
    assert far.module.settings.rate_hz == 100
    module, now_ns = Imu61xModule(BEGIN_NS, hardware=IMU61X_STILL), BEGIN_NS + 512_000_000
    assert module.advance(now_ns) == []
    module.reboot(now_ns)
    assert module.next_ns() == now_ns
    cut = b"".join(burst.data for burst in module.advance(now_ns))
    assert 0 < len(cut) < 54
    assert cut == bytes.fromhex("AA5502002C00")[: len(cut)] or cut.startswith(bytes.fromhex("AA5502002C00"))


def test_commands_at_another_rate_or_damaged() -> None:
    far = imu61x_bench(Imu61xSettings(mode=c.OutputMode.COMMAND))
    assert acknowledged(far, c.set_baud(921600)) == 0
    far.wait(10)
    assert far.module.baud == 921600
    far.baud = 921600
    assert parameter(far, Parameter.BAUD) == 921600
    far = imu61x_bench(Imu61xSettings(mode=c.OutputMode.COMMAND))
    far.baud = 460800
    far.send(c.factory_reset().payload)
    far.baud = 115200
    assert far.wait(100) == []
    far, damaged = imu61x_bench(Imu61xSettings(mode=c.OutputMode.COMMAND)), bytearray(c.ask_status().payload)
    damaged[12] ^= 1
    far.send(bytes(damaged))
    assert far.wait(100) == []
    whole = c.ask_status().payload
    far.send(whole[:10])
    far.send(whole[10:])
    assert len(far.wait(100)) == 1
    settings = Imu61xSettings(baud=921600, rate_hz=400)
    assert changed(settings, 3, 9600.0).baud == 115200
    assert changed(settings, 21, 77.0).rate_hz == 100
    for index, value in ((27, 4.0), (30, 0x1C), (31, 256.0), (31, 0.5), (8, 0.0), (99, 1.0), (27, float("nan"))):
        with pytest.raises(ParameterRefused):
            changed(settings, index, value)
    valid = {27: (0, 1, 2, 3), 30: (0x18, 0x19, 0x1A, 0x1B), 31: (0, 0x44, 0xFF)}  # table 12
    for index, values in valid.items():
        assert [changed(settings, index, float(value)).value(index) for value in values] == list(values)
    for which in Parameter:
        Imu61xSettings().value(which)
    with pytest.raises(ParameterRefused):
        Imu61xSettings().value(4)
    far = imu61x_bench(Imu61xSettings(mode=c.OutputMode.COMMAND))
    far.send(c.encode_command(c.Command.READ_PARAMETER, 0.0, 4))
    (reply,) = far.wait(50)
    assert isinstance(reply, ReplyFrame)
    assert parse_acknowledgement(reply) == Acknowledgement(6, 2)
    for unknown_mode in (2.0, 0.0, float("nan")):
        far.send(c.encode_command(c.Command.OUTPUT_MODE, unknown_mode))
        (reply,) = far.wait(50)
        assert isinstance(reply, ReplyFrame)
        assert parse_acknowledgement(reply) == Acknowledgement(3, 2)


def heard(far: Imu61xBench, request: Request, duration_ms: float) -> list[tuple[float, int]]:
    """Send a request without waiting. Return the times (ms) and the results of its acknowledgements."""
    far.send(request.payload)
    begun_ns, found = far.now_ns, []
    while far.now_ns < begun_ns + duration_ms * 1e6:
        for event in far.wait(2):
            reply = parse_acknowledgement(event) if isinstance(event, ReplyFrame) else None
            if reply is not None:
                found.append(((far.now_ns - begun_ns) / 1e6, reply.result))
    return found


def test_behaviour_of_the_variants() -> None:
    far = imu61x_bench(flash_ms=2000)
    far.send(c.save().payload)
    assert len(far.samples(1990)) <= 1  # the frame that the device already sent
    ((at_ms, result),) = heard(far, c.ask_status(), 100)
    assert (at_ms < 30, result) == (True, 0)  # the device did not receive the status request
    assert len(far.samples(500)) >= 48
    far = imu61x_bench(quiet_ms=700)
    ((at_ms, _),) = heard(far, c.reset_heading(0), 20)
    assert at_ms < 10
    far.send(c.ask_status().payload)
    assert [event for event in far.wait(650) if not isinstance(event, Measurement)] == []
    assert far.samples(200)
    for at_end, expected_ms in ((False, 0), (True, 3000)):
        far = imu61x_bench(acknowledges_at_end=at_end)
        ((at_ms, result),) = heard(far, c.calibrate_gyro(), 3500)
        assert at_ms == pytest.approx(expected_ms, abs=20)
        assert result == 0
    far = imu61x_bench(result_done=1, result_refused=0, refuses=frozenset({c.Command.SAVE}))
    assert [result for _, result in heard(far, c.reset_heading(0), 20)] == [1]
    assert [result for _, result in heard(far, c.save(), 20)] == [0]
    far = imu61x_bench(ignores=frozenset({c.Command.SAVE}))
    assert heard(far, c.save(), 20) == []


def test_installation_calibration_takes_its_time() -> None:
    far = imu61x_bench()
    assert acknowledged(far, c.ask_installation_status()) == 0
    assert acknowledged(far, c.start_installation_calibration()) == 0
    assert acknowledged(far, c.ask_installation_status()) == 9
    assert parameter(far, Parameter.INSTALL_X_OFF) == 0
    far.wait(3000)
    assert acknowledged(far, c.ask_installation_status()) == 0
    assert parameter(far, Parameter.INSTALL_X_OFF) == pytest.approx(-2.998, abs=0.01)
    far = imu61x_bench()
    assert acknowledged(far, c.reset_heading(270)) == 0
    euler = far.samples(50)[-1].euler_rad
    assert euler is not None
    assert euler[2] == pytest.approx(-pi / 2, abs=1e-5)
    far.restart()
    euler = far.samples(50)[-1].euler_rad
    assert euler is not None
    assert euler[2] == pytest.approx(0.6963, abs=1e-3)


def test_the_row_makes_it_from_common_options_and_refuses_others() -> None:
    module = SIMULATORS["imu61x-uart"].make(SimulatorOptions(rate_hz=400, noise="none", firmware=7), BEGIN_NS)
    assert module.baud == 230400
    assert isinstance(module, Imu61xModule)
    assert module.hardware.status.software_version == 7
    noisy = make(SimulatorOptions(baud=1500000), BEGIN_NS)
    assert noisy.baud == 1500000
    assert isinstance(noisy.hardware.noise, Noise)
    assert make(SimulatorOptions(rate_hz=200), BEGIN_NS).baud == 115200
    for options, named in (
        (SimulatorOptions(rate_hz=99), "rate 99 Hz: expected one of 1, 10"), (SimulatorOptions(baud=9600), "baud 9600"),
        (SimulatorOptions(message="HI91"), "or RAW"), (SimulatorOptions(motion="fly"), "motion 'fly'"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=named):
            make(options, BEGIN_NS)


def test_ahrs_frames_of_newer_models_contain_the_true_magnetic_field() -> None:
    module = make(SimulatorOptions(message="ahrs9", rate_hz=100, noise="none", boot_ms=0), BEGIN_NS)
    decoder = codec.Imu61xCodec(Ledger())
    bursts = [burst for burst in module.advance(BEGIN_NS + NS_PER_S // 2) if burst.sample_ns is not None]
    assert len(bursts) >= 45
    for burst in bursts:
        (m,) = decoder.feed(burst.data)
        assert isinstance(m, Measurement)
        assert burst.sample_ns is not None
        truth = module.hardware.motion.at((burst.sample_ns - BEGIN_NS) / NS_PER_S)
        assert m.size_bytes == 66
        assert m.mag_t == pytest.approx(truth.mag_t, rel=1e-6)


def test_raw_frames_contain_the_truth_in_their_layout() -> None:
    module = make(SimulatorOptions(message="raw", rate_hz=100, noise="none", boot_ms=0), BEGIN_NS)
    decoder = RawCodec(Ledger(), RAW_LAYOUT)
    bursts = [burst for burst in module.advance(BEGIN_NS + NS_PER_S // 2) if burst.sample_ns is not None]
    assert len(bursts) >= 45
    for burst in bursts:
        (m,) = decoder.feed(burst.data)
        assert isinstance(m, Measurement)
        assert burst.sample_ns is not None
        truth = module.hardware.motion.at((burst.sample_ns - BEGIN_NS) / NS_PER_S)
        assert m.size_bytes == 38
        assert m.dev_ticks == pytest.approx((burst.sample_ns - BEGIN_NS) / 1000, abs=20)
        assert m.accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=1e-5)
        assert m.gyro_rad_s == pytest.approx(truth.gyro_rad_s, abs=1e-6)
