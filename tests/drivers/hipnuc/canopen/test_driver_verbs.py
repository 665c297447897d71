"""Verbs of a CANopen device: frames on the bus, and their effect on the simulated device."""

from typing import Any

import pytest

from imud.contracts.command import Target
from imud.contracts.script import RequestScript
from imud.contracts.setting import Written
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.canopen.driver import DRIVER
from imud.model.errors import BadArgument
from imud.sim.hipnuc.canopen import NodeSettings
from tests.support.old_spellings import script_of
from tests.support.simulated_modules import QUIET, CanopenBench


def begun(name: str, at: int = 8, /, **given: object) -> RequestScript[Any]:
    """Return the script of a verb or of a setting for the node in the options."""
    conversation: RequestScript[Any] = script_of(DRIVER, Target(HipnucCanopenOptions(node=at), 500_000), name, given)
    return conversation


ROWS: list[tuple[str, dict[str, object], str]] = [
    ("save", {}, "23 00 20 00 00 00 00 00"),
    ("restart", {}, "23 00 20 00 FF 00 00 00"),
    ("factory_reset", {}, "23 00 20 00 01 00 00 00"),
    ("node", {"node": 9}, "23 A0 20 00 09 00 00 00"),
    ("bitrate", {"bitrate": 1_000_000}, "23 9A 20 00 00 00 00 00"),
    ("bitrate", {"bitrate": 500_000}, "23 9A 20 00 02 00 00 00"),
    ("bitrate", {"bitrate": 250_000}, "23 9A 20 00 03 00 00 00"),
    ("bitrate", {"bitrate": 125_000}, "23 9A 20 00 04 00 00 00"),
    ("interval", {"tpdo": 1, "interval_ms": 5}, "2B 00 18 05 05 00 00 00"),
    ("interval", {"tpdo": 6, "interval_ms": 0}, "2B 04 18 05 00 00 00 00"),
    ("interval", {"tpdo": 7, "interval_ms": 1000}, "2B 05 18 05 E8 03 00 00"),
    ("transmission", {"tpdo": 1, "by": "sync"}, "2F 00 18 02 01 00 00 00"),
    ("transmission", {"tpdo": 4, "by": "timer"}, "2F 03 18 02 FF 00 00 00"),
    ("direction", {"x_reversed": True, "y_reversed": False}, "23 9E 20 00 01 00 00 00"),
    ("direction", {"x_reversed": False, "y_reversed": False}, "23 9E 20 00 00 00 00 00"),
    ("transmission", {"tpdo": 1, "by": "timer"}, "2F 00 18 02 FF 00 00 00"),
    ("zero", {"zero": "here"}, "23 A5 20 00 02 00 00 00"),
    ("zero", {"zero": "cancel"}, "23 A5 20 00 05 00 00 00"),
]


@pytest.mark.parametrize(("name", "given", "data"), ROWS)
@pytest.mark.parametrize("node", [8, 127])
@pytest.mark.manual(
    "B 5.4.1 node number", "B 5.4.1 save", "B 5.4.1 restart", "B 5.4.1 factory settings", "B 5.4.1 bit rate",
    "B 5.4.1 zero of the inclinometer", "B 5.4.2 transmission type",
)  # fmt: skip
def test_commands_of_the_manual_go_to_the_node_of_the_settings(
    name: str, given: dict[str, object], data: str, node: int
) -> None:
    bench = CanopenBench(NodeSettings(node=node))
    bench.run_script(begun(name, node, **given))
    writes = [frame for frame in bench.sent if frame[1][0] != 0x40]
    assert writes[0] == (0x600 + node, bytes.fromhex(data))


@pytest.mark.parametrize(
    ("command", "code"),
    [("start", 1), ("stop", 2), ("pre_operational", 0x80), ("reset_node", 0x81), ("reset_communication", 0x82)],
)
def test_network_management(command: str, code: int) -> None:
    bench = CanopenBench(NodeSettings(node=5))
    bench.run_script(begun("nmt", 5, command=command))
    assert (0, bytes([code, 5])) in bench.sent
    # only a reset returns to the settings of the flash
    verb = DRIVER.verbs["nmt"]
    assert verb.effect_on_flash(verb.arguments({"command": command})) == (code > 0x80, False)
    assert {name for name, _, _ in ROWS} | {"nmt"} == {*DRIVER.verbs, *DRIVER.renamed}


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("node", {"node": 128}), ("node", {"node": True}), ("bitrate", {"bitrate": 800_000}),
        ("interval", {"tpdo": 5, "interval_ms": 10}), ("interval", {"tpdo": 1, "interval_ms": 4}),
        ("interval", {"tpdo": 1, "interval_ms": 1001}), ("transmission", {"tpdo": 1, "by": "remote"}),
        ("direction", {"x_reversed": 1, "y_reversed": False}), ("zero", {"zero": 2}), ("nmt", {"command": "sleep"}),
    ],
)  # fmt: skip
def test_arguments_that_cannot_be_send_nothing(name: str, given: dict[str, object]) -> None:
    with pytest.raises(BadArgument, match=r"(?i)expected|invalid enum value"):
        next(begun(name, **given))


def test_the_module_obeys() -> None:
    bench = CanopenBench(NodeSettings(periods_ms=QUIET.periods_ms))
    bench.run_script(begun("direction", x_reversed=False, y_reversed=True))
    bench.run_script(begun("interval", tpdo=2, interval_ms=20))
    bench.run(100_000_000)
    assert 0x288 in {can_id for can_id, _ in bench.heard}
    assert bench.module.objects.settings.invert_y
    assert not bench.module.objects.settings.invert_x
    assert bench.run_script(begun("nmt", command="reset_node")) == "found as node 8"
    assert not bench.module.objects.settings.invert_y  # nothing was saved


def test_an_interval_above_the_bus_load_is_rejected_with_numbers() -> None:
    def interval(bit_rate: int, others_bit_s: float) -> object:
        bench = CanopenBench(NodeSettings(node=8))
        target = bench.target(bit_rate, others_bit_s)
        return bench.run_script(script_of(DRIVER, target, "interval", {"tpdo": 1, "interval_ms": 5}, **bench.present()))

    # 95 bits · 200 + (95 + 95 + 111 + 111) · 100 + 79 · 20 = 61,780 bit/s: 49.4 % of 125 kbit/s (TPDO1: 15.2 %)
    assert interval(125_000, 63_000.0) is Written.VERIFIED
    with pytest.raises(BadArgument, match=r"got 101 % of it: TPDO1 every 5 ms 15.2 %, .*; other devices 51.2 %"):
        interval(125_000, 64_000.0)
    assert interval(0, 1e9) is Written.VERIFIED  # a virtual bus has no rate
