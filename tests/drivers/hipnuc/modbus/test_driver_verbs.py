"""Verbs of a device on RS-485, with the simulated device."""

import pytest

from imud.contracts.command import Target, parameters_of
from imud.drivers.hipnuc.modbus.codec import HipnucModbusOptions
from imud.drivers.hipnuc.modbus.driver import DRIVER
from imud.model.errors import BadArgument
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
@pytest.mark.manual("B 4.3.1 save", "B 4.3.4 mounting", "B 4.3.5 level", "B 4.3.6 axes")
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
