"""Named actions of a module on RS-485, on the simulated one."""

import pytest

from imud.contracts.action import Target, parameters_of
from imud.contracts.polling import run_transfer_script
from imud.devices.hipnuc.modbus.codec import HipnucModbusSettings
from imud.devices.hipnuc.modbus.driver import DRIVER
from imud.errors import BadArgument
from tests.devices.hipnuc.modbus.test_session import Wire

TARGET = Target(HipnucModbusSettings(), 0)


def act(wire: Wire, name: str, **given: object) -> object:
    action = DRIVER.actions[name]
    return run_transfer_script(action.script(TARGET, action.arguments(given)), wire.transfer)


@pytest.mark.parametrize(
    ("name", "given", "sent"),
    [
        ("save", {}, "0600000000"),
        ("factory_reset", {}, "0600000001"),
        ("restart", {}, "06000000ff"),
        ("address", {"address": 1}, "0600050001"),
        ("address", {"address": 128}, "0600050080"),
        ("baud", {"baud": 4800}, "0600040000"),
        ("baud", {"baud": 921600}, "0600040008"),
        ("attitude_mode", {"axes": 9}, "0600060001"),
        ("attitude_mode", {"axes": 6}, "0600060000"),
        ("level", {"level": "relative"}, "0600a50002"),
        ("level", {"level": "automatic"}, "0600a50003"),
        ("level", {"level": "cancel"}, "0600a50005"),
        ("mounting", {"mounting": "level"}, "0600a60000"),
        ("mounting", {"mounting": "y_down"}, "0600a60001"),
        ("mounting", {"mounting": "y_up"}, "0600a60002"),
        ("mounting", {"mounting": "x_up"}, "0600a60003"),
        ("mounting", {"mounting": "x_down"}, "0600a60004"),
    ],
)
def test_what_is_sent(name: str, given: dict[str, object], sent: str) -> None:
    wire = Wire()
    act(wire, name, **given)
    assert wire.asked[0].hex() == sent


def test_registers_are_read_by_name() -> None:
    wire = Wire()
    assert act(wire, "read", register="MD_ID") == (7,)
    assert act(wire, "read", register="sn") == (0x0001, 0x0203, 0x0405, 0x0607)
    for name in ("CTRL", "nothing"):
        with pytest.raises(BadArgument, match="HEADING_MODE"):
            act(wire, "read", register=name)


@pytest.mark.parametrize(
    ("name", "given", "names"),
    [
        ("address", {"address": 129}, "from 1 to 128"),
        ("address", {"address": 0}, "from 1 to 128"),
        ("address", {}, "from 1 to 128"),
        ("baud", {"baud": 256000}, "4800, 9600"),
        ("baud", {"baud": True}, "4800, 9600"),
        ("mounting", {"mounting": 1}, "level"),
        ("attitude_mode", {"axes": 1}, "6, 9"),
        ("level", {"level": 3}, "automatic"),
    ],
)
def test_what_a_module_cannot_take_is_not_sent(name: str, given: dict[str, object], names: str) -> None:
    wire = Wire()
    with pytest.raises(BadArgument, match=names):
        act(wire, name, **given)
    assert wire.asked == []


def test_all_are_described() -> None:
    assert all(action.help for action in DRIVER.actions.values())
    assert [str(one) for one in parameters_of(DRIVER.actions["attitude_mode"])] != []
