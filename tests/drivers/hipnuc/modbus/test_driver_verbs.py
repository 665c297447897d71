"""Verbs of a device on RS-485, with the simulated device."""

from typing import Any

import msgspec
import pytest

from imud.contracts.command import Target, Verdict, parameters_of
from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import Effect, Written, values_of
from imud.drivers.hipnuc.modbus.codec import HipnucModbusOptions
from imud.drivers.hipnuc.modbus.driver import CALIBRATIONS, DRIVER, SETTINGS
from imud.drivers.hipnuc.modbus.registers import read_registers, write_register
from imud.formats.modbus import framed
from imud.model.errors import BadArgument, TransferError
from imud.sim.hipnuc.modbus import SLAVE_VARIANTS, SlaveVariant
from tests.support.old_spellings import script_of
from tests.support.pty_port import ModbusBench
from tests.support.pty_port import modbus_slave as module


def act(bench: ModbusBench, name: str, **given: object) -> object:
    result: object = bench.run(script_of(DRIVER, bench.target, name, given))
    return result


@pytest.mark.parametrize(
    ("name", "given", "sent"),
    [
        ("save", {}, "0600000000"), ("factory_reset", {}, "0600000001"), ("restart", {}, "06000000ff"),
        ("address", {"address": 128}, "0600050080"), ("baud", {"baud": 4800}, "0600040000"),
        ("baud", {"baud": 256000}, "0600040009"), ("attitude_mode", {"axes": 9}, "0600060001"),
        ("attitude_mode", {"axes": 6}, "0600060000"), ("level", {"level": "relative"}, "0600a50002"),
        ("level", {"level": "cancel"}, "0600a50005"), ("mounting", {"mounting": "level"}, "0600a60000"),
        ("mounting", {"mounting": "y_down"}, "0600a60001"), ("mounting", {"mounting": "x_up"}, "0600a60003"),
    ],
)  # fmt: skip
@pytest.mark.manual("B 4.3.1 save", "B 4.3.2 baud rate", "B 4.3.4 mounting", "B 4.3.5 level", "B 4.3.6 axes")
def test_requests_as_sent(name: str, given: dict[str, object], sent: str) -> None:
    bench = ModbusBench()
    act(bench, name, **given)
    assert next(request.hex() for _, request in bench.sent if request[0] == 6) == sent


def test_actions_without_an_address_and_reading_by_name() -> None:
    with pytest.raises(BadArgument, match="expected a device on an RS-485 bus with a known address"):
        script_of(DRIVER, Target(HipnucModbusOptions(), 0), "address", {"address": 9})
    bench = ModbusBench(module(7))
    assert act(bench, "read", register="MD_ID") == (7,)
    assert act(bench, "read", register="sn") == (0xA000, 0, 0, 7)
    for name in ("CTRL", "nothing"):
        with pytest.raises(BadArgument, match="HEADING_MODE"):
            act(bench, "read", register=name)
    assert all(verb.help for verb in DRIVER.verbs.values())
    assert [str(one) for one in parameters_of(DRIVER.verbs["level"])] != []


@pytest.mark.parametrize(
    ("name", "given", "names"),
    [
        ("address", {"address": 129}, "from 1 to 128"),
        ("address", {}, "address is a setting: imud settings bow --set address=ADDRESS"),
        ("baud", {"baud": 12345}, "4800, 9600"), ("mounting", {"mounting": 1}, "level"),
        ("attitude_mode", {"axes": 1}, '"6-axis", "9-axis"'), ("level", {"level": 3}, "automatic"),
    ],
)  # fmt: skip
def test_unsupported_values_are_not_sent(name: str, given: dict[str, object], names: str) -> None:
    bench = ModbusBench()
    with pytest.raises(BadArgument, match=names):
        act(bench, name, **given)
    assert bench.sent == []


TARGET = Target(None, 0)


def value_of(script: Any, registers: dict[int, int]) -> tuple[list[Transfer], object]:
    """Run a script on registers of one word each; writes are echoed. Return the transfers and the result."""
    made: list[Transfer] = []

    def transfer(wanted: Transfer) -> bytes:
        made.append(wanted)
        (request,) = wanted.sends
        if request[0] == 0x06:
            return framed(1, request)
        address = int.from_bytes(request[1:3], "big")
        return framed(1, bytes([0x03, 2]) + registers[address].to_bytes(2, "big"))

    return made, run_transfer_script(script, transfer)


@pytest.mark.parametrize(("kind", "value"), [("level", 2), ("accelerometer_level", 3)])
@pytest.mark.manual("B 4.3.5 level")
def test_levels(kind: str, value: int) -> None:
    calibration = CALIBRATIONS[kind]
    assert calibration.save is not None
    for step, write in ((calibration.begin, write_register(0xA5, value)), (calibration.save, write_register(0x00, 0))):
        (sent,) = value_of(step(TARGET), {})[0]
        assert sent.sends == write.sends


@pytest.mark.parametrize(
    ("percent", "verdict"),
    [(0, Verdict(False, "state 1, 0 %", 0.0)), (40, Verdict(False, "state 1, 40 %", 0.4)),
     (100, Verdict(True, "state 1, 100 %", 1.0)), (65535, Verdict(True, "state 1, 65535 %", 1.0))],
)  # fmt: skip
def test_verdict_by_progress(percent: int, verdict: Verdict) -> None:
    ask = CALIBRATIONS["magnetometer"].verdict
    assert ask is not None
    made, found = value_of(ask(TARGET), {0x0A: 1, 0x0B: percent})
    assert made == [read_registers(0x0A, 1), read_registers(0x0B, 1)]
    assert found == verdict


@pytest.mark.parametrize(("mode", "words"), [(0, "`imud settings NAME --set mode=9-axis`"), (1, "")])
def test_nine_axes_are_needed(mode: int, words: str) -> None:
    calibration = CALIBRATIONS["magnetometer"]
    assert calibration.unready is not None
    assert str(value_of(calibration.unready(TARGET), {0x06: mode})[1]).endswith(words)
    assert value_of(calibration.begin(TARGET), {}) == ([], None)


VALUES: dict[str, tuple[object, ...]] = {
    "mode": ("9-axis", "6-axis"), "mounting": ("x_up", "x_down", "y_up", "y_down", "level"), "baud": (115200,),
    "address": (1, 128),
}  # fmt: skip


@pytest.fixture(params=SLAVE_VARIANTS)
def bench(request: pytest.FixtureRequest) -> ModbusBench:
    return ModbusBench(module(7, variant=SLAVE_VARIANTS[request.param]), module(12))


def write(bench: ModbusBench, name: str, value: object) -> object:
    made = SETTINGS.table[name].write
    assert made is not None
    return bench.run(made(bench.target, value))


def present(bench: ModbusBench) -> dict[str, Any]:
    return values_of(bench.run(SETTINGS.read(bench.target, None)))


def test_the_table_has_effects_and_types() -> None:
    assert DRIVER.device_settings is SETTINGS
    assert set(VALUES) == set(SETTINGS.table)
    effects = {name: (one.effect, one.connection) for name, one in SETTINGS.table.items()}
    assert effects == {
        "mode": (Effect.AT_ONCE, False), "mounting": (Effect.AFTER_RESTART, False),
        "baud": (Effect.AFTER_RESTART, True), "address": (Effect.AT_ONCE, True),
    }  # fmt: skip
    for name, values in VALUES.items():
        for value in values:
            assert msgspec.convert(value, SETTINGS.table[name].type) == value
    for name, wrong in (("mode", 9), ("mounting", "z_up"), ("baud", 12345), ("address", 129), ("address", 0)):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(wrong, SETTINGS.table[name].type)


def test_present_values_are_read_and_nothing_is_written(bench: ModbusBench) -> None:
    assert present(bench) == {"mode": "6-axis", "baud": 115200, "address": 7}
    assert all(request[0] == 3 for _, request in bench.sent)


@pytest.mark.parametrize("name", VALUES)
def test_a_saved_setting_is_read_after_a_restart(bench: ModbusBench, name: str) -> None:
    setting = SETTINGS.table[name]
    for value in VALUES[name]:
        written = write(bench, name, value)
        assert isinstance(written, Written)
        assert SETTINGS.save is not None
        assert SETTINGS.restart is not None
        bench.run(SETTINGS.save(bench.target))
        bench.run(SETTINGS.restart(bench.target))
        if setting.readable:
            assert setting.agrees(value, present(bench)[name])
        else:
            assert name not in present(bench)
            assert written is Written.UNVERIFIED


def test_values_that_are_refused_left_out_or_ignored() -> None:
    bench = ModbusBench()
    SETTINGS.check(bench.target, {"baud": 115200, "mode": "9-axis"})
    SETTINGS.check(bench.target, {})
    with pytest.raises(BadArgument, match="expected 115200, the baud rate of the bus, got 9600"):
        SETTINGS.check(bench.target, {"baud": 9600})
    bench = ModbusBench(module(7, dead=True))
    with pytest.raises(TransferError):
        present(bench)
    strange = ModbusBench(module(7))
    strange.slave.settings = strange.slave.settings.__class__(7, 115200, 5)
    assert present(strange) == {"baud": 115200, "address": 7}
    for name in ("mode", "address"):
        register = {"mode": "HEADING_MODE", "address": "MD_ID"}[name]
        bench = ModbusBench(module(7, variant=SlaveVariant(ignores=frozenset({register}))))
        with pytest.raises(Exception, match="after the write, got"):
            write(bench, name, VALUES[name][0])
