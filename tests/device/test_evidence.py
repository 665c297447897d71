"""Evidence for the effect of verbs: restart, reset, angles and samples."""

from dataclasses import replace
from math import radians
from typing import Any

import pytest

from imud.contracts.command import VerbResult
from imud.contracts.driver import SAMPLE_COUNTER
from imud.contracts.status import DeviceState
from imud.device import stream_transport
from imud.drivers import DRIVERS
from imud.model.sample import Measurement, Vector3
from imud.model.units import NS_PER_MS
from tests.device.test_settings import ModuleBench
from tests.support.fake_drivers import FAKE_MODULE_DRIVER, LinesCodec
from tests.support.stories import played


@pytest.fixture(autouse=True)
def fake_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the fake driver."""
    monkeypatch.setattr(stream_transport, "DRIVERS", {**dict(DRIVERS), "fake-module": FAKE_MODULE_DRIVER})


async def result_of(bench: ModuleBench, name: str, **arguments: Any) -> VerbResult:
    await bench.until(lambda: bench.device.state in (DeviceState.RUNNING, DeviceState.SILENT))
    answer = await bench.doing(bench.device.act(name, arguments))
    assert isinstance(answer, VerbResult)
    return answer


@pytest.mark.parametrize("ignores", [False, True])
@played(ModuleBench)
async def test_a_restart_is_verified_by_the_device_counter(bench: ModuleBench, ignores: bool) -> None:
    await bench.pass_s(3)
    bench.module.silent = {"RESTART"} if ignores else set()
    found = await result_of(bench, "restart")
    seen = "the device counter continued, so the device has ignored the command"
    assert (found.verified, found.evidence) == ((False, seen) if ignores else (True, "the device counter restarted"))
    if not ignores:  # the device loses a setting that it has not saved
        await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=False))
        lost = '; the restart changed settings: mode is "6-axis", was "9-axis"'
        assert (await result_of(bench, "restart")).evidence == "the device counter restarted" + lost
    assert await bench.doing(bench.device._transport.samples.has_restarted()) is not ignores
    applied = await bench.doing(bench.device.settings.apply({"mounting": "x_up"}, save=True))
    assert (applied.restarted, applied.problem) == ((False, f"restart: {seen}") if ignores else (True, ""))


@pytest.mark.parametrize("pause_ms", [0, 200, 500])
def test_pause_without_counter_is_not_evidence(pause_ms: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Modbus, CANopen and J1939 have no counter. A rejected request causes no pause."""
    driver = replace(FAKE_MODULE_DRIVER, tick_ns=SAMPLE_COUNTER)
    monkeypatch.setattr(stream_transport, "DRIVERS", {**dict(DRIVERS), "fake-module": driver})
    bench = ModuleBench()
    sample = bench.module.sample
    bench.module.sample = lambda: (  # type: ignore[method-assign]
        sample() if bench.clock.now_ns() - bench.module._boot_ns >= pause_ms * NS_PER_MS else None
    )

    async def story() -> None:
        await bench.pass_s(3)
        found = await result_of(bench, "restart")
        assert (found.verified, found.failed) == (False, False)
        assert found.evidence == "the device has no counter that shows a restart"

    bench.play(story)


@pytest.mark.parametrize(
    ("flash", "unsaved", "verified", "evidence"),
    [
        ("9-axis", False, False, "the device reports the same settings before and after it"),
        ("6-axis", False, True, 'mode is "6-axis", was "9-axis"'),
        ("6-axis", True, False, "a restart alone loses the settings that were not saved"),
    ],
)
@played(ModuleBench)
async def test_a_reset_is_verified_by_changed_settings(
    bench: ModuleBench, flash: str, unsaved: bool, verified: bool, evidence: str
) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    if unsaved:
        await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=False))
    bench.module.set["mode"], bench.module.flash["mode"] = "9-axis", flash
    found = await result_of(bench, "factory_reset")
    assert found.verified is verified
    assert found.evidence.startswith(evidence)
    assert not bench.status.unsaved


@played(ModuleBench)
async def test_a_reset_of_a_device_without_reports_is_not_verified(bench: ModuleBench) -> None:
    bench.module.silent = {"GET"}
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    found = await result_of(bench, "factory_reset")
    assert (found.verified, found.evidence) == (False, "the device reports no settings after it")


@played(ModuleBench)
async def test_the_log_has_no_warning_about_a_requested_change(
    bench: ModuleBench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "imud")
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=False))
    records = [(r.levelname, r.getMessage()) for r in caplog.records if "settings of the device" in r.getMessage()]
    assert [level for level, _ in records] == ["INFO"], records


@pytest.mark.parametrize("sends", [False, True])
@played(ModuleBench)
async def test_samples_are_evidence_only_if_none_arrived_before(bench: ModuleBench, sends: bool) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.pass_s(1)
    if sends:
        once, wake = await result_of(bench, "once"), await result_of(bench, "wake")
        assert (once.verified, once.evidence) == (False, "the device also sent samples before the command")
        assert (wake.verified, wake.evidence, wake.not_saved) == (
            False,
            "the device also sent samples before the command",
            "not saved; run `imud command bow save`",
        )
        return
    bench.module.sample = lambda: None  # type: ignore[method-assign]  # it is silent
    for name in ("once", "wake"):
        found = await result_of(bench, name)
        assert (found.verified, found.failed) == (False, True)
        assert found.evidence == "no sample arrived; check the output of the device"


@pytest.mark.parametrize(
    ("angle_deg", "yaw_deg", "rate_deg_s", "verified", "evidence"),
    [
        (30.0, 30.4, 0.0, True, "yaw differs by 0.40° from the set value"),
        (-179.9, 179.9, 0.0, True, "yaw differs by 0.20° from the set value"),
        (30.0, 31.1, 0.0, False, "yaw differs by 1.10°"),
        (30.0, -9.9, 0.0, False, "yaw differs by 39.90°"),
        (30.0, 30.0, 60.0, False, "the device moves: it turns at 60"),
        (190.0, 0.0, 0.0, False, "the device confirmed it, and no sample shows its effect"),
    ],
)
def test_angles_are_compared_at_rest(
    angle_deg: float, yaw_deg: float, rate_deg_s: float, verified: bool, evidence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Turned(LinesCodec):
        def _event(self, line: str) -> Any:
            found = super()._event(line)
            if not isinstance(found, Measurement):
                return found
            gyro: Vector3 = (0.0, 0.0, radians(rate_deg_s))
            # the device turns after the command
            turn_deg = 0.0 if len(bench.module.commands) > commands else 40.0
            euler = 0.0, 0.0, radians(yaw_deg + turn_deg)
            return Measurement(found.size_bytes, 0, found.dev_ticks, gyro_rad_s=gyro, euler_rad=euler)

    driver = replace(FAKE_MODULE_DRIVER, make_codec=lambda ledger, _options: Turned(ledger))
    monkeypatch.setattr(stream_transport, "DRIVERS", {**dict(DRIVERS), "fake-module": driver})
    bench = ModuleBench()
    commands = 1000

    async def story() -> None:
        nonlocal commands
        await bench.pass_s(3)
        commands = len(bench.module.commands)
        found = await result_of(bench, "turn", angle_deg=angle_deg)
        assert found.verified is verified
        assert found.evidence.startswith(evidence)

    bench.play(story)


def test_angles_that_agreed_before_are_not_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that ignores the command sends the same angles."""

    class Level(LinesCodec):
        def _event(self, line: str) -> Any:
            event = super()._event(line)
            if not isinstance(event, Measurement):
                return event
            gyro: Vector3 = (0.0, 0.0, 0.0)
            return Measurement(event.size_bytes, 0, event.dev_ticks, gyro_rad_s=gyro, euler_rad=(0.0, 0.0, 0.0))

    driver = replace(FAKE_MODULE_DRIVER, make_codec=lambda ledger, _options: Level(ledger))
    monkeypatch.setattr(stream_transport, "DRIVERS", {**dict(DRIVERS), "fake-module": driver})
    bench = ModuleBench()

    async def story() -> None:
        await bench.pass_s(3)
        result = await result_of(bench, "turn", angle_deg=0.3)
        assert (result.verified, result.failed) == (False, False)
        assert result.evidence.endswith("as before the command, so the samples do not show its effect")

    bench.play(story)


def test_each_verb_with_an_effect_has_evidence_or_a_reason() -> None:
    reads = {"read", "status", "installation_status", "ins_config"}
    for driver in DRIVERS.values():
        for name, verb in driver.verbs.items():
            assert (verb.proof == "value") == (name in reads), f"{driver.name} {name}"
            states = verb.proof in ("none", "script")
            assert bool(verb.evidence) >= states, f"{driver.name} {name}"
