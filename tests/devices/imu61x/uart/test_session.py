"""Request scripts against simulated devices: one answers while it streams, one in command mode only."""

from collections.abc import Callable
from dataclasses import replace
from math import radians

import pytest

from imud.contracts.session import RequestScript, Silence
from imud.devices.imu61x.uart import commands, session
from imud.devices.imu61x.uart.commands import BusMode, OutputMode
from imud.devices.imu61x.uart.replies import Parameter
from imud.errors import BadArgument, NoReply, Rejected
from imud.sim.imu61x.settings import Imu61xSettings
from imud.sim.imu61x.uart import STATUS
from imud.sim.physics.motion import Still, swing
from imud.sim.physics.noise import Noise
from tests.support.simulated_modules import Imu61xBench, imu61x_bench

either_way = pytest.mark.parametrize("answers", [True, False])
QUIET = Imu61xSettings(mode=OutputMode.COMMAND)


def streams(far: Imu61xBench) -> bool:
    """Whether samples come at the rate of the line."""
    return len(far.samples(100)) >= 5


# --- who it is --------------------------------------------------------------------------------------------------------


@either_way
def test_identity_and_the_stream_goes_on(answers: bool) -> None:
    far = imu61x_bench(answers_while_streaming=answers)
    identity = far.run(session.identify())
    assert identity.product == "IMU61x"
    assert identity.serial_number == "003200473133510D33383736"
    assert identity.firmware == "10203"
    assert identity.details is not None
    assert identity.details["model"] == "614"
    assert "imu_health" not in identity.details
    assert streams(far)
    assert far.module.flash == Imu61xSettings()


def test_a_device_that_answers_as_it_is_is_sent_questions_only() -> None:
    far = imu61x_bench()
    far.run(session.identify())
    far.run(session.read_settings())
    assert all(name == "status" or name.startswith("read parameter") for name in far.asked)


def test_a_device_in_command_mode_stays_there() -> None:
    far = imu61x_bench(QUIET)
    assert far.run(session.identify()).serial_number
    assert far.module.settings.mode is OutputMode.COMMAND
    assert far.samples(1000) == []


def test_identity_from_the_shortest_status() -> None:
    short = replace(STATUS, system_status=None)
    identity = imu61x_bench(status=short).run(session.identify())
    assert identity.details == {"hardware_version": "2", "model": "614"}


def test_health_is_told_where_there_is_something_to_tell() -> None:
    details = session.identity_of(replace(STATUS, imu_health=bytes([1]) + bytes(31))).details
    assert details is not None
    assert details["imu_health"] == "01" + "00" * 31


def test_without_a_transmit_line_nothing_changes() -> None:
    far = imu61x_bench()
    far.connected = False
    with pytest.raises(NoReply, match="status: expected a reply, got nothing; is the host's transmit line connected"):
        far.run(session.identify())
    assert streams(far)


def test_streaming_is_started_again_when_the_answer_fails() -> None:
    """The device obeys and its answers are lost: it must not be left silent."""
    far = imu61x_bench(answers_while_streaming=False)
    script = session.identify()
    request = next(script)
    with pytest.raises(NoReply):  # noqa: PT012  # the script is driven by hand
        while True:
            far.ask(request)
            request = script.send(Silence(()))
    assert far.asked[-1] == "output mode STREAM"
    assert streams(far)


@either_way
def test_settings(answers: bool) -> None:
    far = imu61x_bench(
        Imu61xSettings(rate_hz=50, filter_control=0x4B, i2c_address=0x1A, gyro_off_deg_s=(0.5, -0.25, 0.0)),
        answers_while_streaming=answers,
    )
    assert far.run(session.read_settings()) == {
        "BAUD": "115200",
        "GYRO_X_OFF": "0.5",
        "GYRO_Y_OFF": "-0.25",
        "GYRO_Z_OFF": "0",
        "INSTALL_X_OFF": "0",
        "INSTALL_Y_OFF": "0",
        "INSTALL_Z_OFF": "0",
        "AHRS_RATE": "50",
        "BUS_MODE": "1",
        "I2C_ADDRESS": "0x1A",
        "FILTER": "0x4B",
    }
    assert streams(far)


# --- modes and restart ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("acknowledges", [True, False])
def test_stream_and_command_mode(acknowledges: bool) -> None:
    far = imu61x_bench(acknowledges=acknowledges)
    far.run(session.stop_streaming())
    assert far.samples(500) == []
    assert far.run(session.start_streaming()) is acknowledges
    assert streams(far)


@either_way
def test_restart_loses_what_was_not_saved(answers: bool) -> None:
    far = imu61x_bench(answers_while_streaming=answers)
    far.run(session.write_parameter(Parameter.AHRS_RATE, 10))
    assert far.module.settings.rate_hz == 10
    assert far.run(session.restart()).product == "IMU61x"
    assert far.module.settings == far.module.flash == Imu61xSettings()
    assert streams(far)


def test_a_device_that_does_not_come_back_is_no_reply() -> None:
    far = imu61x_bench(boot_ms=60_000)
    with pytest.raises(NoReply, match="status"):
        far.run(session.restart())


def test_saved_parameters_stay() -> None:
    far = imu61x_bench()
    far.run(session.write_parameter(Parameter.FILTER, 0x44))
    assert far.run(session.save()) is True
    far.restart()
    assert far.module.settings.filter_control == 0x44


# --- parameters -------------------------------------------------------------------------------------------------------


@either_way
@pytest.mark.parametrize(
    ("parameter", "value", "read"),
    [
        (Parameter.AHRS_RATE, 200, 200),
        (Parameter.BUS_MODE, BusMode.I2C, 2),
        (Parameter.I2C_ADDRESS, 0x1B, 0x1B),
        (Parameter.FILTER, 0xF0, 0xF0),
    ],
)
def test_a_parameter_is_set_and_read_back(answers: bool, parameter: Parameter, value: int, read: int) -> None:
    far = imu61x_bench(answers_while_streaming=answers)
    far.run(session.write_parameter(parameter, value))
    assert far.module.settings.value(parameter) == read
    assert far.module.flash == Imu61xSettings()
    assert streams(far)


def test_a_parameter_that_does_not_stick_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    far = imu61x_bench()
    monkeypatch.setattr("imud.sim.imu61x.uart.changed", lambda settings, index, value: settings)
    with pytest.raises(Rejected, match="set parameter AHRS_RATE to 200: reads back as 100"):
        far.run(session.write_parameter(Parameter.AHRS_RATE, 200))


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        (Parameter.BAUD, 115200),
        (Parameter.GYRO_X_OFF, 0),
        (Parameter.BUS_MODE, 1),
        (Parameter.AHRS_RATE, BusMode.SPI),
    ],
)
def test_what_cannot_be_set_is_refused_before_anything_is_sent(parameter: Parameter, value: int | BusMode) -> None:
    far = imu61x_bench()
    with pytest.raises(BadArgument):
        far.run(session.write_parameter(parameter, value))
    assert far.asked == []


# --- calibrations -----------------------------------------------------------------------------------------------------


@either_way
def test_gyro_calibration_takes_the_bias_off(answers: bool) -> None:
    far = imu61x_bench(answers_while_streaming=answers, noise=Noise(3))
    before = far.samples(2000)
    offsets_deg_s = far.run(session.calibrate_gyro())
    after = far.samples(2000)
    assert any(abs(offset) > 1e-3 for offset in offsets_deg_s)
    for axis in range(3):
        means = [sum(m.gyro_rad_s[axis] for m in part if m.gyro_rad_s) / len(part) for part in (before, after)]
        assert means[0] - means[1] == pytest.approx(radians(offsets_deg_s[axis]), abs=1.5e-4)
        assert abs(means[1]) < 1.5e-4


def test_gyro_calibration_of_a_moving_device_is_refused() -> None:
    far = imu61x_bench(motion=swing())
    with pytest.raises(Rejected, match=r"gyro calibration: expected result 0 \(done\), got 1"):
        far.run(session.calibrate_gyro())


def test_what_counts_as_done_can_be_told() -> None:
    far = imu61x_bench(motion=swing())
    assert far.run(session.calibrate_gyro(done=1)) == (0, 0, 0)
    with pytest.raises(Rejected):
        far.run(session.reset_heading(10, done=1))


@either_way
def test_installation_calibration_ends_with_the_angles(answers: bool) -> None:
    tilted = Still(radians(4), radians(0), radians(0))  # 312: roll about Y, which is pitch in ZYX
    far = imu61x_bench(answers_while_streaming=answers, motion=tilted)
    assert far.run(session.installation_status()) == 0
    begun_ns = far.now_ns
    assert far.run(session.calibrate_installation()) == pytest.approx((0, 4, 0), abs=1e-5)
    assert 3e9 <= far.now_ns - begun_ns < 6e9
    assert streams(far)


def test_installation_calibration_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.sim.imu61x.uart.CALIBRATION_NS", 10**15)
    far = imu61x_bench(QUIET)
    with pytest.raises(NoReply, match="expected status 0 within 60 s, got 1"):
        far.run(session.calibrate_installation())


@either_way
@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 180.0, 359.0])
def test_heading_reset(answers: bool, heading_deg: float) -> None:
    far = imu61x_bench(answers_while_streaming=answers)
    far.run(session.reset_heading(heading_deg))
    euler = far.samples(100)[-1].euler_rad
    assert euler is not None
    assert (euler[2] - radians(heading_deg) + 3) % radians(360) == pytest.approx(3, abs=1e-5)


# --- baud rate and factory reset --------------------------------------------------------------------------------------


@either_way
@pytest.mark.parametrize("at_start", [False, True])
@pytest.mark.parametrize("acknowledges", [True, False])
@pytest.mark.parametrize(("baud", "present"), [(921600, 115200), (115200, 1500000), (460800, 460800)])
def test_the_baud_rate_changes_and_the_device_is_kept(
    answers: bool, at_start: bool, acknowledges: bool, baud: int, present: int
) -> None:
    settings = Imu61xSettings(baud=present)
    far = imu61x_bench(
        settings, answers_while_streaming=answers, baud_acts_at_start=at_start, acknowledges=acknowledges
    )
    change = far.run(session.change_baud(baud, present))
    assert change.baud == baud == far.line_baud == far.module.baud
    assert far.module.flash.baud == baud
    assert far.module.flash.mode is OutputMode.STREAM
    assert streams(far)
    far.restart()
    assert streams(far)


def test_the_line_comes_back_when_the_device_keeps_its_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    far = imu61x_bench()
    monkeypatch.setattr("imud.sim.imu61x.uart.changed", lambda settings, index, value: settings)
    with pytest.raises(Rejected, match="stays at 115200 baud"):
        far.run(session.change_baud(921600, 115200))
    assert far.line_baud == 115200
    assert streams(far)


def test_a_device_that_is_lost_was_not_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes a third rate, by some fault of its own: power off and on brings it back."""
    far = imu61x_bench()
    wrong = lambda settings, index, value: replace(settings, baud=1500000)  # noqa: E731
    monkeypatch.setattr("imud.sim.imu61x.uart.changed", wrong)
    with pytest.raises(NoReply, match="switch its power off and on: nothing was saved"):
        far.run(session.change_baud(460800, 115200))
    assert far.line_baud == 115200
    far.restart()
    assert streams(far)


@pytest.mark.parametrize("change", [lambda: session.change_baud(921600, 115200), lambda: session.factory_reset(115200)])
def test_nothing_is_changed_without_contact(change: Callable[[], RequestScript[object]]) -> None:
    far = imu61x_bench()
    far.connected = False
    with pytest.raises(NoReply, match="nothing was changed"):
        far.run(change())
    assert far.line_baud == 115200
    assert "factory reset" not in far.asked
    assert not any(name.startswith("set parameter") for name in far.asked)
    assert streams(far)


@either_way
@pytest.mark.parametrize("at_start", [False, True])
@pytest.mark.parametrize("present", [115200, 921600])
def test_factory_reset_and_the_line_follows(answers: bool, at_start: bool, present: int) -> None:
    settings = Imu61xSettings(baud=present, rate_hz=400, filter_control=0)
    far = imu61x_bench(settings, answers_while_streaming=answers, baud_acts_at_start=at_start)
    change = far.run(session.factory_reset(present))
    assert change.baud == far.line_baud == far.module.baud == 115200
    assert far.module.flash == Imu61xSettings()
    assert streams(far)


def test_orders_outside_scripts_are_obeyed_too() -> None:
    far = imu61x_bench(QUIET)
    assert far.ask(commands.ask_ahrs())
    assert len(far.samples(50)) == 1
