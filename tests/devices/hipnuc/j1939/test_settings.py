"""The table of settings, read and written over all kinds of modules."""

import msgspec
import pytest

from imud.contracts.device_settings import Effect, Written
from imud.devices.hipnuc.j1939.driver import DRIVER
from imud.devices.hipnuc.j1939.settings import SETTINGS
from imud.errors import BadArgument
from imud.sim.hipnuc.j1939 import J1939_VARIANTS, J1939Variant
from tests.support.simulated_modules import J1939Bench

PGNS = ("ff2f", "ff34", "ff37", "ff3a", "ff3d", "ff41", "ff43", "ff46", "ff4a")
VALUES: dict[str, tuple[object, ...]] = {
    **{f"{pgn}_interval_ms": (5, 1000) for pgn in PGNS},
    "x_reversed": (True, False),
    "y_reversed": (True, False),
    "bit_rate": (500_000,),
    "address": (128, 1),
}


@pytest.fixture(params=J1939_VARIANTS)
def bench(request: pytest.FixtureRequest) -> J1939Bench:
    made = J1939Bench(boot_ms=100, variant=J1939_VARIANTS[request.param])
    made.run(200_000_000)
    return made


def test_the_table_has_order_effects_and_types() -> None:
    assert DRIVER.device_settings is SETTINGS
    assert list(VALUES) == list(SETTINGS.table)
    pending = {name for name, one in SETTINGS.table.items() if one.effect is Effect.AFTER_RESTART}
    moving = {name for name, one in SETTINGS.table.items() if one.connection}
    assert pending == moving == {"bit_rate", "address"}
    for name, values in VALUES.items():
        for value in values:
            assert msgspec.convert(value, SETTINGS.table[name].type) == value
    for name, wrong in {"ff34_interval_ms": 0, "ff41_interval_ms": 1001, "bit_rate": 100_000, "address": 129}.items():
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(wrong, SETTINGS.table[name].type)


def test_present_values_are_read_and_nothing_is_written(bench: J1939Bench) -> None:
    told = bench.module.hardware.variant.reads != "ignored"
    sent = {f"{pgn}_interval_ms": 100 for pgn in ("ff34", "ff37", "ff3d", "ff41")}  # others are not on
    rest = {"x_reversed": False, "y_reversed": False, "bit_rate": 500_000, "address": 8}
    assert bench.present() == (sent | rest if told else {})
    assert all(data[2:] == bytes.fromhex("03 00 01 00 00 00") for _, data in bench.sent)


@pytest.mark.parametrize("name", VALUES)
def test_a_setting_written_saved_and_restarted_is_what_is_read(name: str) -> None:
    """Each kind of module takes one setting of each form; the real one takes all."""
    every = name in ("ff34_interval_ms", "x_reversed", "bit_rate", "address")
    for variant in J1939_VARIANTS.values() if every else [J1939Variant()]:
        bench = J1939Bench(boot_ms=100, variant=variant)
        bench.run(200_000_000)
        for value in VALUES[name]:
            written = bench.set_for_good(name, value)
            is_read = variant.reads != "ignored"
            assert (written in (Written.VERIFIED, Written.PENDING)) == is_read
            if is_read:
                assert SETTINGS.table[name].agrees(value, bench.present()[name])


def test_values_that_do_not_go_together_are_refused() -> None:
    bench = J1939Bench()
    with pytest.raises(BadArgument, match="expected 125000, the rate of the bus, got 500000"):
        SETTINGS.check(bench.target(125_000), {"bit_rate": 500_000})
    fast = {f"{pgn}_interval_ms": 5 for pgn in ("ff34", "ff37", "ff3d", "ff41")}  # 131 bits · 200 · 4 = 104,800 bit/s
    SETTINGS.check(bench.target(125_000), fast)
    with pytest.raises(BadArgument, match=r"got 105 % of that: FF34 every 5 ms 21 %, .*"):
        SETTINGS.check(bench.target(125_000), fast | {"ff43_interval_ms": 5})


def test_an_interval_that_the_bus_cannot_carry_is_refused_by_the_action_too() -> None:
    bench = J1939Bench()
    action = DRIVER.actions["interval"]

    def interval(others_bit_s: float) -> object:
        arguments = action.arguments({"pgn": "FF34", "interval_ms": 5})
        return bench.run_script(action.script(bench.target(125_000, others_bit_s), arguments))

    # 131 · (200 + 3 · 10) = 30,130 bit/s
    assert interval(94_000) is Written.VERIFIED
    with pytest.raises(BadArgument, match="FF34 every 5 ms 21 %"):
        interval(95_000)
