"""The table of settings, read and written over all kinds of nodes."""

import msgspec
import pytest

from imud.contracts.device_settings import Effect, Written
from imud.devices.hipnuc.canopen.driver import DRIVER
from imud.devices.hipnuc.canopen.settings import SETTINGS
from imud.errors import BadArgument
from imud.sim.hipnuc.canopen import NODE_VARIANTS, NodeSettings, NodeVariant
from tests.support.simulated_modules import CanopenBench

TPDOS = (1, 2, 3, 4, 6, 7)
VALUES: dict[str, tuple[object, ...]] = {
    **{f"tpdo{tpdo}_interval_ms": (5, 1000, 0) for tpdo in TPDOS},
    **{f"tpdo{tpdo}_by": ("sync", "timer") for tpdo in TPDOS},
    "incli_x_reversed": (True, False),
    "incli_y_reversed": (True, False),
    "heartbeat_ms": (500, 0),
    "bit_rate": (500_000,),
    "node": (127, 1),
}
DELIVERED = {
    **{f"tpdo{tpdo}_interval_ms": 50 if tpdo == 6 else 10 for tpdo in TPDOS},
    **{f"tpdo{tpdo}_by": "timer" for tpdo in TPDOS},
    "incli_x_reversed": False, "incli_y_reversed": False, "heartbeat_ms": 0, "bit_rate": 500_000, "node": 8,
}  # fmt: skip


@pytest.fixture(params=NODE_VARIANTS)
def bench(request: pytest.FixtureRequest) -> CanopenBench:
    made = CanopenBench(NodeSettings(), boot_ms=100, variant=NODE_VARIANTS[request.param])
    made.run(200_000_000)
    return made


def test_the_table_has_order_effects_and_types() -> None:
    assert DRIVER.device_settings is SETTINGS
    assert list(VALUES) == list(SETTINGS.table)
    pending = {name for name, one in SETTINGS.table.items() if one.effect is Effect.AFTER_RESTART}
    moving = {name for name, one in SETTINGS.table.items() if one.connection}
    assert pending == moving == {"bit_rate", "node"}
    for name, values in VALUES.items():
        for value in values:
            assert msgspec.convert(value, SETTINGS.table[name].type) == value
    wrong = {"tpdo1_interval_ms": 1001, "tpdo1_by": "remote", "bit_rate": 800_000, "node": 128, "incli_x_reversed": 1}
    for name, value in wrong.items():
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(value, SETTINGS.table[name].type)


def test_present_values_are_read_and_nothing_is_written(bench: CanopenBench) -> None:
    told = bench.module.hardware.variant.reads == "answered"
    assert bench.present() == (DELIVERED if told else {})
    assert all(data[0] == 0x40 for _, data in bench.sent)


@pytest.mark.parametrize("name", VALUES)
def test_a_setting_written_saved_and_restarted_is_what_is_read(name: str) -> None:
    """Each kind of node takes one setting of each form; the real one takes all."""
    every = name in ("tpdo1_interval_ms", "tpdo1_by", "bit_rate", "node")
    for variant in NODE_VARIANTS.values() if every else [NodeVariant()]:
        bench = CanopenBench(NodeSettings(), boot_ms=100, variant=variant)
        bench.run(200_000_000)
        for value in VALUES[name]:
            written = bench.set_for_good(name, value)
            is_read = variant.reads == "answered"
            assert (written in (Written.VERIFIED, Written.PENDING)) == is_read
            if is_read:
                assert SETTINGS.table[name].agrees(value, bench.present()[name])


def test_values_that_do_not_go_together_are_refused() -> None:
    target = CanopenBench().target(125_000, 30_000.0)
    SETTINGS.check(target, DELIVERED | {"bit_rate": 125_000})
    with pytest.raises(BadArgument, match="expected 125000, the rate of the bus, got 500000"):
        SETTINGS.check(target, {"bit_rate": 500_000})
    with pytest.raises(BadArgument, match=r"tpdo1_interval_ms: expected 0 or 5 … 1000, got 4"):
        SETTINGS.check(target, {"tpdo1_interval_ms": 4})
    fast = {f"tpdo{tpdo}_interval_ms": 5 for tpdo in TPDOS}  # 586 bits · 200 = 117,200 bit/s
    with pytest.raises(BadArgument, match=r"got 118 % of that: .*TPDO4 every 5 ms 17.8 %.*; other devices 24 %"):
        SETTINGS.check(target, fast)
    SETTINGS.check(target, fast | {f"tpdo{tpdo}_by": "sync" for tpdo in TPDOS})  # sent when SYNC comes, which does not
