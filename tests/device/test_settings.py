"""Settings of a module in virtual time: comparison at start, replug and restart, apply, repair."""

import asyncio
from collections.abc import Callable, Coroutine
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.config.model import DeviceConfig
from imud.contracts.condition import ReasonCode
from imud.contracts.driver import SAMPLE_COUNTER
from imud.contracts.setting import AppliedSettings, OnDifference, SettingsState, SettingsStatus, StepOutcome
from imud.contracts.status import DeviceState
from imud.device import stream_transport
from imud.device.settings_writes import LATE_EFFECT_READS, LATE_EFFECT_S
from imud.drivers import DRIVERS
from imud.links.memory import MemoryOptions
from imud.model.errors import BadArgument, CommandError
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from tests.support.device_rig import DeviceRig, DeviceRigs
from tests.support.device_rig import play as play_rigs
from tests.support.event_loops import VirtualClock
from tests.support.fake_drivers import FACTORY, FAKE_MODULE_DRIVER, FAKE_SETTINGS, FakeModule
from tests.support.polled_bus_bench import PolledBusBench, on_i2c
from tests.support.stories import played

IDENTIFY_AGAIN_S = (5, 30, 120, 300)
LIMIT_ASKED = 40
LIMIT_ITSELF = 4

STEP_S, LONG_STEP_S = 0.05, 0.5
"""Period of the samples, s; during long waits the second value."""


@pytest.fixture(autouse=True)
def fake_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the fake driver."""
    monkeypatch.setattr(stream_transport, "DRIVERS", {**dict(DRIVERS), "fake-module": FAKE_MODULE_DRIVER})


class AtOnce(ThreadPoolExecutor):
    """Run the function of a thread immediately: virtual time does not wait for threads."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        try:
            done.set_result(fn(*args, **kwargs))
        except OSError as error:
            done.set_exception(error)
        return done


class ModuleBench:
    """One module with declared settings and its events."""

    def __init__(
        self,
        on_difference: str = "report",
        declared: dict[str, Any] | None = None,
        state_dir: Path | None = None,
        **module: Any,
    ) -> None:
        """`module` contains attributes of the module."""
        self.clock = VirtualClock()
        self.module = FakeModule(self.clock.now_ns)
        for name, value in module.items():
            setattr(self.module, name, value)
        self.rigs = DeviceRigs(self.clock.host, state_dir=state_dir)
        config = DeviceConfig(
            "bow", "fake-module", None, True, "memory", MemoryOptions(name="/dev/fake", baud=115200),
            declared=msgspec.convert(declared, FAKE_SETTINGS.declarable) if declared else None,
            on_difference=OnDifference(on_difference),
        )  # fmt: skip
        self.rig = self.rigs.add(config, self.module)
        self.device = self.rig.device

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def told(_made: list[DeviceRig]) -> None:
            asyncio.get_running_loop().set_default_executor(AtOnce())
            await self.rig.turn(lambda: self.module.listening)
            await story()

        play_rigs(self.rigs, told, self.clock)

    async def until(self, holds: Callable[[], object], what: str = "the condition", limit_s: float = 30.0) -> None:
        """Let time pass with a sample in each step."""
        step_s = STEP_S if limit_s < 100 else LONG_STEP_S
        await self.rig.until(holds, what, limit_s, step=self.module.sample, step_s=step_s)

    async def pass_s(self, duration_s: float) -> None:
        end_ns = self.clock.now_ns() + int(duration_s * 1e9)
        await self.until(lambda: self.clock.now_ns() >= end_ns, limit_s=duration_s + 10)

    async def doing(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Return the result of `work`, with samples in the meantime."""
        task = asyncio.ensure_future(work)
        await self.until(task.done)
        return task.result()

    @property
    def status(self) -> SettingsStatus:
        found = self.device.status().declared
        assert found is not None
        return found

    def is_in(self, state: SettingsState) -> bool:
        return self.status.state is state

    @property
    def told(self) -> list[Event]:
        return [e for e in self.rig.events if e.kind is EventKind.CONFIGURATION and "settings" in e.message]

    @property
    def messages(self) -> list[str]:
        """Texts of these events, without events about changed settings."""
        return [e.message for e in self.told if "settings of the device" not in e.message]

    def repaired(self, times: int) -> bool:
        """Return whether imud has made this number of repairs."""
        return self.status.repairs == times

    def saved(self, times: int) -> bool:
        return self.module.saves == times

    def written(self) -> list[str]:
        """Commands that set or save a value."""
        return [one for one in self.module.commands if one.startswith(("SET", "SAVE", "RESTART"))]


# --- report -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("between", "reads_again"),
    [
        (lambda _bench: asyncio.sleep(0), False),
        (lambda bench: bench.pass_s(11), True),
        (lambda bench: bench.doing(bench.device.act("save", {})), True),
        (lambda bench: bench.doing(bench.device.settings.report(fresh=True)), False),
    ],
    ids=["immediately", "late", "after a command", "after a read"],
)
@played(ModuleBench)
async def test_apply_uses_the_values_of_a_recent_plan(
    bench: ModuleBench, between: Callable[[ModuleBench], Coroutine[Any, Any, Any]], reads_again: bool
) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.doing(bench.device.settings.plan({"mode": "9-axis"}, save=False))
    await between(bench)
    before = len(bench.module.commands)
    applied = await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=False))
    assert outcomes(applied) == {"mode": StepOutcome.VERIFIED}
    # one read-back, which the status uses too
    assert bench.module.commands[before:] == [*["GET"] * reads_again, 'SET mode="9-axis"', "GET"]
    assert bench.device.status().settings["mode"] == '"9-axis"'
    assert (applied.not_saved, bench.status.unsaved) == ("not saved; run `imud command bow save`", True)
    await bench.doing(bench.device.act("save", {}))
    assert not bench.status.unsaved


@played(ModuleBench)
async def test_the_value_in_flash_is_inferred_from_starts_and_saves(bench: ModuleBench) -> None:
    async def mode() -> tuple[str, object, object]:
        report = await bench.doing(bench.device.settings.report(fresh=False))
        one = next(one for one in report.settings if one.name == "mode")
        return str(one.saved_state), one.saved, one.actual

    async def lost_after(mode: str) -> tuple[object, ...]:
        await bench.doing(bench.device.settings.apply({"mode": mode}, save=False))
        return bench.status.unsaved, bench.status.lost_at_power_off, bench.status.flash_unknown

    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.pass_s(2)
    assert await mode() == ("unknown", None, "6-axis")  # read once after detection, without declared settings
    assert await lost_after("9-axis") == (True, {"mode": "9-axis"}, ("mode",)), "the flash can contain 9-axis"
    assert await lost_after("6-axis") == (True, {}, ())
    await bench.doing(bench.device.act("save", {}))
    assert await mode() == ("same", "6-axis", "6-axis")
    assert await lost_after("9-axis") == (True, {"mode": "9-axis"}, ())
    assert await mode() == ("differs", "6-axis", "9-axis")
    await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=True))
    assert await mode() == ("same", "9-axis", "9-axis")
    await bench.pass_s(12)
    bench.module.restart()
    await bench.pass_s(2)
    assert await mode() == ("same", "9-axis", "9-axis")


def test_a_save_that_may_have_no_effect_proves_nothing_about_the_flash(monkeypatch: pytest.MonkeyPatch) -> None:
    table = replace(FAKE_SETTINGS, save_is_certain=False)
    driver = replace(FAKE_MODULE_DRIVER, device_settings=table)
    monkeypatch.setattr(stream_transport, "DRIVERS", {**dict(DRIVERS), "fake-module": driver})
    bench = ModuleBench()

    async def mode() -> tuple[str, object, object]:
        report = await bench.doing(bench.device.settings.report(fresh=False))
        one = next(one for one in report.settings if one.name == "mode")
        return str(one.saved_state), one.saved, one.actual

    async def story() -> None:
        await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
        await bench.pass_s(2)
        await bench.doing(bench.device.act("save", {}))
        assert await mode() == ("unknown", None, "6-axis")
        applied = await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=True))
        assert applied.ends == ["save to flash: sent, not verified: imud cannot read the flash"]
        assert await mode() == ("unknown", None, "9-axis")
        bench.device.settings.forget()
        await bench.doing(bench.device.act("save", {}))
        await bench.doing(bench.device.settings.report(fresh=True))
        assert await mode() == ("unknown", None, "9-axis")
        await bench.pass_s(12)
        bench.module.restart()
        await bench.pass_s(2)
        assert await mode() == ("same", "9-axis", "9-axis")  # the values after a start are the values of the flash

    bench.play(story)


@played(ModuleBench)
async def test_without_declared_settings_imud_reads_the_settings_after_a_restart(bench: ModuleBench) -> None:
    await bench.pass_s(5)
    assert bench.is_in(SettingsState.UNDECLARED)
    assert bench.module.commands == ["WHO", "GET"]  # identity and settings as text
    await bench.pass_s(20)
    assert bench.messages == []
    bench.module.set["mode"] = bench.module.flash["mode"] = "9-axis"  # by another program
    bench.module.restart()
    await bench.pass_s(5)
    assert bench.module.commands == ["WHO", "GET", "GET"]
    assert [event.message for event in bench.told] == ['settings of the device changed: mode is "9-axis", was "6-axis"']


@played(lambda: ModuleBench(declared={"mode": "6-axis", "output": {"a": 100}, "secret": 5}))
async def test_equal_settings_are_reported_as_agreeing(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.is_in(SettingsState.AGREE))
    await bench.pass_s(5)
    assert (bench.module.commands, bench.status.unverified) == (["WHO", "GET"], ("secret",))
    assert (bench.messages, bench.written()) == ([], [])


@played(lambda: ModuleBench(declared={"mode": "9-axis", "offset_deg": 1.5}))
async def test_a_difference_raises_one_event_and_no_write(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.is_in(SettingsState.DIFFER))
    await bench.pass_s(100)
    found = 'mode is "6-axis", declared "9-axis", offset_deg is 0.0, declared 1.5'
    message = f"settings differ from the declared settings: {found}"
    assert (bench.messages, bench.told[0].detail) == ([message], {"mode": '"6-axis"', "offset_deg": "0.0"})
    assert (bench.status.differences["mode"].declared, bench.written()) == ("9-axis", [])
    assert [reason.code for reason in bench.device.status().reasons] == [ReasonCode.SETTING] * 2
    asked = bench.module.commands.count("GET")
    await bench.doing(bench.device.act("set_mode", {"mode": "6-axis"}))
    await bench.until(lambda: bench.module.commands.count("GET") > asked)
    await bench.pass_s(2)
    assert bench.messages == [message]  # the value is as before


@played(lambda: ModuleBench(declared={"mode": "6-axis"}))
async def test_settings_are_compared_after_replug_restart_and_command_but_not_after_a_save(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.is_in(SettingsState.AGREE))
    before = len(bench.module.commands)
    await bench.doing(bench.device.act("save", {}))
    await bench.pass_s(20)
    assert (bench.module.commands[before:], bench.is_in(SettingsState.AGREE)) == (["SAVE"], True)
    bench.module.disappear()
    await bench.rig.until(lambda: bench.device.state is DeviceState.MISSING)
    assert bench.is_in(SettingsState.UNKNOWN)
    bench.module.set["mode"] = "9-axis"
    bench.module.appear()
    await bench.until(lambda: bench.is_in(SettingsState.DIFFER), "after a replug")
    await bench.pass_s(20)
    bench.module.restart()  # without a request: flash contains the declared settings
    await bench.until(lambda: bench.is_in(SettingsState.AGREE), "after a restart")
    await bench.doing(bench.device.act("set_mode", {"mode": "9-axis"}))
    await bench.until(lambda: bench.is_in(SettingsState.DIFFER), "after a command")
    await bench.doing(bench.device.act("set_mode", {"mode": "6-axis"}))
    await bench.until(lambda: bench.is_in(SettingsState.AGREE), "after another one")
    await bench.pass_s(2.2)  # time in which a restart by a script of imud would be visible
    asked = bench.module.commands.count("GET")
    bench.module.restart()
    await bench.until(lambda: bench.module.commands.count("GET") > asked, limit_s=3)
    differ = 'settings differ from the declared settings: mode is "9-axis", declared "6-axis"'
    assert bench.messages == [differ, differ, "settings agree with the declared settings again"]


@pytest.mark.parametrize("declared", [None, {"mode": "6-axis"}])
@played(lambda declared: ModuleBench(declared=declared))
async def test_restarts_after_commands_are_counted_as_requested(bench: ModuleBench, declared: object) -> None:
    await bench.pass_s(60)
    counts = list[tuple[int, int]]()
    for pause_s in (0.1, 5.0, 30.0, None):
        if pause_s is not None:
            await bench.doing(bench.device.act("set_mode", {"mode": "6-axis"}))
            await bench.pass_s(pause_s)
        bench.module.restart()
        await bench.pass_s(30)
        status = bench.device.status()
        counts.append((status.clock.resets, status.resets_requested))
    assert counts == [(1, 1), (2, 2), (3, 2), (4, 2)]
    for _ in range(3):  # imud reads the settings after each restart
        bench.module.restart()
        await bench.pass_s(4)
    status = bench.device.status()
    assert (status.clock.resets, status.resets_requested, status.recent and status.recent.restarts) == (7, 2, 5)


@played(lambda: ModuleBench(declared={"mode": "6-axis"}, silent={"GET"}))
async def test_failed_reads_of_settings_are_repeated_a_few_times(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.messages)
    assert bench.messages == ["cannot read the settings after 3 tries: GET: expected OK, got nothing"]
    await bench.pass_s(sum(IDENTIFY_AGAIN_S) + 10)  # with four more queries of the identity
    asked = bench.module.commands.count("GET")
    await bench.pass_s(2 * IDENTIFY_AGAIN_S[-1])
    assert asked + 1 <= bench.module.commands.count("GET") <= asked + 2
    assert bench.is_in(SettingsState.UNKNOWN)
    assert "cannot read the settings" in bench.status.problem
    bench.module.silent = set()
    bench.module.restart()
    await bench.until(lambda: bench.is_in(SettingsState.AGREE))
    assert bench.status.problem == ""


# --- apply ------------------------------------------------------------------------------------------------------------


@played(lambda: ModuleBench("apply", {"mode": "9-axis", "mounting": "x_up", "secret": 5}))
async def test_apply_does_not_write_flash(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.status.repairs)
    await bench.until(lambda: list(bench.status.differences) == ["mounting"])
    await bench.pass_s(50)
    assert bench.written() == ['SET mode="9-axis"', "SET secret=5"]
    assert (bench.module.flash, bench.status.flash_writes) == (FACTORY, 0)
    assert "mounting needs a save and a restart" in bench.status.problem
    last = bench.told[-1]
    assert last.message == ('settings: mode set to "9-axis" (was "6-axis"), secret set to 5: sent, not verified')
    assert last.detail == {"saved": False, "mode": "verified", "secret": "sent, not verified"}
    bench.module.restart()
    await bench.until(lambda: bench.module.set["mode"] == "9-axis", "set again after a restart")
    await bench.until(lambda: bench.module.set["secret"] == 5)


EVERYTHING = {"mode": "9-axis", "mounting": "x_up", "output": {"b": 50}, "secret": 5}


@played(lambda: ModuleBench("apply_and_save", EVERYTHING))
async def test_apply_and_save_writes_flash_once(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.status.repairs)
    await bench.until(lambda: bench.is_in(SettingsState.AGREE))
    assert bench.written() == [
        'SET mode="9-axis"', 'SET output={"b":50}', 'SET mounting="x_up"', "SET secret=5", "SAVE", "RESTART",
    ]  # fmt: skip
    assert (bench.module.mounting, bench.module.flash["output"]) == ("x_up", {"a": 100, "b": 50})
    await bench.pass_s(300)
    assert bench.module.saves == bench.status.flash_writes == bench.status.repairs == 1
    assert bench.told[-1].message.endswith("the device has no counter that shows a restart")
    bench.module.restart()
    await bench.pass_s(300)
    assert bench.module.saves == 1


@pytest.mark.parametrize("reverts", [False, True])
def test_a_silence_without_a_counter_can_be_a_restart(reverts: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = replace(FAKE_MODULE_DRIVER, tick_ns=SAMPLE_COUNTER)
    monkeypatch.setattr(stream_transport, "DRIVERS", {**dict(DRIVERS), "fake-module": driver})
    bench = ModuleBench(declared={"mode": "9-axis"})

    async def story() -> None:
        await bench.until(lambda: bench.is_in(SettingsState.DIFFER))
        await bench.doing(bench.device.settings.apply(None, save=False))
        sample, bench.module.sample = bench.module.sample, lambda: None  # type: ignore[method-assign]
        await bench.until(lambda: bench.device.state is DeviceState.SILENT)
        assert bench.status.unsaved
        bench.module.set = dict(bench.module.flash if reverts else bench.module.set)
        bench.module.sample = sample  # type: ignore[method-assign]
        await bench.pass_s(3)
        assert (bench.status.unsaved, bench.is_in(SettingsState.DIFFER)) == (not reverts, reverts)

    bench.play(story)


@played(lambda: ModuleBench("apply_and_save", {"mode": "9-axis"}))
async def test_commands_without_unsaved_changes_cause_no_flash_write(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.status.repairs == 1 and bench.is_in(SettingsState.AGREE))
    await bench.doing(bench.device.act("save", {}))
    await bench.pass_s(300)
    assert bench.module.saves == 2
    await bench.doing(bench.device.act("set_mode", {"mode": "9-axis"}))
    await bench.pass_s(300)
    assert bench.module.saves == 2
    await bench.doing(bench.device.act("set_mode", {"mode": "6-axis"}))
    await bench.until(lambda: bench.status.repairs == 2)
    await bench.pass_s(300)
    assert bench.module.saves == 3


@played(lambda: ModuleBench("apply_and_save", {"output": {"b": 50}}))
async def test_a_change_that_a_command_saved_is_not_written_again(bench: ModuleBench) -> None:
    async def change_and_save() -> None:
        await asyncio.gather(bench.device.act("set_mode", {"mode": "9-axis"}), bench.device.act("save", {}))

    await bench.until(lambda: bench.status.repairs == 1 and bench.is_in(SettingsState.AGREE))
    await bench.pass_s(300)
    await bench.doing(change_and_save())
    await bench.pass_s(300)
    assert (bench.module.flash["mode"], bench.module.saves) == ("9-axis", 2)


def test_a_saved_unreadable_value_is_not_written_in_the_next_run(tmp_path: Path) -> None:
    modules = []
    for _run in range(2):
        bench = ModuleBench("apply_and_save", {"secret": 5}, tmp_path)

        async def story(bench: ModuleBench = bench) -> None:
            await bench.until(lambda: bench.is_in(SettingsState.AGREE))
            await bench.pass_s(30)
            assert bench.status.flash_writes == 1

        bench.play(story)
        modules.append(bench.module)
    assert [module.saves for module in modules] == [1, 0]


@played(lambda: ModuleBench("apply_and_save", {"mode": "9-axis"}, silent={"SAVE"}))
async def test_a_failed_save_of_a_command_is_repeated(bench: ModuleBench) -> None:
    await bench.until(lambda: "not saved" in bench.status.problem)
    with pytest.raises(CommandError, match="SAVE: expected OK, got nothing"):
        await bench.doing(bench.device.act("save", {}))
    assert bench.module.flash == FACTORY
    bench.module.silent = set()
    await bench.until(lambda: bench.module.flash["mode"] == "9-axis", limit_s=90)
    await bench.until(lambda: bench.is_in(SettingsState.AGREE))
    assert bench.status.problem == ""


@played(lambda: ModuleBench("apply_and_save", {"mode": "9-axis", "secret": 5}))
async def test_each_replaced_module_gets_the_declared_settings_without_pause(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.module.saves == 1)
    for number, serial in enumerate(("B2", "C3", "D4"), start=2):
        bench.module.disappear()
        await bench.rig.until(lambda: bench.device.state is DeviceState.MISSING)
        bench.module.serial, bench.module.flash = serial, dict(FACTORY)
        bench.module.restart()
        bench.module.appear()
        await bench.until(partial(bench.repaired, number), limit_s=10)
        await bench.until(lambda: bench.is_in(SettingsState.AGREE), limit_s=10)
        assert f"another device: serial number {serial}" in " ".join(event.message for event in bench.rig.events)
        assert (bench.module.flash["mode"], bench.module.flash["secret"], bench.module.saves) == ("9-axis", 5, number)
        assert bench.status.flash_writes == 1  # writes of this module


@played(lambda: ModuleBench("apply", {"mode": "9-axis"}, forgets={"mode"}))
async def test_repeated_repairs_have_growing_pauses(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.status.repairs == 1)
    await bench.until(lambda: "read back" in bench.messages[-1])
    assert bench.messages[-1].endswith(
        'mode: wrote "9-axis", read back "6-axis"; the previous writes last until the device restarts'
    )
    times_s, reads, asked = [], [], bench.module.commands.count("GET")
    for number in range(2, 5):
        before_ns = bench.clock.now_ns()
        await bench.until(partial(bench.repaired, number), limit_s=1000)
        times_s.append((bench.clock.now_ns() - before_ns) / 1e9)
        asked, before = bench.module.commands.count("GET"), asked
        reads.append(asked - before)
    assert [round(time_s, -1) for time_s in times_s] == [10, 60, 600]
    # before and after the write, and in the time in which the effect can follow: no read in the pause
    assert reads[1:] == [2 + LATE_EFFECT_READS] * 2
    await bench.pass_s(LATE_EFFECT_S + 1)  # the last repair has ended
    bench.module.forgets = set()
    await bench.pass_s(3)
    bench.module.restart()
    await bench.pass_s(20)
    assert "the device loses its settings" in bench.status.problem
    assert bench.is_in(SettingsState.DIFFER)
    asked = bench.module.commands.count("GET")
    await bench.pass_s(3500)
    assert bench.module.commands.count("GET") == asked
    await bench.until(lambda: bench.is_in(SettingsState.AGREE), limit_s=200)


@played(lambda: ModuleBench("apply_and_save", {"mode": "9-axis"}))
async def test_flash_writes_of_imud_have_a_lower_limit_than_requests(bench: ModuleBench) -> None:
    for number in range(1, LIMIT_ITSELF + 1):
        await bench.until(partial(bench.saved, number), limit_s=4000)
        await bench.pass_s(3)
        bench.module.flash = dict(FACTORY)
        bench.module.restart()
    await bench.until(lambda: "not saved" in bench.messages[-1], limit_s=4000)
    assert "the limit of imud itself" in bench.status.problem
    assert bench.module.saves == LIMIT_ITSELF
    assert bench.module.set["mode"] == "9-axis"  # imud sets it anyway
    assert (await bench.doing(bench.device.settings.apply({"mode": "6-axis"}, save=True))).saved
    assert bench.status.flash_writes_day == LIMIT_ITSELF + 1


# --- asked for --------------------------------------------------------------------------------------------------------


@played(ModuleBench)
async def test_plan_and_apply_of_given_values(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    for given, message in (
        ({"mode": "x"}, 'mode: expected one of "6-axis", "9-axis", got "x"'),
        (None, "expected values, or `settings` in the configuration, got neither"),
        ({"output": {"a": 1000, "b": 1000}}, "at most 1152 Hz in all"),
    ):
        with pytest.raises(BadArgument, match=message):
            await bench.doing(bench.device.settings.apply(given, save=True))
    plan = await bench.doing(bench.device.settings.plan({"mode": "9-axis", "baud": 921600}, save=True))
    assert ([step.name for step in plan.steps], bench.written()) == (["mode", "baud"], [])
    applied = await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=False))
    assert [(one.name, one.before, one.outcome) for one in applied.steps] == [("mode", "6-axis", StepOutcome.VERIFIED)]
    assert (applied.problem, applied.saved, applied.differences) == ("", False, {})
    saved = await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=True))
    assert (saved.steps, saved.saved) == ((), True)  # the previous value is saved
    again = await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=True))
    assert (again.steps, again.saved, bench.module.saves) == ((), False, 1)
    bench.module.commands.clear()
    await bench.doing(bench.device.settings.apply({"mode": "6-axis", "offset_deg": 1.5}, save=False))
    # both values are written before the only read
    assert bench.module.commands == ["GET", 'SET mode="6-axis"', "SET offset_deg=1.5", "GET"]
    bench.module.disappear()
    await bench.rig.until(lambda: bench.device.state is DeviceState.MISSING)
    for work in (
        bench.device.settings.report(fresh=True), bench.device.settings.plan({}, save=False),
        bench.device.settings.apply({}, save=False),
    ):  # fmt: skip
        with pytest.raises(CommandError, match="bow is missing"):
            await work


@played(lambda: ModuleBench(declared={"mode": "9-axis"}))
async def test_a_report_contains_the_last_or_new_values(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    bench.module.set["hours"] = 8
    known = await bench.device.settings.report(fresh=False)
    assert [one.actual for one in known.settings if one.name == "hours"] == [7]
    bench.module.set["hours"] = 7
    fresh = await bench.doing(bench.device.settings.report(fresh=True))
    assert (fresh.device, fresh.driver, fresh.identity["serial_number"]) == ("bow", "fake-module", "A1")
    assert {one.name: one.actual for one in fresh.settings if one.readable} == {
        name: value for name, value in FACTORY.items() if name != "secret"
    }
    assert [one.name for one in fresh.settings if one.differs] == ["mode"]
    assert [step.name for step in (await bench.doing(bench.device.settings.plan(None, save=False))).steps] == ["mode"]


@played(lambda: ModuleBench("apply", {"output": {"a": 1000}}, set={**FACTORY, "output": {"a": 100, "b": 1000}}))
async def test_declared_values_that_do_not_fit_the_present_ones_are_reported(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.status.problem)
    assert bench.status.problem.startswith("cannot set the settings: output: expected at most 1152 Hz in all")
    assert bench.written() == []


# --- steps that fail --------------------------------------------------------------------------------------------------

Outcomes = dict[str, StepOutcome]


def applied_with(
    given: dict[str, Any], prepare: Callable[[FakeModule], object], *, save: bool = True
) -> tuple[ModuleBench, AppliedSettings]:
    """Apply values to a module that `prepare` has changed."""
    bench, answers = ModuleBench(), list[AppliedSettings]()

    async def story() -> None:
        await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
        await bench.pass_s(1)
        prepare(bench.module)
        answers.append(await bench.doing(bench.device.settings.apply(given, save=save)))

    bench.play(story)
    return bench, answers[0]


def outcomes(applied: AppliedSettings) -> Outcomes:
    return {step.name: step.outcome for step in applied.steps}


WANTED = {"mode": "9-axis", "output": {"a": 10}, "mounting": "x_up", "offset_deg": 1.5}


def test_a_failed_step_or_a_device_without_reply_ends_the_plan_without_save() -> None:
    bench, applied = applied_with(WANTED, lambda module: module.refuses.add("output"))
    assert outcomes(applied) == {
        "mode": StepOutcome.VERIFIED, "output": StepOutcome.NOT_APPLIED, "mounting": StepOutcome.NOT_DONE,
        "offset_deg": StepOutcome.NOT_DONE,
    }  # fmt: skip
    assert applied.problem == (
        'output: SET output={"a":10}: the module refused; the previous writes last until the device restarts'
    )
    assert not applied.saved
    assert not applied.restarted
    assert list(applied.differences) == ["output", "mounting", "offset_deg"]  # the present values
    assert (bench.module.flash, bench.module.set) == (FACTORY, {**FACTORY, "mode": "9-axis"})
    bench, applied = applied_with(WANTED, lambda module: module.refuses.add("mode"))
    assert applied.problem == 'mode: SET mode="9-axis": the module refused; no other setting was written'
    assert bench.module.set == FACTORY
    _bench, applied = applied_with(WANTED, lambda module: module.forgets.add("offset_deg"))
    assert outcomes(applied)["offset_deg"] is StepOutcome.NOT_APPLIED
    assert applied.steps[-1].message == "wrote 1.5, read back 0.0"
    assert not applied.saved

    class Dying(set[str]):
        """Commands without a reply: all commands after the write of `output`."""

        def __contains__(self, command: object) -> bool:
            return any(one.startswith("SET output") for one in bench_of[0].commands)

    bench_of: list[FakeModule] = []

    def prepare(module: FakeModule) -> None:
        bench_of.append(module)
        module.silent = Dying()

    _bench, applied = applied_with(WANTED, prepare)
    assert outcomes(applied)["output"] is StepOutcome.NOT_VERIFIED
    assert applied.problem == 'output: SET output={"a":10}: expected OK, got nothing; its present settings are unknown'


def test_a_failed_restart_or_save_reports_the_written_settings() -> None:
    _bench, applied = applied_with(
        {"mounting": "x_up", "mode": "9-axis"}, lambda module: module.forgets.add("mounting")
    )
    assert outcomes(applied) == {"mode": StepOutcome.VERIFIED, "mounting": StepOutcome.NOT_APPLIED}
    assert applied.problem == 'mounting: wrote "x_up", read back "level"'
    unsure = ["save to flash: sent, not verified: imud cannot read the flash", "restarted"]
    assert applied.ends == unsure
    _bench, applied = applied_with({"mounting": "x_up", "mode": "9-axis"}, lambda module: module.forgets.add("SAVE"))
    assert set(outcomes(applied).values()) == {StepOutcome.NOT_APPLIED}
    assert (applied.problem, applied.ends) == ('mode: wrote "9-axis", read back "6-axis"', unsure)
    _bench, applied = applied_with({"mode": "9-axis"}, lambda module: module.silent.add("SAVE"))
    assert outcomes(applied) == {"mode": StepOutcome.VERIFIED}
    assert applied.problem == (
        "not saved: SAVE: expected OK, got nothing; the previous writes last until the device restarts"
    )
    bench, applied = applied_with({"baud": 921600, "mounting": "x_up", "mode": "9-axis"}, lambda _: None, save=False)
    assert list(applied.left_out) == ["baud", "mounting"]
    assert (outcomes(applied), bench.module.flash) == ({"mode": StepOutcome.VERIFIED}, FACTORY)


def test_a_new_rate_is_followed_if_the_device_replies() -> None:
    bench, applied = applied_with({"baud": 921600, "mode": "9-axis"}, lambda _module: None)
    assert outcomes(applied) == {"mode": StepOutcome.VERIFIED, "baud": StepOutcome.VERIFIED}
    assert (bench.module.baud, bench.module.set["baud"], bench.module.saves) == (921600, 921600, 1)
    assert (applied.problem, applied.saved) == ("", True)
    assert applied.advice == (
        "change `memory.baud: 115200` in the configuration to 921600: imud uses this value at its next start"
    )
    assert (bench.status.flash_writes, bench.rig.kinds.count(EventKind.UP)) == (1, 1)
    bench, applied = applied_with({"baud": 921600, "mode": "9-axis"}, lambda module: module.forgets.add("baud"))
    assert outcomes(applied) == {"mode": StepOutcome.VERIFIED, "baud": StepOutcome.NOT_APPLIED}
    assert "does not reply at 921600 baud; the bus has 115200 baud again" in applied.problem
    assert bench.module.baud == 115200
    assert list(applied.differences) == ["baud"]  # imud queried it after the write, and reported it
    assert bench.status.flash_writes == 1  # the failed write counts


@played(ModuleBench)
async def test_commands_that_save_count_and_are_limited(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.pass_s(2)
    assert (await bench.doing(bench.device.calibrate("zero", save=False))).verified
    assert bench.module.commands[-1] == "GET"  # a calibration can change reports
    assert bench.status.unsaved
    assert (await bench.doing(bench.device.calibrate("zero", save=True))).saved
    assert not bench.status.unsaved
    for _ in range(LIMIT_ASKED - 2):
        await bench.doing(bench.device.act("save", {}))
    applied = await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=True))
    assert (applied.saved, applied.problem) == (True, "")
    assert bench.status.flash_writes_day == bench.module.saves == LIMIT_ASKED
    sent = bench.module.commands.count("ZERO")
    for saving in (bench.device.act("save", {}), bench.device.calibrate("zero", save=True)):
        with pytest.raises(CommandError, match="bow: its flash was written 40 times in 24 hours"):
            await bench.doing(saving)
    applied = await bench.doing(bench.device.settings.apply({"mode": "6-axis"}, save=True))
    assert "not saved: its flash was written 40 times" in applied.problem
    # the step of this setting saves
    applied = await bench.doing(bench.device.settings.apply({"baud": 921600}, save=True))
    assert applied.problem.startswith("baud: its flash was written 40 times")
    assert (bench.module.saves, bench.module.commands.count("ZERO"), bench.module.baud) == (LIMIT_ASKED, sent, 115200)
    assert (await bench.doing(bench.device.calibrate("zero", save=False))).verified
    assert bench.module.commands.count("ZERO") == sent + 1


@played(ModuleBench)
async def test_a_command_waits_for_another_command_for_a_limited_time(bench: ModuleBench) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.pass_s(2)
    waiting = asyncio.ensure_future(bench.device.act("wait", {}))
    await bench.pass_s(1)
    begin_ns = bench.clock.now_ns()
    with pytest.raises(CommandError, match="the command wait is running, started 11 s ago by imud; try again later"):
        await bench.doing(bench.device.settings.report(fresh=True))
    assert bench.clock.now_ns() - begin_ns == pytest.approx(10e9, rel=0.1)
    work = bench.device.status().work
    assert work is not None
    assert (work.name, work.by, work.stop) == ("the command wait", "imud", "")
    waiting.cancel()
    await bench.pass_s(1)
    assert bench.device.status().work is None
    await bench.doing(bench.device.settings.report(fresh=True))
    async with bench.device.settings.lock.hold("the calibration z", "stop it"):  # it can last for minutes
        begin_ns = bench.clock.now_ns()
        with pytest.raises(CommandError, match=r"the calibration z is running.*stop it; try again later"):
            await bench.device.settings.report(fresh=True)
        assert bench.clock.now_ns() == begin_ns


# --- a backup before all is lost --------------------------------------------------------------------------------------


@played(lambda tmp_path: ModuleBench(state_dir=tmp_path))
async def test_a_backup_is_made_before_a_factory_reset(bench: ModuleBench, tmp_path: Path) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    bench.module.set["mode"] = "9-axis"
    await bench.doing(bench.device.act("factory_reset", {}))
    (file,) = (tmp_path / "backups").iterdir()
    assert file.name.startswith("bow.20261118T")  # UTC of `VirtualClock`
    assert 'mode: "9-axis"' in file.read_text()
    assert 'serial_number: "A1"' in file.read_text()
    assert bench.messages[-1] == f"settings before factory_reset are in {file}"
    assert bench.module.commands[-4:] == ["GET", "RESTART", "WHO", "GET"]  # then imud reads the settings again


@pytest.mark.parametrize("silent", [True, False])
@played(ModuleBench)
async def test_a_reset_without_backup_raises_an_event(bench: ModuleBench, silent: bool) -> None:
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.pass_s(1)
    bench.module.silent = {"GET"} if silent else set()
    await bench.doing(bench.device.act("factory_reset", {}))
    why = "GET: expected OK, got nothing" if silent else "there is no state directory"
    assert bench.told[-1].message == f"no backup of the settings before factory_reset: {why}"
    assert "RESTART" in bench.module.commands


# --- on other links ---------------------------------------------------------------------------------------------------


def test_a_polled_device_is_repaired_after_a_restart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.device.settings.AGAIN_NS", NS_PER_S)
    bench = PolledBusBench(tmp_path, monkeypatch, VirtualClock())
    device = bench.registers()
    bench.i2c.devices[0x18] = device
    table = DRIVERS["imu61x-i2c"].device_settings
    assert table is not None
    wanted = msgspec.convert({"accel_filter": "10 Hz"}, table.declarable)
    config = replace(on_i2c(), declared=wanted, on_difference=OnDifference.APPLY)

    async def body() -> None:
        async with bench.running(config) as (rig,):
            await rig.until_samples(5)
            await rig.until(lambda: compared(rig).state is SettingsState.AGREE, "set", 60)
            assert rig.kinds.count(EventKind.UP) == 1
            device.restart()
            await rig.until(lambda: compared(rig).repairs == 2, "set again", 100)
            await rig.until(lambda: compared(rig).state is SettingsState.AGREE, "as declared again")
            assert rig.kinds.count(EventKind.DOWN) == 0
            await rig.until_samples(5)

    bench.run(body())


def compared(rig: DeviceRig) -> SettingsStatus:
    found = rig.device.status().declared
    assert found is not None
    return found
