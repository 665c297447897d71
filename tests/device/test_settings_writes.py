"""Writes of settings: results, late effects, order of save and restart. test_settings.py tests failures."""

from collections.abc import Callable, Collection
from typing import Any

import pytest

from imud.contracts import setting
from imud.contracts.command import Target, VerbResult
from imud.device import settings_plan
from imud.device.evidence import SampleWatch
from imud.device.flash import FlashWrites, ModuleFlash
from imud.device.settings_writes import LATE_EFFECT_READS, Applying
from imud.host.clock import HostClock
from imud.model.errors import LinkMissing, NoReply, NotApplied
from tests.support.event_loops import VirtualClock, run_virtually

TARGET = Target(None, 115200)


class TableOfOne:
    """A device with the setting `x`. Its scripts run when they are created."""

    def __init__(
        self, result: object, *, readable: bool = True, effect: setting.Effect = setting.Effect.IMMEDIATELY, **more: Any
    ) -> None:
        self.actual: dict[str, Any] = {"x": 1}
        self.active: dict[str, Any] = {"x": 1} if readable else {}
        self.done: list[str] = []
        self.result = result
        self.restarted: VerbResult | None = VerbResult(True, "")
        self.reads_before_effect: int | None = None  # number of reads that show the old value; None for all reads
        self.table = setting.SettingsTable(
            table={"x": setting.Setting(type=int, write=self._write, effect=effect, **more)},
            read=self._read, save=lambda _target: self._do("save"), restart=lambda _target: self._restart(),
        )  # fmt: skip

    def _do(self, name: str) -> None:
        self.done.append(name)

    def _write(self, _target: Target, value: int) -> object:
        self._do(f"x={value}")
        self.actual = {"x": value}
        if self.result is setting.Written.VERIFIED or self.result is None:
            self.active = dict(self.actual) if self.active else {}
        if isinstance(self.result, Exception):
            raise self.result
        return self.result

    def _read(self, _target: Target, _names: Collection[str] | None) -> setting.Reports:
        self._do("read")
        if self.reads_before_effect is not None:
            self.reads_before_effect -= 1
            if self.reads_before_effect < 0:
                self.active = dict(self.actual)
        return {"": setting.DeviceReport(values=dict(self.active))}

    def _restart(self) -> VerbResult | None:
        self._do("restart")
        self.active = dict(self.actual) if self.active else {}
        return self.restarted


class OnePort(settings_plan.SettingsPort):
    """Port that runs each script when it is created."""

    driver = path = None
    where, can_be_asked = "", True

    def __init__(self) -> None:
        self.samples = SampleWatch(self)

    def require_replies(self) -> None:
        """Raise no error: the device always replies."""

    async def run_script(self, make: Callable[..., Any], *arguments: Any) -> Any:
        return make(TARGET, *arguments)


class CountedFlash(ModuleFlash):
    """Flash that may be written, and the number of writes."""

    def __init__(self) -> None:
        super().__init__(FlashWrites(None, HostClock()), "module", asked=True)

    @property
    def counted(self) -> int:
        return self.writes.record("module").writes


def applied(
    device: TableOfOne, *, save: bool = True, flash: CountedFlash | None = None, by_name: bool = False
) -> setting.AppliedSettings:
    plan = settings_plan.make_plan(
        device.table, TARGET, {"x": 2}, device.active, {}, save=save, unsaved=False, by_name=by_name
    )
    port, reports = OnePort(), {"": setting.DeviceReport(values=device.active)}
    applying = Applying(device.table, port, flash or CountedFlash(), {"x": 2}, reports)
    results: list[setting.AppliedSettings] = []

    async def carry_out() -> None:
        results.append(await applying.carry_out(plan))

    run_virtually(VirtualClock(), carry_out())
    return results[0]


def test_values_are_written_read_back_saved_and_compared() -> None:
    device, flash = TableOfOne(None), CountedFlash()
    found = applied(device, flash=flash)
    assert device.done == ["x=2", "read", "save"]
    assert (found.steps[0].outcome, found.saved, found.restarted, found.differences) == (
        setting.StepOutcome.VERIFIED, True, False, {},
    )  # fmt: skip
    assert flash.counted == 1
    device = TableOfOne(setting.Written.PENDING, effect=setting.Effect.AFTER_RESTART)
    found = applied(device)
    assert device.done == ["x=2", "read", "save", "restart", "read"]
    assert (found.steps[0].outcome, found.restarted) == (setting.StepOutcome.VERIFIED, True)
    device = TableOfOne(setting.Written.PENDING)
    found = applied(device)
    assert device.done == ["x=2", "read", "save", "restart", "read"]
    assert found.steps[0].outcome is setting.StepOutcome.VERIFIED
    no_samples = "the device sends no samples that show a restart"
    for device.restarted, doubt in ((VerbResult(False, "no pause"), "no pause"), (None, no_samples)):
        device.active = {"x": 1}
        found = applied(device)
        assert (found.steps[0].outcome, found.restarted, found.problem) == (setting.StepOutcome.WRITTEN, False, "")
        assert found.ends[-1] == f"restart: sent, not verified: {doubt}"
    device = TableOfOne(setting.Written.PENDING)
    found = applied(device, save=False)
    assert device.done == ["x=2", "read"]
    assert found.steps[0].outcome is setting.StepOutcome.WRITTEN
    assert list(found.differences) == ["x"]
    device, flash = TableOfOne(setting.Written.VERIFIED, saves=True, connection=True), CountedFlash()
    found = applied(device, flash=flash)
    assert (device.done, (found.saved, flash.counted)) == (["x=2", "read"], (True, 1))
    device = TableOfOne(setting.Written.PENDING, effect=setting.Effect.AFTER_RESTART, connection=True, bus_rate=True)
    done = applied(device, by_name=True)
    assert (done.saved, done.restarted, done.problem) == (True, False, "")
    assert [one for one in device.done if one != "read"] == ["x=2", "save"]


@pytest.mark.parametrize("result", [setting.Written.UNVERIFIED, setting.Written.UNVERIFIED_PENDING])
def test_an_unreadable_value_is_not_verified_and_another_value_is_a_failure(result: setting.Written) -> None:
    found = applied(TableOfOne(result, readable=False))
    assert found.steps[0].outcome is setting.StepOutcome.NOT_VERIFIED
    assert (found.saved, found.problem, found.differences) == (True, "", {})
    found = applied(TableOfOne(setting.Written.UNVERIFIED))
    assert found.steps[0].message == "wrote 2, read back 1"


@pytest.mark.parametrize("error", [NoReply("no answer"), LinkMissing("pulled out")])
def test_errors_of_device_and_link_are_part_of_the_result(error: Exception) -> None:
    device = TableOfOne(error)
    device.result = error
    assert applied(device).problem == f"x: {error}; no other setting was written"
    assert device.done == ["x=2", "read"]


@pytest.mark.parametrize("result", [setting.Written.UNVERIFIED, NotApplied("x: expected 2 after the write, got 1")])
def test_effect_after_the_reply_is_verified(result: object) -> None:
    """A device confirms a write and applies it 0.6 s later."""
    device = TableOfOne(result)
    device.reads_before_effect = 2
    found = applied(device)
    assert (found.steps[0].outcome, found.problem) == (setting.StepOutcome.VERIFIED, "")
    assert device.done == ["x=2", "read", "read", "read", "save"]


def test_missing_effect_is_a_failure_after_some_reads() -> None:
    device = TableOfOne(setting.Written.UNVERIFIED)
    assert applied(device, save=False).steps[0].outcome is setting.StepOutcome.NOT_APPLIED
    assert device.done == ["x=2", *["read"] * (1 + LATE_EFFECT_READS)]


@pytest.mark.parametrize("result", [setting.Written.UNVERIFIED, setting.Written.UNVERIFIED_PENDING])
def test_unverified_link_setting_is_not_saved(result: setting.Written) -> None:
    """A wrong bit rate in the flash makes the device unreachable."""
    device = TableOfOne(result, readable=False, connection=True)
    found = applied(device)
    assert (found.saved, found.restarted) == (False, False)
    assert found.problem.startswith("x: the device does not report this setting, and a wrong value makes")
    assert device.done == ["x=2", "read"]
    assert found.failure
