"""Settings of an IMU61x on a UART, with simulated devices in all variants."""

from typing import Any

import msgspec
import pytest

from imud.contracts.command import Target
from imud.contracts.setting import values_of
from imud.drivers.imu61x.uart.codec import Parameter
from imud.drivers.imu61x.uart.commands import Command, Imu61xUartOptions, OutputMode
from imud.drivers.imu61x.uart.settings import SETTINGS, settings_of
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.sim.imu61x.uart import Imu61xSettings
from tests.support.simulated_modules import Imu61xBench, done, every_variant, imu61x_bench, variant_bench

FACTORY = {
    "output_rate_hz": 100, "accel_filter": "47 Hz", "gyro_filter": "47 Hz", "second_bus": "spi", "i2c_address": "0x18",
    "gyro_offset_deg_s": [0.0, 0.0, 0.0], "installation_angles_deg": [0.0, 0.0, 0.0], "output_mode": "stream",
    "baud": 115200,
}  # fmt: skip


def target(far: Imu61xBench, variant: str = "executes commands while it streams") -> Target:
    return Target(Imu61xUartOptions(result_done=done(variant)), far.baud)


def read(far: Imu61xBench, variant: str = "executes commands while it streams") -> dict[str, Any]:
    return values_of(far.run(SETTINGS.read(target(far, variant), None)))


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


@every_variant
@pytest.mark.parametrize(
    ("name", "value", "shown"),
    [
        ("output_rate_hz", 200, 200), ("accel_filter", "10 Hz", "10 Hz"), ("gyro_filter", 13, "average 16"),
        ("second_bus", "by_pin", "by_pin"), ("i2c_address", "0x1B", "0x1b"), ("i2c_address", 0x1A, "0x1a"),
        ("output_mode", "command", "command"), ("baud", 460800, 460800),
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
    write(far, "gyro_filter", "5 Hz", variant)
    if variant == "no K1":
        with pytest.raises(NoReply, match="it is not known whether the device executed the command"):
            far.run(SETTINGS.save(target(far, variant)))
    else:
        far.run(SETTINGS.save(target(far, variant)))
    far.run(SETTINGS.restart(target(far, variant)))
    assert read(far, variant) == FACTORY | {"gyro_filter": "5 Hz"}


@pytest.mark.parametrize("name", ["output_rate_hz", "accel_filter", "gyro_filter", "i2c_address", "second_bus", "baud"])
def test_a_refusing_device_is_an_error(name: str) -> None:
    values = {"output_rate_hz": 50, "accel_filter": 0, "gyro_filter": 0, "i2c_address": 0x1B, "second_bus": "i2c"}
    far = imu61x_bench(refuses=frozenset({Command.SET_PARAMETER}))
    with pytest.raises(Rejected):
        write(far, name, values.get(name, 230400))
    assert read(far) == FACTORY


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

    told = {Parameter.FILTER: 300.0, Parameter.BUS_MODE: 7.0, Parameter.I2C_ADDRESS: 0.5, Parameter.AHRS_RATE: 33.0}
    assert settings_of(told) == {"output_rate_hz": 33}
    assert settings_of({Parameter.BAUD: float("nan")}) == {}

    far = imu61x_bench(Imu61xSettings(mode=OutputMode.COMMAND))
    assert read(far)["output_mode"] == "command"
    assert far.module.settings.mode is OutputMode.COMMAND
