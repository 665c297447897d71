"""Results of writes, and the order of save and restart. test_settings.py tests failures."""

import asyncio
from collections.abc import Callable, Collection
from typing import Any

import pytest

from imud.contracts import setting
from imud.contracts.command import Target
from imud.device.evidence import SampleWatch
from imud.device.flash import FlashWrites, ModuleFlash
from imud.device.settings_plan import Applying, SettingsPort, make_plan
from imud.host.clock import HostClock
from imud.model.errors import LinkMissing, NoReply

TARGET = Target(None, 0)


class TableOfOne:
    """A device with the setting `x`. Its scripts run when they are created."""

    def __init__(
        self, result: object, *, readable: bool = True, effect: setting.Effect = setting.Effect.AT_ONCE, **more: Any
    ) -> None:
        self.actual: dict[str, Any] = {"x": 1}
        self.active: dict[str, Any] = {"x": 1} if readable else {}
        self.done: list[str] = []
        self.result = result
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
        return {"": setting.DeviceReport(values=dict(self.active))}

    def _restart(self) -> None:
        self._do("restart")
        self.active = dict(self.actual) if self.active else {}


class OnePort(SettingsPort):
    """Port that runs each script when it is created."""

    driver = path = None
    where, can_be_asked = "", True

    def __init__(self) -> None:
        self.samples = SampleWatch(self)

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
    plan = make_plan(device.table, TARGET, {"x": 2}, device.active, {}, save=save, unsaved=False, by_name=by_name)
    port, reports = OnePort(), {"": setting.DeviceReport(values=device.active)}
    applying = Applying(device.table, port, flash or CountedFlash(), {"x": 2}, reports)
    return asyncio.run(applying.carry_out(plan))


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
    device = TableOfOne(setting.Written.PENDING)
    found = applied(device, save=False)
    assert device.done == ["x=2", "read"]
    assert found.steps[0].outcome is setting.StepOutcome.WRITTEN
    assert list(found.differences) == ["x"]


@pytest.mark.parametrize("result", [setting.Written.UNVERIFIED, setting.Written.UNVERIFIED_PENDING])
def test_an_unreadable_value_is_not_verified_and_another_value_is_a_failure(result: setting.Written) -> None:
    found = applied(TableOfOne(result, readable=False))
    assert found.steps[0].outcome is setting.StepOutcome.NOT_VERIFIED
    assert (found.saved, found.problem, found.differences) == (True, "", {})
    found = applied(TableOfOne(setting.Written.UNVERIFIED))
    assert found.steps[0].message == "wrote 2, read back 1"


def test_a_setting_that_saves_itself_is_saved_once() -> None:
    device, flash = TableOfOne(setting.Written.VERIFIED, saves=True, connection=True), CountedFlash()
    found = applied(device, flash=flash)
    assert device.done == ["x=2", "read"]
    assert (found.saved, flash.counted) == (True, 1)


@pytest.mark.parametrize("error", [NoReply("no answer"), LinkMissing("pulled out")])
def test_errors_of_device_and_link_are_part_of_the_result(error: Exception) -> None:
    device = TableOfOne(error)
    device.result = error
    found = applied(device)
    assert found.problem == f"x: {error}; no other setting was written"
    assert device.done == ["x=2", "read"]


def test_a_device_with_another_rate_than_its_bus_is_not_restarted() -> None:
    device = TableOfOne(setting.Written.PENDING, effect=setting.Effect.AFTER_RESTART, connection=True, bus_rate=True)
    done = applied(device, by_name=True)
    assert (done.saved, done.restarted, done.problem) == (True, False, "")
    assert [one for one in device.done if one != "read"] == ["x=2", "save"]
