"""Settings of every driver, from its table: descriptions, declarations, write and read.

The running daemon writes an example of each setting to simulated devices behind a pseudo-terminal and reads it back.
"""

import sys
from contextlib import ExitStack
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from imud import config
from imud.client.connection import Client
from imud.config.yaml import yaml_block
from imud.contracts.command import Target
from imud.contracts.setting import Effect, SettingInfo, SettingsTable, declared_values
from imud.device import settings_plan
from imud.device.settings_plan import differences, make_plan, setting_instead, wanted_values
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.uart import firmware
from imud.formats.jsonrpc import RpcError
from imud.links import LINKS
from imud.model.errors import BadArgument, ConfigError
from imud.sim import SIMULATORS
from tests.support.daemon_process import running_daemon, wait_until

TABLES = {name: driver.device_settings for name, driver in DRIVERS.items() if driver.device_settings is not None}
EVERY = [(name, setting) for name, table in TABLES.items() for setting in table.table]
every_table = pytest.mark.parametrize("name", TABLES)
every_setting = pytest.mark.parametrize(("driver", "name"), EVERY)
PLACES = ("baud", "address", "node", "bit_rate", "i2c_address")
"""Settings that would disconnect the device from its test."""


def table_of(driver: str) -> SettingsTable:
    found = DRIVERS[driver].device_settings
    assert found is not None
    return found


def info_of(driver: str, name: str) -> SettingInfo:
    return next(one for one in settings_plan.described_settings(table_of(driver), {}, None) if one.name == name)


def example(info: inspect.Type, last: bool = False) -> Any:
    """Return a value of a type; with `last` another value, if there is one."""
    value: Any = None
    match info:
        case inspect.Metadata(type=inner):
            value = example(inner, last)
        case inspect.UnionType(types=types):
            value = example(types[0], last)
        case inspect.LiteralType(values=values):
            value = sorted(values, key=str)[-1 if last else 0]
        case inspect.BoolType():
            value = last
        case inspect.StrType():
            value = "4" if last else "0"
        case inspect.IntType() | inspect.FloatType():
            low, high = (bound if bound is not None else default for bound, default in ((info.ge, 1), (info.le, 2)))
            value = high if last else low
        case inspect.ListType(item_type=item, min_length=shortest):
            value = [example(item, last)] * (shortest or 1)
        case inspect.DictType(key_type=key, value_type=item):
            value = {example(key): example(item, last)}
        case inspect.StructType(fields=fields):
            value = {one.encode_name: example(one.type, number % 2 == 1) for number, one in enumerate(fields)}
    assert value is not None, f"no example of {info}"
    return value


def examples(driver: str, name: str) -> list[Any]:
    """Return two JSON values of a setting, twice the same value if there is only one."""
    if (driver, name) == ("hipnuc-uart", "output"):
        return [{"hi91": 1}, {"hi91": 8}]  # only INS models know the first message
    info = inspect.type_info(table_of(driver).table[name].type)
    return [example(info), example(info, last=True)]


@every_table
def test_tables_have_the_scripts_that_settings_require(name: str) -> None:
    """Only readable settings differ while the device has reported nothing."""
    table = table_of(name)
    assert table.table
    settings = table.table.values()
    if any(setting.effect is Effect.AFTER_RESTART and not setting.saves for setting in settings):
        assert table.save is not None
        assert table.restart is not None
    assert all(setting.readable or setting.write is not None for setting in settings)
    fields = set(table.declarable.__struct_fields__)
    assert fields == {one for one, setting in table.table.items() if setting.write is not None}
    order = [setting.connection for setting in settings]
    assert order == sorted(order), "settings that change the connection stand last"

    table = table_of(name)
    settable = [one for one, setting in table.table.items() if setting.write is not None]
    declared = msgspec.convert({one: examples(name, one)[1] for one in settable}, table.declarable)
    values = declared_values(declared)
    assert list(values) == settable
    assert set(differences(table, values, {}, {})) == {one for one in settable if table.table[one].readable}


@every_setting
def test_every_setting_describes_itself_and_can_be_declared(driver: str, name: str) -> None:
    one = info_of(driver, name)
    assert name == name.lower()
    assert name.isidentifier()
    assert one.description
    assert not one.description.endswith(".")
    assert one.section
    assert "keys and values" not in one.values
    if name.endswith(("_ms", "_hz", "_deg", "_deg_s")):
        assert one.unit, "a setting with a unit in its name says it"
    table = table_of(driver)
    setting = table.table[name]
    for value in examples(driver, name):
        typed = msgspec.convert(value, setting.type)
        assert msgspec.to_builtins(typed) == msgspec.to_builtins(
            msgspec.convert(msgspec.to_builtins(typed), setting.type)
        )
        assert setting.agrees(typed, typed)
        if setting.write is None:
            with pytest.raises(BadArgument, match="read-only"):
                wanted_values(table, {name: value})
            continue
        wanted = wanted_values(table, {name: value})
        link = next(link for link in LINKS if LINKS[link].fits(DRIVERS[driver]) and link not in ("memory", "replay"))
        text = yaml_block({"driver": driver, "settings": {name: value}})
        assert errors_but_of_the_link(text, link) == []
        assert differences(table, wanted, wanted, {}) == {}
        target = Target(DRIVERS[driver].settings(), 0)
        plan = make_plan(table, target, wanted, {}, {}, save=True, unsaved=False)
        if plan.left_out:  # device settings on a bus without a save command
            assert table.save is None
        else:
            assert [step.name for step in plan.steps] == [name]


def errors_but_of_the_link(device: str, link: str) -> list[str]:
    """Return the errors of the device settings in a configuration with a link without keys."""
    body = "".join(f"    {line}\n" for line in device.splitlines())
    try:
        config.parse(f"devices:\n  bow:\n{body}    {link}: {{}}\n", "f")
    except ConfigError as error:
        return [line for line in str(error).splitlines() if ".settings" in line and "where imud is told" not in line]
    return []


LINK_OF = {"hipnuc-uart": "uart", "hipnuc-modbus": "rs485", "imu61x-uart": "uart"}


def simulated_device(driver: str, port: Path) -> dict[str, Any]:
    link = {"uart": {"port": str(port), "baud": 115200}, "rs485": {"line": str(port), "reply_ms": 200}}
    return {"driver": driver, LINK_OF[driver]: link[LINK_OF[driver]]}


@pytest.mark.live
@pytest.mark.parametrize(
    ("name", "variant", "others"),
    [
        *((name, "", ()) for name in SIMULATORS if name in TABLES),
        ("hipnuc-uart", "INS, firmware 1.7", ("mode", "mounting", "output", "coordinates", "baseline")),
        ("hipnuc-uart", "older firmware", tuple(code.name.lower() for code in firmware.OlderCode)),
    ],
)
def test_a_simulated_device_accepts_and_reports_every_setting(
    name: str, variant: str, others: tuple[str, ...], tmp_path: Path
) -> None:
    """Write one value, then the other value. imud rejects an impossible combination with an error."""
    table = table_of(name)
    # settings of other firmware than the manual's
    foreign = firmware.NAMES - {*others} if name == "hipnuc-uart" else set()
    settable = [one for one, setting in table.table.items() if setting.write is not None and one not in PLACES]
    settable = list(others) or [one for one in settable if one not in foreign]
    with ExitStack() as stack:
        argv = [
            sys.executable,
            "-m",
            "imud.sim",
            "--device",
            name,
            "--path",
            str(tmp_path / "port"),
            "--variant",
            variant,
        ]
        simulator = stack.enter_context(Popen(argv, stdin=PIPE, stdout=PIPE, text=True))
        stack.callback(simulator.communicate)
        stack.callback(simulator.terminate)
        assert simulator.stdout is not None
        assert simulator.stdout.readline()
        devices = {"bow": simulated_device(name, tmp_path / "port")}
        daemon = stack.enter_context(running_daemon(tmp_path, devices))
        daemon.wait_for("bow", "running")
        with daemon.client() as client:
            client.timeout_s = 60
            told = {one["name"] for one in client.call("settings.get", device="bow", fresh=True)["settings"]
                    if one["actual"] is not None}  # fmt: skip
            reported = {one for one in table.table if table.table[one].readable and one not in foreign}
            assert reported - {*others} <= told
            for one in settable:
                taken = [value for value in examples(name, one) if takes(client, one, value)]
                assert taken, f"none of {examples(name, one)} for {one}"
                wait_until(lambda: daemon.statuses()["bow"].state in ("running", "silent"), "it is there")


def takes(client: Client, name: str, value: Any) -> bool:
    """Return whether the device accepts a value. Otherwise it excludes another one, or the firmware is too old."""
    try:
        done = client.call("settings.apply", device="bow", settings={name: value}, save=True)
    except RpcError as error:
        assert "expected" in str(error)  # noqa: PT017 - with what it does not go together, which no match can know
        return False
    if "not supported by firmware" in done["problem"]:  # a mode of newer firmware
        return False
    assert (done["problem"], done["differences"]) == ("", {}), (name, value, done)
    assert {step["outcome"] for step in done["steps"]} <= {"verified", "sent, not verified"}
    return True


REMOVED: list[tuple[str, str, dict[str, Any], str]] = [
    ("hipnuc-uart", "baud", {"baud": 921600}, "--set baud=921600 --save"),
    ("hipnuc-uart", "output", {"message": "HI91", "rate_hz": 200}, "--set output.hi91=200"),
    ("hipnuc-uart", "output_on_mark", {"message": "HI92"}, "--set output.hi92=on_mark"),
    ("hipnuc-uart", "output_none", {}, "--set output.hi91=0 output.hi92=0"),
    ("hipnuc-uart", "output_enabled", {"enabled": False}, "--set output_enabled=false"),
    ("hipnuc-uart", "mode", {"axes": 9}, "--set mode=9-axis"),
    ("hipnuc-uart", "mounting", {"turned": [1, 0, 0, 0, 1, 0, 0, 0, 1]}, "--set 'mounting=[1,0,0,0,1,0,0,0,1]' --save"),
    ("hipnuc-uart", "magnetic_calibration", {"enabled": True}, "--set magnetic_calibration=true"),
    ("hipnuc-uart", "pin", {"function": "sout", "pin": 5}, "--set pins.sout=5"),
    (
        "hipnuc-uart", "alarm", {"axis": "X", "min_deg": -10, "max_deg": 10},
        "--set alarm.x.min_deg=-10 alarm.x.max_deg=10 alarm.x.enabled=true",
    ),
    ("hipnuc-uart", "sout_divider", {"divisor": 4}, "--set sout_divisor=4"),
    ("hipnuc-modbus", "address", {"address": 9}, "--set address=9"),
    ("hipnuc-modbus", "baud", {"baud": 921600}, "--set baud=921600 --save"),
    ("hipnuc-modbus", "attitude_mode", {"axes": 6}, "--set mode=6-axis"),
    ("hipnuc-modbus", "mounting", {"mounting": "x_up"}, "--set mounting=x_up --save"),
    ("hipnuc-canopen", "interval", {"tpdo": 3, "interval_ms": 20}, "--set tpdo3_interval_ms=20"),
    ("hipnuc-canopen", "transmission", {"tpdo": 3, "by": "sync"}, "--set tpdo3_by=sync"),
    ("hipnuc-canopen", "bitrate", {"bitrate": 250_000}, "--set bit_rate=250000 --save"),
    ("hipnuc-canopen", "node", {"node": 9}, "--set node=9 --save"),
    (
        "hipnuc-canopen", "direction", {"x_reversed": True, "y_reversed": False},
        "--set incli_x_reversed=true incli_y_reversed=false",
    ),
    ("hipnuc-j1939", "interval", {"pgn": "FF3D", "interval_ms": 20}, "--set ff3d_interval_ms=20"),
    ("hipnuc-j1939", "bitrate", {"bitrate": 250_000}, "--set bit_rate=250000 --save"),
    ("hipnuc-j1939", "address", {"address": 9}, "--set address=9 --save"),
    ("hipnuc-j1939", "direction", {"axis": "X", "reversed": True}, "--set x_reversed=true"),
    ("imu61x-uart", "settings", {}, ""),
    ("imu61x-uart", "baud", {"baud": 230400}, "--set baud=230400 --save"),
    ("imu61x-uart", "rate", {"rate_hz": 200}, "--set output_rate_hz=200"),
    ("imu61x-uart", "filter", {"accel_filter": "5 Hz", "gyro_filter": 3}, "--set 'accel_filter=5 Hz' gyro_filter=3"),
    ("imu61x-uart", "i2c_address", {"address": "0x19"}, "--set i2c_address=0x19"),
    ("imu61x-uart", "bus", {"bus": "i2c"}, "--set second_bus=i2c"),
    ("imu61x-i2c", "filter", {"accel_filter": "5 Hz"}, "--set 'accel_filter=5 Hz'"),
    ("imu61x-spi", "filter", {"accel_filter": None, "gyro_filter": 3}, "--set gyro_filter=3"),
]  # fmt: skip


@pytest.mark.parametrize(("driver", "name", "given", "words"), REMOVED)
def test_a_removed_command_names_the_new_command(driver: str, name: str, given: dict[str, Any], words: str) -> None:
    row, table = DRIVERS[driver], table_of(driver)
    assert name not in row.verbs
    instead = setting_instead("bow", name, row, given)
    assert instead is not None
    assert str(instead).partition(": ")[2] == f"imud settings bow {words}".strip()
    assert instead.data["save"] is ("--save" in words)
    wanted = wanted_values(table, instead.data["settings"])
    for setting in settings_plan.completed(table, wanted, {}):
        setting_of = table.table[setting]
        assert "--save" in words or not (setting_of.saves or setting_of.effect is Effect.AFTER_RESTART)
    if given:  # names in place of values, and no values for programs
        instead = setting_instead("bow", name, row, {})
        assert instead is not None
        assert instead.data["settings"] == {}
        assert all(argument.upper() in str(instead) for argument in given)


def test_every_removed_command_is_tested_and_a_setting_without_a_command_too() -> None:
    assert {(driver, name) for driver, name, *_ in REMOVED} == {
        (driver, name) for driver, row in DRIVERS.items() for name in row.renamed
    }
    row = DRIVERS["hipnuc-canopen"]
    assert str(setting_instead("bow", "heartbeat_ms", row, {"heartbeat_ms": 5})).endswith("--set heartbeat_ms=5")
    assert str(setting_instead("bow", "node", row, {"node": "\x1b[31m"})).endswith(r"--set 'node=\x1b[31m' --save")
    assert str(setting_instead("bow", "node", row, {"node": "9" * 500})).endswith("--set node=NODE --save")
    for name in ("dance", "magnetometer_bias"):
        assert setting_instead("bow", name, DRIVERS["hipnuc-uart"], {}) is None
    assert not any("save" in table.table for table in TABLES.values()), "`save` is an argument of the broker's verb set"
    assert not any("set" in row.verbs for row in DRIVERS.values())
