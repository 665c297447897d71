"""Settings of an IMU61x on a UART, with simulated devices in all variants."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from math import radians
from typing import Any

import msgspec
import pytest

from imud.contracts.command import Target
from imud.contracts.script import Outcome, Request, RequestScript, Silence
from imud.contracts.setting import combined
from imud.drivers.imu61x.uart import commands
from imud.drivers.imu61x.uart import settings as session
from imud.drivers.imu61x.uart.codec import Parameter, Status
from imud.drivers.imu61x.uart.commands import BusMode, Command, Imu61xUartOptions, OutputMode
from imud.drivers.imu61x.uart.settings import SETTINGS, settings_of
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.sim.imu61x.uart import REFUSING, STATUS, Imu61xSettings
from tests.support.simulated_modules import Imu61xBench, done, every_variant, imu61x_bench, run_script, variant_bench

FACTORY = {
    "output_rate_hz": 100, "accel_filter": "47 Hz", "gyro_filter": "47 Hz", "second_bus": "spi", "i2c_address": "0x18",
    "gyro_offset_deg_s": [0.0, 0.0, 0.0], "installation_angles_deg": [0.0, 0.0, 0.0], "output_mode": "stream",
    "baud": 115200,
}  # fmt: skip


def target(far: Imu61xBench, variant: str = "executes commands while it streams") -> Target:
    return Target(Imu61xUartOptions(result_done=done(variant)), far.baud)


def read(far: Imu61xBench, variant: str = "executes commands while it streams") -> dict[str, Any]:
    return dict(combined(far.run(SETTINGS.read(target(far, variant), None))).values)


def write(far: Imu61xBench, name: str, value: object, variant: str = "executes commands while it streams") -> None:
    one = SETTINGS.table[name]
    assert one.write is not None
    far.run(one.write(target(far, variant), msgspec.convert(value, one.type)))


@every_variant
def test_settings_are_read_in_the_types_of_the_table(variant: str) -> None:
    found = read(variant_bench(variant), variant)
    assert found == FACTORY
    for name, value in found.items():
        assert msgspec.convert(msgspec.to_builtins(value), SETTINGS.table[name].type) == value
    assert set(found) == set(SETTINGS.table)


@pytest.mark.parametrize(("lost", "missing"), [(1, set()), (2, {"i2c_address"})])
def test_a_parameter_is_missing_after_two_requests_without_a_reply(lost: int, missing: set[str]) -> None:
    far, asked = imu61x_bench(), Counter[str]()

    def ask(request: Request) -> Outcome:
        asked[request.name] += 1
        is_lost = request.name == "read parameter I2C_ADDRESS" and asked[request.name] <= lost
        return Silence(()) if is_lost else far.ask(request)

    reports = run_script(SETTINGS.read(target(far), None), ask)
    assert combined(reports).values.keys() == FACTORY.keys() - missing
    assert asked["read parameter I2C_ADDRESS"] == 2


@every_variant
@pytest.mark.manual("A 1.6 CMD 14, 21", "A 1.6 CMD 14, 27", "A 1.6 CMD 14, 30", "A 1.6 CMD 14, 31")
@pytest.mark.parametrize(
    ("name", "value", "shown"),
    [
        ("output_rate_hz", 200, 200), ("accel_filter", "10 Hz", "10 Hz"), ("gyro_filter", 13, "average 16"),
        ("second_bus", "by_pin", "by_pin"), ("second_bus", "i2c", "i2c"), ("i2c_address", "0x1B", "0x1b"),
        ("i2c_address", 0x1A, "0x1a"), ("output_mode", "command", "command"), ("baud", 460800, 460800),
    ],
)  # fmt: skip
def test_each_setting_is_written_and_reads_back(variant: str, name: str, value: object, shown: object) -> None:
    far = variant_bench(variant)
    write(far, name, value, variant)
    found = read(far, variant)
    assert found == FACTORY | {name: shown}
    acts_at_start = name == "baud" and far.module.hardware.behaviour.baud_acts_at_start
    assert (far.module.flash == Imu61xSettings()) is not acts_at_start
    assert SETTINGS.table[name].agrees(value, found[name])
    assert not SETTINGS.table[name].agrees(value, FACTORY[name])


@every_variant
@pytest.mark.manual("A 1.6 CMD 5")
def test_saved_settings_survive_a_restart(variant: str) -> None:
    far = variant_bench(variant, uptime_us=20_000_000)
    assert SETTINGS.save is not None
    assert SETTINGS.restart is not None
    changed = {"output_rate_hz": 200, "accel_filter": "10 Hz", "gyro_filter": "5 Hz", "i2c_address": "0x19"}
    for name, value in changed.items():
        write(far, name, value, variant)
    if variant == "no K1":
        with pytest.raises(NoReply, match="it is not known whether the device executed the command"):
            far.run(SETTINGS.save(target(far, variant)))
    else:
        far.run(SETTINGS.save(target(far, variant)))
    far.run(SETTINGS.restart(target(far, variant)))
    assert read(far, variant) == FACTORY | changed


def test_combinations_and_declarations() -> None:
    present = Target(None, 115200)
    SETTINGS.check(present, {"output_rate_hz": 200})
    SETTINGS.check(present, {"output_rate_hz": 400, "baud": 230400})
    SETTINGS.check(Target(None, 0), {"output_rate_hz": 400})
    words = "output_rate_hz and baud: expected at most 200 Hz at 115200 baud, got 400 Hz.*400 Hz need 230400 baud"
    for values in ({"output_rate_hz": 400}, {"output_rate_hz": 400, "baud": 115200}):
        with pytest.raises(BadArgument, match=words):
            SETTINGS.check(present, values)

    declared = msgspec.convert({"output_rate_hz": 50, "i2c_address": "0x19"}, SETTINGS.declarable)
    assert getattr(declared, "output_rate_hz") == 50  # noqa: B009  # a field that is made at run time
    for wrong in ({"gyro_offset_deg_s": [0, 0, 0]}, {"output_rate_hz": 33}, {"i2c_address": "0x1c"}, {"baud": 9600}):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(wrong, SETTINGS.declarable)

    assert [name for name, one in SETTINGS.table.items() if one.connection] == [list(SETTINGS.table)[-1]] == ["baud"]

    assert "change `i2c.address`" in SETTINGS.table["i2c_address"].note
    assert "a host on the previous bus loses the device" in SETTINGS.table["second_bus"].note
    told = {Parameter.FILTER: 300.0, Parameter.BUS_MODE: 7.0, Parameter.I2C_ADDRESS: 0.5, Parameter.AHRS_RATE: 33.0}
    assert settings_of(told) == {"output_rate_hz": 33}
    assert settings_of({Parameter.BAUD: float("nan")}) == {}

    far = imu61x_bench(Imu61xSettings(mode=OutputMode.COMMAND))
    assert read(far)["output_mode"] == "command"
    assert far.module.settings.mode is OutputMode.COMMAND


@every_variant
@pytest.mark.manual("A 1.6 CMD 9")
def test_restart_loses_unsaved_settings_and_restarts_the_timer(variant: str) -> None:
    far = variant_bench(variant, uptime_us=20_000_000)
    far.run(session.write_parameter(Parameter.AHRS_RATE, 10))
    assert far.module.settings.rate_hz == 10
    assert far.run(session.restart(done=done(variant))).product == "IMU61x"
    assert far.module.settings == far.module.flash == Imu61xSettings()
    assert far.streams()


@every_variant
def test_a_restart_that_did_not_happen_is_an_error(variant: str) -> None:
    """The device acknowledges or not, and its timer continues."""
    far = variant_bench(variant, uptime_us=20_000_000)
    behaviour = replace(far.module.hardware.behaviour, ignores=frozenset({Command.RESTART}))
    far = imu61x_bench(behaviour=behaviour, uptime_us=20_000_000)
    with pytest.raises(Rejected, match=r"expected a restarted timer, got 2\d\.\d s before and 2\d\.\d s after"):
        far.run(session.restart(done=done(variant)))


def test_restarts_that_are_refused_seen_or_without_end() -> None:
    far = imu61x_bench(behaviour=REFUSING, uptime_us=20_000_000)
    with pytest.raises(Rejected, match=r"and acknowledgement 2 \(0 is done\)"):
        far.run(session.restart())
    far = imu61x_bench(result_done=1, uptime_us=20_000_000)
    assert far.run(session.restart()).product == "IMU61x"
    far = imu61x_bench(uptime_us=20_000_000)
    far.module.hardware = replace(far.module.hardware, boot_ms=60_000)
    with pytest.raises(NoReply, match="status"):
        far.run(session.restart())


@pytest.mark.parametrize("uptime_us", [0, 2**32 - 5_000_000, 2**32 - 25_000_000])
def test_a_young_timer_and_one_that_turns_over_soon_are_waited_for(uptime_us: int) -> None:
    """0.5 s after power-on, a restarted timer would be larger; near its end the timer wraps by itself."""
    far = imu61x_bench(uptime_us=uptime_us)
    begun_ns = far.now_ns
    assert far.run(session.restart()).product == "IMU61x"
    assert far.now_ns - begun_ns < 60e9
    still = imu61x_bench(uptime_us=uptime_us, ignores=frozenset({Command.RESTART}))
    with pytest.raises(Rejected, match="restarted timer"):
        still.run(session.restart())


@every_variant
@pytest.mark.parametrize(("baud", "present"), [(921600, 115200), (115200, 1500000)])
@pytest.mark.manual("A 1.6 CMD 14, 3")
def test_the_baud_rate_changes_and_the_device_is_kept(variant: str, baud: int, present: int) -> None:
    far = variant_bench(variant, Imu61xSettings(baud=present))
    change = far.run(session.change_baud(baud, present, done=done(variant)))
    assert change.baud == baud == far.baud == far.module.baud
    at_start = far.module.hardware.behaviour.baud_acts_at_start
    assert change.saved is at_start
    assert far.module.flash.baud == (baud if at_start else present)
    assert far.module.flash.mode is OutputMode.STREAM
    assert far.streams()


def test_rates_that_are_refused_not_saved_or_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lost device uses a third baud rate because of a fault: power-off and power-on restore it."""
    far = imu61x_bench(refuses=frozenset({Command.SET_PARAMETER}))
    with pytest.raises(Rejected, match="keeps 115200 baud"):
        far.run(session.change_baud(921600, 115200))
    assert far.baud == 115200
    assert far.streams()

    far = imu61x_bench()
    wrong = lambda settings, index, value: replace(settings, baud=1500000)  # noqa: E731
    monkeypatch.setattr("imud.sim.imu61x.uart.changed", wrong)
    with pytest.raises(NoReply, match="nothing was saved: switch the device off and on"):
        far.run(session.change_baud(460800, 115200))
    assert far.baud == 115200
    far.restart()
    assert far.streams()


def test_nothing_changes_without_replies_or_for_read_only_parameters() -> None:
    far = imu61x_bench()
    for parameter, value in (
        (Parameter.BAUD, 115200), (Parameter.GYRO_X_OFF, 0), (Parameter.BUS_MODE, 1),
        (Parameter.AHRS_RATE, BusMode.SPI),
    ):  # fmt: skip
        with pytest.raises(BadArgument):
            far.run(session.write_parameter(parameter, value))
        assert far.asked == []
    for change in (session.change_baud(921600, 115200), session.factory_reset(115200)):
        far = imu61x_bench()
        far.connected = False
        with pytest.raises(NoReply, match="nothing was changed"):
            far.run(change)
        assert far.baud == 115200
        assert not any(name.startswith(("factory reset", "set parameter")) for name in far.asked)
        assert far.streams()


@every_variant
@pytest.mark.parametrize("present", [115200, 921600])
@pytest.mark.manual("A 1.1 default rate", "A 1.6 CMD 15")
def test_factory_reset_is_read_back_and_the_line_follows(variant: str, present: int) -> None:
    settings = Imu61xSettings(baud=present, rate_hz=200, filter_control=0, i2c_address=0x1B)
    far = variant_bench(variant, settings)

    def ask(request: Request) -> Outcome:
        outcome = far.ask(request)
        assert far.module.flash.mode is OutputMode.STREAM  # a power failure now does not stop the stream
        return outcome

    change = run_script(session.factory_reset(present, done=done(variant)), ask)
    assert change.baud == far.baud == far.module.baud == 115200
    assert far.module.flash == far.module.settings == Imu61xSettings()
    assert far.streams()


def test_factory_resets_that_are_refused_or_act_at_the_next_start(monkeypatch: pytest.MonkeyPatch) -> None:
    far = imu61x_bench(Imu61xSettings(rate_hz=50), refuses=frozenset({Command.FACTORY_RESET}))
    words = r"expected AHRS_RATE 100, got AHRS_RATE 50; acknowledgement 2 \(0 is done\)"
    with pytest.raises(Rejected, match=words):
        far.run(session.factory_reset(115200))
    assert "restart" not in far.asked
    assert far.streams()

    far = imu61x_bench(Imu61xSettings(filter_control=0x44), ignores=frozenset({Command.FACTORY_RESET}))
    with pytest.raises(Rejected, match="expected FILTER 187, got FILTER 68; acknowledgement none"):
        far.run(session.factory_reset(115200))

    far = imu61x_bench(Imu61xSettings(rate_hz=50), reset_acts_at_start=True)
    far.run(session.write_parameter(Parameter.AHRS_RATE, 10))
    far.run(session.factory_reset(115200))
    assert far.asked.index("restart") < far.asked.index("save")
    assert far.module.flash == Imu61xSettings()


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
    assert (identity.firmware, identity.details) == ("10203", {"hardware_version": "2", "model_number": "614"})
    assert far.streams()
    assert far.module.flash == Imu61xSettings()

    far = variant_bench(
        variant, Imu61xSettings(rate_hz=50, filter_control=0x4B, i2c_address=0x1A, gyro_off_deg_s=(0.5, -0.25, 0.0))
    )
    assert combined(far.run(session.SETTINGS.read(Target(None, 0), None))).words == {
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


@pytest.mark.parametrize(
    ("script", "replies"),
    [
        (session.identify(), 0), (session.save(), 6), (session.restart(), 8),
        *[(session.change_baud(921600, 115200), replies) for replies in (0, 2, 4)],
        (session.factory_reset(115200), 0), (session.factory_reset(115200), 5),
    ],
)  # fmt: skip
def test_streaming_is_started_again_when_the_answer_fails(script: RequestScript[object], replies: int) -> None:
    """The device executes the commands and its later replies are lost: it must not stay silent."""
    refused = frozenset({Command.SET_PARAMETER})  # the device keeps its baud rate
    far = imu61x_bench(answers_while_streaming=False, refuses=refused, uptime_us=20_000_000)
    request = next(script)
    with pytest.raises(NoReply):  # noqa: PT012  # the script is driven by hand
        for number in count():
            outcome = far.ask(request)
            request = script.send(outcome if number < replies else Silence(()))
    assert far.asked[-1] == "output mode STREAM"
    assert far.streams()


ORDERS: dict[Command, Callable[[], RequestScript[object]]] = {
    Command.OUTPUT_MODE: session.stop_streaming,
    Command.SAVE: session.save,
    Command.HEADING: lambda: session.reset_heading(10),
}


@pytest.mark.manual("A 1.7 K1")
def test_a_refusal_is_an_error_that_names_the_option_and_a_missing_acknowledgement_too() -> None:
    words = r"expected result 0 \(done\), got 2: the device rejected the command or `options.result_done`"
    for refused, order in ORDERS.items():
        far = imu61x_bench(refuses=frozenset({refused}))
        with pytest.raises(Rejected, match=words):
            far.run(order())
        assert far.streams()
    for command in (Command.SAVE, Command.HEADING):
        far = imu61x_bench(acknowledges=False)
        with pytest.raises(NoReply, match="got none from a device that replies: it is not known whether"):
            far.run(ORDERS[command]())
    values = {"output_rate_hz": 50, "accel_filter": 0, "gyro_filter": 0, "i2c_address": 0x1B, "second_bus": "i2c"}
    for name, value in (values | {"baud": 230400}).items():
        far = imu61x_bench(refuses=frozenset({Command.SET_PARAMETER}))
        with pytest.raises(Rejected):
            write(far, name, value)
        assert read(far) == FACTORY


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
