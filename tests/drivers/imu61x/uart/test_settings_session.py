"""Request scripts with simulated devices in all variants: identity, status, settings, modes, saving, heading."""

from collections.abc import Callable
from dataclasses import replace
from math import radians

import pytest

from imud.contracts.command import Target
from imud.contracts.script import RequestScript, Silence
from imud.contracts.setting import words_of
from imud.drivers.imu61x.uart import commands
from imud.drivers.imu61x.uart import settings as session
from imud.drivers.imu61x.uart.codec import Parameter, Status
from imud.drivers.imu61x.uart.commands import BusMode, Command, OutputMode
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.sim.imu61x.uart import STATUS, Imu61xSettings
from tests.support.simulated_modules import done, every_variant, imu61x_bench, variant_bench

QUIET = Imu61xSettings(mode=OutputMode.COMMAND)


@every_variant
@pytest.mark.manual(
    "A 1.4 serial number", "A 1.5 parameter 21", "A 1.5 parameter 27", "A 1.5 parameter 30", "A 1.5 parameter 31",
    "A 1 stream mode", "A 1 command mode", "A 1.4 status members",
)  # fmt: skip
def test_identity_settings_and_modes(variant: str) -> None:
    far = variant_bench(variant)
    identity = far.run(session.identify())
    assert (identity.product, identity.serial_number) == ("IMU61x", "003200473133510D33383736")
    assert identity.firmware == "10203"
    assert identity.details == {"hardware_version": "2", "model_number": "614"}
    assert far.streams()
    assert far.module.flash == Imu61xSettings()

    far = variant_bench(
        variant, Imu61xSettings(rate_hz=50, filter_control=0x4B, i2c_address=0x1A, gyro_off_deg_s=(0.5, -0.25, 0.0))
    )
    assert words_of(far.run(session.SETTINGS.read(Target(None, 0), None))) == {
        "baud": "115200", "output_rate_hz": "50", "accel_filter": "10 Hz", "gyro_filter": "47 Hz", "second_bus": "spi",
        "i2c_address": "0x1a", "gyro_offset_deg_s": "0.5, -0.25, 0", "installation_angles_deg": "0, 0, 0",
    }  # fmt: skip
    assert far.streams()

    far = variant_bench(variant)
    far.run(session.stop_streaming(done=done(variant)))
    assert far.samples(1500) == []
    far.run(session.start_streaming(done=done(variant)))
    assert far.streams()

    far = variant_bench(variant, QUIET)
    assert far.run(session.identify()).serial_number
    assert far.module.settings.mode is OutputMode.COMMAND
    assert far.samples(1000) == []

    words = variant_bench(variant).run(session.device_status())
    head = {
        "serial_number": "003200473133510D33383736", "software_version": 10203, "hardware_version": 2,
        "model_number": 614,
    }  # fmt: skip
    rest = {
        "system_status_bits": "0x00000000", "cpu_load_raw": 120, "drop_rate_raw": 0, "i2c_master_raw": 0,
        "voltage_raw": 50, "user_config_fault_raw": 0, "calibration_fault_raw": 0, "imu_health_bits": "00" * 32,
    }  # fmt: skip
    assert words == (head if variant == "short status" else head | rest)


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        (Parameter.AHRS_RATE, 200), (Parameter.BUS_MODE, BusMode.I2C), (Parameter.I2C_ADDRESS, 0x1B),
        (Parameter.FILTER, 0xF0),
    ],
)  # fmt: skip
def test_a_parameter_is_set_and_not_saved(parameter: Parameter, value: int | BusMode) -> None:
    far = imu61x_bench()
    far.run(session.write_parameter(parameter, value))
    assert far.module.settings.value(parameter) == (value.value if isinstance(value, BusMode) else value)
    assert far.module.flash == Imu61xSettings()
    assert far.streams()


def test_modes_at_any_rate_words_of_unusual_values_and_questions_only() -> None:
    for rate_hz in (1, 400):
        far = imu61x_bench(Imu61xSettings(baud=921600, rate_hz=rate_hz))
        far.run(session.stop_streaming())
        assert far.samples(1500) == []
        far.run(session.start_streaming())
        assert far.samples(2500)
    words = session.status_words(replace(STATUS, system_status=0x8000_0001, imu_health=bytes([1]) + bytes(31)))
    assert (words["system_status_bits"], words["imu_health_bits"]) == ("0x80000001", "01" + "00" * 31)
    assert session.status_words(Status(1, 2, 3, (4, 5, 6)))["serial_number"] == "000000040000000500000006"
    values = {Parameter.BAUD: 9600.0, Parameter.FILTER: 300.0, Parameter.BUS_MODE: 7.0, Parameter.I2C_ADDRESS: -1.0}
    assert session.parameter_words(values) == {"baud": "9600", "filter": "300", "second_bus": "7", "i2c_address": "-1"}
    assert session.parameter_words({Parameter.FILTER: float("nan")}) == {"filter": "nan"}
    far = imu61x_bench()
    far.run(session.identify())
    far.run(session.SETTINGS.read(Target(None, 0), None))
    assert all(name in ("status", "sample") or name.startswith("read parameter") for name in far.asked)


@every_variant
@pytest.mark.parametrize("settings", [Imu61xSettings(), QUIET])
def test_one_sample_with_names_and_units(variant: str, settings: Imu61xSettings) -> None:
    far = variant_bench(variant, settings)
    words = far.run(session.sample_once())
    assert set(words) == {"timer_us", "accel_m_s2", "gyro_rad_s", "euler_rad", "temperature_c"}
    assert words["accel_m_s2"][2] == pytest.approx(9.8, abs=0.1)
    assert words["euler_rad"] == pytest.approx([radians(-3), radians(2), words["euler_rad"][2]], abs=0.01)
    assert bool(far.samples(2000)) is (settings is not QUIET)


@pytest.mark.manual("A 1.8 two hosts")
def test_refusals_and_silence_are_errors() -> None:
    far = imu61x_bench(QUIET, refuses=frozenset({Command.AHRS}))
    with pytest.raises(Rejected, match="AHRS once: expected a sample, got an acknowledgement with result 2"):
        far.run(session.sample_once())
    with pytest.raises(NoReply, match="AHRS once: expected a sample, got none"):
        imu61x_bench(QUIET, ignores=frozenset({Command.AHRS})).run(session.sample_once())

    far = imu61x_bench()
    far.connected = False
    with pytest.raises(NoReply, match="status: expected a reply, got none; check the transmit wire of the host"):
        far.run(session.identify())
    assert far.streams()

    far = imu61x_bench(QUIET)
    outcome = far.ask(commands.ask_ahrs())
    assert getattr(outcome, "sample", None) is not None

    far = imu61x_bench(changes_mode=False)
    with pytest.raises(Rejected, match="output mode COMMAND: expected no more samples, got one"):
        far.run(session.stop_streaming())
    silent = imu61x_bench(QUIET, changes_mode=False)
    with pytest.raises(NoReply, match="output mode STREAM: expected a sample within 3 s, got none"):
        silent.run(session.start_streaming())

    far = imu61x_bench(refuses=frozenset({Command.SET_PARAMETER}))
    words = "set parameter AHRS_RATE to 200: expected 200 after the write, got 100, acknowledged with result 2"
    with pytest.raises(Rejected, match=words):
        far.run(session.write_parameter(Parameter.AHRS_RATE, 200))


def test_streaming_is_started_again_when_the_answer_fails() -> None:
    """The device executes the command and its replies are lost: it must not stay silent."""
    far = imu61x_bench(answers_while_streaming=False)
    script = session.identify()
    request = next(script)
    with pytest.raises(NoReply):  # noqa: PT012  # the script is driven by hand
        while True:
            far.ask(request)
            request = script.send(Silence(()))
    assert far.asked[-1] == "output mode STREAM"
    assert far.streams()


ORDERS: dict[Command, Callable[[], RequestScript[object]]] = {
    Command.OUTPUT_MODE: session.stop_streaming,
    Command.SAVE: session.save,
    Command.HEADING: lambda: session.reset_heading(10),
}


@pytest.mark.parametrize("command", ORDERS)
@pytest.mark.manual("A 1.7 K1")
def test_a_refusal_is_an_error_that_names_the_option(command: Command) -> None:
    far = imu61x_bench(refuses=frozenset({command}))
    with pytest.raises(
        Rejected, match=r"expected result 0 \(done\), got 2: the device rejected the command or `options.result_done`"
    ):
        far.run(ORDERS[command]())
    assert far.streams()


@pytest.mark.parametrize("command", [Command.SAVE, Command.HEADING])
def test_an_order_without_an_acknowledgement_is_not_known_to_be_done(command: Command) -> None:
    far = imu61x_bench(acknowledges=False)
    with pytest.raises(NoReply, match="got none from a device that replies: it is not known whether"):
        far.run(ORDERS[command]())


@pytest.mark.parametrize(
    ("parameter", "value"),
    [(Parameter.BAUD, 115200), (Parameter.GYRO_X_OFF, 0), (Parameter.BUS_MODE, 1), (Parameter.AHRS_RATE, BusMode.SPI)],
)
def test_read_only_parameters_are_rejected_before_sending(parameter: Parameter, value: int | BusMode) -> None:
    far = imu61x_bench()
    with pytest.raises(BadArgument):
        far.run(session.write_parameter(parameter, value))
    assert far.asked == []


@every_variant
@pytest.mark.parametrize("heading_deg", [0.0, 359.0])
@pytest.mark.manual("A 1.6 CMD 4")
def test_heading_reset(variant: str, heading_deg: float) -> None:
    if variant == "no K1":
        return  # see above: it is not known whether it was executed
    far = variant_bench(variant)
    far.run(session.reset_heading(heading_deg, done=done(variant)))
    assert far.streams()
    euler = far.samples(100)[-1].euler_rad
    assert euler is not None
    assert (euler[2] - radians(heading_deg) + 3) % radians(360) == pytest.approx(3, abs=1e-5)
