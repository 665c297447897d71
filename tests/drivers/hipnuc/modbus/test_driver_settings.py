"""Read and write of the table of settings with all kinds of devices."""

from typing import Any

import msgspec
import pytest

from imud.contracts.setting import Effect, Written, values_of
from imud.drivers.hipnuc.modbus.driver import DRIVER, SETTINGS
from imud.model.errors import BadArgument, TransferError
from imud.sim.hipnuc.modbus import SLAVE_VARIANTS, SlaveVariant
from tests.support.pty_port import ModbusBench
from tests.support.pty_port import modbus_slave as module

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
