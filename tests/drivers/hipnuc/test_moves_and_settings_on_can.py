"""HiPNUC devices on CAN: write, save and read settings, and follow a device to another number.

Most tests run on CANopen and on J1939, with all behaviors that no manual documents.
"""

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any, NamedTuple

import msgspec
import pytest

from imud.contracts.command import Target, VerbResult
from imud.contracts.script import Outcome, Reply, Request, RequestScript, Silence
from imud.contracts.setting import Effect, SettingsTable, Written
from imud.drivers.hipnuc.canopen import commands as canopen
from imud.drivers.hipnuc.canopen.cia301 import Aborted
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.canopen.driver import SETTINGS as CANOPEN_SETTINGS
from imud.drivers.hipnuc.j1939 import commands as j1939
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from imud.drivers.hipnuc.j1939.driver import SETTINGS as J1939_SETTINGS
from imud.formats.can import EXTENDED_ID_MAX, RAW_FRAME
from imud.model.errors import BadArgument, DeviceRefused, NoReply, Rejected
from imud.sim.hipnuc.canopen import NODE_VARIANTS, NodeSettings, NodeVariant
from imud.sim.hipnuc.j1939 import J1939_VARIANTS, J1939Settings, J1939Variant
from tests.support.old_spellings import script_of
from tests.support.simulated_modules import CanBench, CanopenBench, J1939Bench, run_script

BOOTED_NS = 500_000_000
TPDOS = (1, 2, 3, 4, 6, 7)
MANUAL_PGNS = ("ff2f", "ff34", "ff37", "ff3a", "ff3d", "ff41", "ff43", "ff46", "ff4a")
PGNS = tuple(sorted((*MANUAL_PGNS, "ff10", "ff14", "ff18", "ff26", "ff5a", "ff5b")))


class Protocol(NamedTuple):
    """Protocol on CAN, described by the names and values that differ."""

    noun: str
    """Setting and action of the number of a device."""
    restarted: str
    """Result of a restart, without the number."""
    make: Callable[..., CanopenBench | J1939Bench]
    """Returns a bench of a device with a number."""
    variants: Mapping[str, Any]
    variant: Callable[..., Any]
    register: int
    """Place of the number in the device."""
    values: Mapping[str, tuple[object, ...]]
    """Values of every setting, in the order of the table."""
    of_each_form: tuple[str, ...]
    """Settings that every kind of device must accept. The other settings have the same forms."""
    delivered: Mapping[str, object]
    wrong: Mapping[str, object]
    settings: SettingsTable
    options: Callable[[int], Any]
    session: Any
    place: Any
    number_of: Callable[[Any], int]
    go_back: tuple[int, str]
    """Identifier and data of the frame that commands a lost device from 9 back to 8."""
    is_write: Callable[[bytes], bool]


CANOPEN = Protocol(
    noun="node", restarted="found as node",
    make=lambda number=8, **more: CanopenBench(NodeSettings(node=number), **more), variants=NODE_VARIANTS,
    variant=NodeVariant, register=0x20A0,
    values={
        **{f"tpdo{tpdo}_interval_ms": (5, 1000, 0) if tpdo == 1 else (1000,) for tpdo in TPDOS},
        **{f"tpdo{tpdo}_by": ("sync", "timer") if tpdo == 1 else ("sync",) for tpdo in TPDOS},
        **dict.fromkeys(("incli_x_reversed", "incli_y_reversed"), (True, False)), "heartbeat_ms": (500, 0),
        "bit_rate": (500_000,), "node": (127, 1),
    },
    of_each_form=("tpdo1_interval_ms", "tpdo1_by", "bit_rate", "node"),
    delivered={
        **{f"tpdo{tpdo}_interval_ms": 50 if tpdo == 6 else 10 for tpdo in TPDOS},
        **{f"tpdo{tpdo}_by": "timer" for tpdo in TPDOS}, "incli_x_reversed": False, "incli_y_reversed": False,
        "heartbeat_ms": 0, "bit_rate": 500_000, "node": 8,
    },
    wrong={"tpdo1_interval_ms": 1001, "tpdo1_by": "remote", "bit_rate": 800_000, "node": 128, "incli_x_reversed": 1},
    settings=CANOPEN_SETTINGS, options=lambda number: HipnucCanopenOptions(node=number), session=canopen,
    place=(canopen.NODE_ID, 0), number_of=lambda module: module.node, go_back=(0x609, "23 A0 20 00 08 00 00 00"),
    is_write=lambda data: data[0] != 0x40,
)  # fmt: skip
J1939 = Protocol(
    noun="address", restarted="found at address",
    make=lambda number=8, **more: J1939Bench(J1939Settings(address=number), **more), variants=J1939_VARIANTS,
    variant=J1939Variant, register=j1939.ADDRESS,
    values={
        **{f"{pgn}_interval_ms": (5, 1000) if pgn == "ff34" else (1000, 0) for pgn in PGNS},
        "output_enabled": (False, True),
        **dict.fromkeys(("x_reversed", "y_reversed"), (True, False)), "bit_rate": (500_000,), "address": (128, 1),
    },
    of_each_form=("ff34_interval_ms", "x_reversed", "bit_rate", "address"),
    delivered={
        **{f"{pgn}_interval_ms": 100 if pgn in ("ff34", "ff37", "ff3d", "ff41") else 0 for pgn in PGNS},
        "output_enabled": True, "x_reversed": False, "y_reversed": False, "bit_rate": 500_000, "address": 8,
    },
    wrong={"ff34_interval_ms": -1, "ff41_interval_ms": 1001, "bit_rate": 100_000, "address": 129},
    settings=J1939_SETTINGS, options=lambda number: HipnucJ1939Options(address=number), session=j1939,
    place=j1939.ADDRESS, number_of=lambda module: module.settings.address,
    go_back=(0x0CEF0955, "9C 00 06 00 08 00 00 00"), is_write=lambda data: data[2] == 6,
)  # fmt: skip
OLD = ("x_reversed", "y_reversed", "bit_rate", "address")  # other settings that older firmware has
both = pytest.mark.parametrize("protocol", [CANOPEN, J1939], ids=["CANopen", "J1939"])
EVERY = [(protocol, name) for protocol in (CANOPEN, J1939) for name in protocol.variants]


@pytest.fixture(params=EVERY, ids=[name for _, name in EVERY])
def kind(request: pytest.FixtureRequest) -> tuple[Protocol, Any]:
    """Yield a protocol, a bench with a device of each kind, and another device with the number 12."""
    protocol, name = request.param
    bench = protocol.make(boot_ms=300, variant=protocol.variants[name], others=(12,))
    bench.run(BOOTED_NS)
    return protocol, bench


def move(protocol: Protocol, bench: CanBench, number: int) -> object:
    return bench.act(protocol.noun, **{protocol.noun: number})


def numbers(protocol: Protocol, bench: Any) -> tuple[int, int]:
    return getattr(bench.settings, protocol.noun), protocol.number_of(bench.module)


def is_told(variant: Any) -> bool:
    return variant.reads not in ("ignored", "aborted")


def is_at_once(variant: Any) -> bool:
    return bool(getattr(variant, "number_at_once", False) or getattr(variant, "address_at_once", False))


def restarted(bench: Any) -> tuple[str, str]:
    """Restart a device. Return the report and the evidence."""
    found = bench.act("restart")
    return (found.result, found.evidence) if isinstance(found, VerbResult) else (found, "")


def test_a_module_is_followed_to_another_number(kind: tuple[Protocol, Any]) -> None:
    protocol, bench = kind
    variant = bench.module.hardware.variant
    written = move(protocol, bench, 9)
    if is_at_once(variant):
        # it replies at a number at which no device replied before: this needs no readable register
        assert written is Written.VERIFIED
        assert numbers(protocol, bench) == (9, 9)
    else:
        assert written is (Written.PENDING if is_told(variant) else Written.UNVERIFIED_PENDING)
        assert getattr(bench.settings, protocol.noun) == 8
        assert restarted(bench)[0] == f"{protocol.restarted} 8"  # the number is not saved
        assert numbers(protocol, bench) == (8, 8)
        move(protocol, bench, 9)
    bench.act("save")
    evidence = f"the device moved from {protocol.noun} 8 to 9", "the device sent its boot message", ""
    assert restarted(bench) in [
        (f"{protocol.restarted} 9", words) for words in (evidence[1:] if is_at_once(variant) else evidence[:1])
    ]
    assert numbers(protocol, bench) == (9, 9)
    before = len(bench.measured)
    bench.run(2_000_000_000)
    assert len(bench.measured) > before + 5


def test_an_unsaved_number_is_lost_at_a_restart(kind: tuple[Protocol, Any]) -> None:
    protocol, bench = kind
    if is_at_once(bench.module.hardware.variant):
        move(protocol, bench, 9)
        moved = f"the device moved from {protocol.noun} 9 to 8"
        assert restarted(bench) == (f"{protocol.restarted} 8", moved)
        assert numbers(protocol, bench) == (8, 8)


def test_present_values_are_read_and_nothing_is_written(kind: tuple[Protocol, Any]) -> None:
    protocol, bench = kind
    variant, expected = bench.module.hardware.variant, dict(protocol.delivered)
    if variant == J1939Variant(newer=False):
        expected = {name: value for name, value in expected.items() if name[:4] in MANUAL_PGNS or name in OLD}
    assert bench.present() == (expected if is_told(variant) else {})
    assert not any(protocol.is_write(data) for _, data in bench.sent)


def test_a_number_in_use_is_rejected_without_a_write(kind: tuple[Protocol, Any]) -> None:
    protocol, bench = kind
    with pytest.raises(BadArgument, match=rf"{protocol.noun} 12 is in use: received its (frame 0x|PGN F)"):
        move(protocol, bench, 12)
    assert not any(protocol.is_write(data) for _, data in bench.sent)
    move(protocol, bench, 8)  # imud writes its own number anyway
    assert numbers(protocol, bench) == (8, 8)


@both
def test_rejected_and_ignored_numbers_are_reported_and_a_lost_device_is_commanded_back(protocol: Protocol) -> None:
    register = frozenset({protocol.register})
    with pytest.raises((Aborted, Rejected), match=r"invalid value|status 1"):
        move(protocol, protocol.make(variant=protocol.variant(refuses=register)), 9)
    with pytest.raises((DeviceRefused, Rejected), match=r"after the write, got 8"):
        move(protocol, protocol.make(variant=protocol.variant(ignores=register)), 9)

    sent: list[bytes] = []

    def silent(request: Request) -> Outcome:
        sent.append(request.payload)
        return Reply(()) if request.silent else Silence(())

    target = Target(protocol.options(8), 500_000)
    script = script_of(protocol.make().driver, target, protocol.noun, {protocol.noun: 9})
    with pytest.raises(NoReply, match=r"replied neither (as node 9 nor as node 8|at address 9 nor at 8)"):
        run_script(script, silent)
    can_id, _, data = RAW_FRAME.unpack(sent[-1])
    assert (can_id & EXTENDED_ID_MAX, data) == (protocol.go_back[0], bytes.fromhex(protocol.go_back[1]))


@both
def test_lost_devices_are_reported_and_factory_settings_are_in_force_after_a_restart(protocol: Protocol) -> None:
    bench = protocol.make(boot_ms=300)
    bench.run(BOOTED_NS)
    bench.act("bitrate", bitrate=250_000)
    bench.module.hardware = type(bench.module.hardware)(boot_ms=60_000)  # afterwards, the host cannot read its frames
    assert restarted(bench)[0] == "the device now uses 250000 bit/s and the bus does not; set the bus to 250000 bit/s"
    bench = protocol.make(boot_ms=60_000)
    bench.now_ns += 70_000_000_000
    with pytest.raises(NoReply, match=f"no frame of {protocol.noun} 8 after the restart"):
        bench.act("restart")

    bench = protocol.make(9)
    done = str(bench.act("factory_reset"))
    assert f"{protocol.noun} 8" in done
    assert "after the next restart" in done
    bench = protocol.make(9, others=(8,))
    bench.run(100_000_000)
    with pytest.raises(BadArgument, match=f"{protocol.noun} 8, the factory .* is in use"):
        bench.act("factory_reset")
    assert not any(protocol.is_write(data) for _, data in bench.sent)


@pytest.mark.parametrize("told", [254, 0xF006_0102])
@both
def test_an_invalid_number_is_not_searched(protocol: Protocol, told: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Found by fuzzing: such a number made an identifier that no frame can have, a ValueError."""

    def read_values(*_arguments: object, **_more: object) -> RequestScript[dict[object, int]]:
        return {protocol.place: told}
        yield  # makes it a generator

    monkeypatch.setattr(protocol.session, "read_values", read_values)
    action = protocol.make().driver.verbs["restart"]
    script = action.script(Target(protocol.options(8), 500_000), action.arguments({}))
    with pytest.raises(NoReply, match=f"no frame of {protocol.noun} 8 after the restart"):
        run_script(script, lambda _request: Silence(()))


@both
def test_the_table_has_order_effects_and_types(protocol: Protocol) -> None:
    table = protocol.settings.table
    assert protocol.make().driver.device_settings is protocol.settings
    assert list(protocol.values) == list(table)
    pending = {name for name, one in table.items() if one.effect is Effect.AFTER_RESTART}
    moving = {name for name, one in table.items() if one.connection}
    assert pending == moving == {"bit_rate", protocol.noun}
    for name, values in protocol.values.items():
        for value in values:
            assert msgspec.convert(value, table[name].type) == value
    for name, value in protocol.wrong.items():
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(value, table[name].type)


@both
def test_a_saved_setting_is_read_after_a_restart(protocol: Protocol) -> None:
    """Each kind of device accepts one setting of each form; the real one accepts all."""
    for variant, (name, values) in product(protocol.variants.values(), protocol.values.items()):
        if name in protocol.of_each_form or variant == protocol.variant():
            bench = protocol.make(boot_ms=100, variant=variant)
            bench.run(200_000_000)
            # a reply at the new number is evidence without a readable register
            is_seen_at_new_number = name == protocol.noun and is_at_once(variant)
            for value in values:
                written = bench.set_for_good(name, value)
                is_verified = written in (Written.VERIFIED, Written.PENDING)
                assert is_verified == (is_told(variant) or is_seen_at_new_number)
                if is_told(variant):
                    assert protocol.settings.table[name].agrees(value, bench.present()[name])


def test_canopen_values_that_do_not_go_together_are_refused() -> None:
    target = CanopenBench().target(125_000, 30_000.0)
    CANOPEN_SETTINGS.check(target, {**CANOPEN.delivered, "bit_rate": 125_000})
    with pytest.raises(BadArgument, match="expected 125000, the bit rate of the bus, got 500000"):
        CANOPEN_SETTINGS.check(target, {"bit_rate": 500_000})
    with pytest.raises(BadArgument, match=r"tpdo1_interval_ms: expected 0 or 5 … 1000, got 4"):
        CANOPEN_SETTINGS.check(target, {"tpdo1_interval_ms": 4})
    fast = {f"tpdo{tpdo}_interval_ms": 5 for tpdo in TPDOS}  # 586 bits · 200 = 117,200 bit/s
    with pytest.raises(BadArgument, match=r"got 118 % of it: .*TPDO4 every 5 ms 17.8 %.*; other devices 24 %"):
        CANOPEN_SETTINGS.check(target, fast)
    # sent at each SYNC, and SYNC is off
    CANOPEN_SETTINGS.check(target, fast | {f"tpdo{tpdo}_by": "sync" for tpdo in TPDOS})


def test_j1939_values_that_do_not_go_together_are_refused() -> None:
    bench = J1939Bench()
    with pytest.raises(BadArgument, match="expected 125000, the bit rate of the bus, got 500000"):
        J1939_SETTINGS.check(bench.target(125_000), {"bit_rate": 500_000})
    fast = {f"{pgn}_interval_ms": 5 for pgn in ("ff34", "ff37", "ff3d", "ff41")}  # 131 bits · 200 · 4 = 104,800 bit/s
    J1939_SETTINGS.check(bench.target(125_000), fast)
    with pytest.raises(BadArgument, match=r"ff10_interval_ms: expected 0 or 5 … 1000, got 4; expected messages within"):
        J1939_SETTINGS.check(bench.target(125_000), fast | {"ff10_interval_ms": 4, "ff43_interval_ms": 5})
    with pytest.raises(BadArgument, match=r"got 105 % of it: FF34 every 5 ms 21 %, .*"):
        J1939_SETTINGS.check(bench.target(125_000), fast | {"ff43_interval_ms": 5})

    def interval(others_bit_s: float) -> object:
        bench = J1939Bench()
        target = bench.target(125_000, others_bit_s)
        given = {"pgn": "FF34", "interval_ms": 5}
        return bench.run_script(script_of(bench.driver, target, "interval", given, **bench.present()))

    # 131 · (200 + 3 · 10) = 30,130 bit/s
    assert interval(94_000) is Written.VERIFIED
    with pytest.raises(BadArgument, match="FF34 every 5 ms 21 %"):
        interval(95_000)
