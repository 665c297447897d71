"""Each interpretation of the manual as a behavior of the simulated device: rate, factory reset, flash, refusals."""

import pytest

from imud.sim.hipnuc.uart_settings import VARIANTS, Behaviour, ModuleSettings, Output, RateChange, ResetEffect
from tests.support.simulated_modules import HipnucUartBench, hardware_of


def bench_of(settings: ModuleSettings | None = None, **behaviour: object) -> HipnucUartBench:
    return HipnucUartBench(settings, hardware_of(Behaviour(**behaviour)))  # type: ignore[arg-type]  # names of fields


@pytest.mark.parametrize(
    ("change", "rate_of_answer", "rate_afterwards"),
    [
        (RateChange.AFTER_RESTART, 115_200, 115_200),
        (RateChange.BEFORE_ANSWER, 921_600, 921_600),
        (RateChange.AFTER_ANSWER, 115_200, 921_600),
    ],
)
def test_when_the_rate_changes(change: RateChange, rate_of_answer: int, rate_afterwards: int) -> None:
    bench = bench_of(ModuleSettings(hi91=Output()), rate_change=change)
    bench.module.receive(b"SERIALCONFIG 921600\r\n", bench.now_ns)
    assert bench.text(1.0) == ["OK"]
    assert bench.module.baud == rate_of_answer
    bench.wait(20.0)
    assert bench.module.baud == rate_afterwards
    bench.reboot()
    assert bench.module.baud == 115_200  # the baud rate was not saved


@pytest.mark.parametrize(
    ("effect", "rate", "mode", "answer"),
    [
        (ResetEffect.RATE_AFTER_RESTART, 921_600, 0, ["OK"]),
        (ResetEffect.AFTER_RESTART, 921_600, 1, ["OK"]),
        (ResetEffect.BEFORE_ANSWER, 115_200, 0, ["OK"]),
    ],
)
def test_when_a_factory_reset_acts(effect: ResetEffect, rate: int, mode: int, answer: list[str]) -> None:
    bench = bench_of(ModuleSettings(baud=921_600, att_mode=1), factory_reset=effect)
    assert bench.ask("FRESET") == answer
    assert (bench.module.baud, bench.module.settings.att_mode) == (rate, mode)
    bench.reboot()
    assert (bench.module.settings, bench.module.baud) == (ModuleSettings(), 115_200)


def test_slow_flash_quiet_refusals_and_all_variants() -> None:
    bench = bench_of(flash_ms=2000)
    bench.wait(50.0)
    bench.module.receive(b"SAVECONFIG\r\n", bench.now_ns)
    assert bench.wait(1900.0)[1:] == []  # one frame may have been on the wire
    assert bench.text(150.0) == ["OK"]
    assert bench.frames(500.0)
    assert bench.ask("LOG ENABLE") == ["OK"]

    bench = bench_of(quiet_ms=300)
    assert bench.ask("LOG ENABLE") == ["OK"]
    assert bench.frames(240.0) == []
    assert bench.frames(80.0)

    bench = bench_of(refuses=("CONFIG ATT",), ignores=("LOG MAGCONFIG",))
    assert bench.ask("CONFIG ATT MODE 1") == ["ERR"]
    assert bench.module.settings.att_mode == 0
    assert bench.ask("LOG MAGCONFIG") == []
    assert bench.ask("LOG ENABLE") == ["OK"]

    assert {variant.rate_change for variant in VARIANTS.values()} == set(RateChange)
    assert {variant.factory_reset for variant in VARIANTS.values()} == set(ResetEffect)
