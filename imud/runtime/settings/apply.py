"""Execution of a plan: each setting is written and read back, then saved, then the device is restarted if need be.

A step that fails ends it: later steps are not done and nothing is saved. What the device has then is read again.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from imud.config import DeviceConfig
from imud.contracts.action import Target
from imud.contracts.device_settings import (
    AppliedSettings,
    AppliedStep,
    DeviceSettings,
    Effect,
    PlannedStep,
    Setting,
    SettingsPlan,
    StepOutcome,
    Written,
)
from imud.contracts.settings import shown
from imud.errors import CommandError, DeviceRefused, LinkError, TransferError
from imud.runtime.settings.difference import Values, as_json, differences

DEVICE_ERRORS: Final = (CommandError, DeviceRefused, LinkError, TransferError)
"""Raised where a device does not answer, does not take a value, or is gone."""

PLACES: Final = ("baud", "address", "node")
"""Settings by whose names link or options say where the device is found."""
UNVERIFIED: Final = (Written.UNVERIFIED, Written.UNVERIFIED_PENDING)
PENDING: Final = (Written.PENDING, Written.UNVERIFIED_PENDING)

RunScript = Callable[[Callable[[Target], Any]], Awaitable[Any]]
"""`run_script` of a transport."""


class FlashBudget(Protocol):
    """How often the flash of a device may be written."""

    def refusal(self) -> str:
        """Return why it may not be written now, one sentence; empty if it may."""
        ...

    def count(self) -> None:
        """Count a write that is about to be made."""
        ...


@dataclass
class Applying:
    """One plan under way. `wanted` has the values in the types of the table, `actual` what was read last."""

    table: DeviceSettings
    run: RunScript
    flash: FlashBudget
    wanted: Values
    actual: Values
    written: dict[str, Any] = field(default_factory=dict)
    """Values written of settings that cannot be read back."""
    saved: bool = False
    restarted: bool = False
    changed: bool = False
    """Whether anything was written."""
    pending: bool = False
    """Whether a script said that what it wrote comes into force by a restart, whatever the table says."""
    heard: bool = True
    """Whether the device answered to the newest question."""
    problem: str = ""

    async def carry_out(self, plan: SettingsPlan) -> AppliedSettings:
        """Do everything, up to the first failure. Raises nothing that a device or its link can cause."""
        done: list[AppliedStep] = []
        for step in plan.steps:
            done.append(await self._do(step) if not self.problem else _applied(step, StepOutcome.NOT_DONE))
        if not self.problem and plan.save:
            await self._save()
        if not self.problem and (plan.restart or (self.pending and self.saved and self.table.restart is not None)):
            done = await self._restart(done)
        found = differences(self.table, self.wanted, self.actual, self.written)
        return AppliedSettings(
            tuple(done), self.saved, self.restarted, self.problem + self._present(), plan.left_out, found
        )

    async def _do(self, step: PlannedStep) -> AppliedStep:
        setting, value = self.table.table[step.name], self.wanted[step.name]
        assert setting.write is not None
        write = setting.write
        if step.saves and (refusal := self.flash.refusal()):
            return self._failed(step, refusal)
        try:
            if step.saves:
                self.flash.count()
            result = await self.run(lambda target: write(target, value))
        except DEVICE_ERRORS as error:
            await self._read_again()
            return self._failed(step, str(error))
        self.changed = True
        self.saved |= step.saves
        if not await self._read_again():
            return self._failed(step, "written, and the device does not tell its settings since")
        if not setting.readable or (result in UNVERIFIED and step.name not in self.actual):
            self.written[step.name] = value
            return _applied(step, StepOutcome.NOT_VERIFIED)
        if result in PENDING:
            self.pending = True
            return _applied(step, StepOutcome.WRITTEN)
        return self._judged(step, setting)

    def _judged(self, step: PlannedStep, setting: Setting) -> AppliedStep:
        """Compare what was read back after a write."""
        if step.effect is Effect.AFTER_RESTART and not step.saves:
            return _applied(step, StepOutcome.WRITTEN)
        if message := self._mismatch(step.name, setting):
            return self._failed(step, message)
        return _applied(step, StepOutcome.DONE)

    def _mismatch(self, name: str, setting: Setting) -> str:
        if name not in self.actual:
            return "written, and the device does not tell it"
        if setting.agrees(self.wanted[name], self.actual[name]):
            return ""
        return f"wrote {shown(as_json(self.wanted[name]))}, read back {shown(as_json(self.actual[name]))}"

    def _failed(self, step: PlannedStep, message: str) -> AppliedStep:
        self.problem = f"{step.name}: {message}"
        return _applied(step, StepOutcome.FAILED, message)

    async def _save(self) -> None:
        save = self.table.save
        assert save is not None
        if refusal := self.flash.refusal():
            self.problem = f"not saved: {refusal}"
            return
        self.flash.count()
        try:
            await self.run(save)
            self.saved = True
        except DEVICE_ERRORS as error:
            self.problem = f"not saved: {error}"

    async def _restart(self, done: list[AppliedStep]) -> list[AppliedStep]:
        """Restart the device, and judge the settings that come into force by that."""
        restart = self.table.restart
        assert restart is not None
        try:
            await self.run(restart)
            self.restarted = True
        except DEVICE_ERRORS as error:
            self.problem = f"restart: {error}"
        if not await self._read_again():
            self.problem = self.problem or "the device does not tell its settings after its restart"
            return done
        return [self._after_restart(one) for one in done]

    def _after_restart(self, done: AppliedStep) -> AppliedStep:
        if done.outcome is not StepOutcome.WRITTEN or self.problem:
            return done
        step = PlannedStep(done.name, done.value, done.before)
        return self._judged(step, self.table.table[done.name])

    async def _read_again(self) -> bool:
        """Read all settings; return False where the device does not answer, and its values are not known then."""
        try:
            self.actual = await self.run(self.table.read)
            self.heard = True
        except DEVICE_ERRORS:
            self.actual, self.heard = {}, False
        return self.heard

    def _present(self) -> str:
        """How the device is after a failure, for the end of its message."""
        if not self.problem:
            return ""
        if not self.heard:
            return "; what it has now is not known"
        if not self.changed:
            return "; nothing else was written"
        return "" if self.saved else "; what was written before holds until the device restarts"


def advice(config: DeviceConfig, done: AppliedSettings) -> str:
    """Say what to change in a configuration that looks for the device where it was; empty for nothing."""
    found = []
    for step in done.steps:
        if step.outcome not in (StepOutcome.DONE, StepOutcome.WRITTEN):
            continue
        for key, part in ((config.link, config.link_settings), ("options", config.options)):
            place = getattr(part, step.name, None)
            if place not in (None, "auto", step.value) and type(place) is type(step.value) and step.name in PLACES:
                found.append(f"change `{key}.{step.name}: {place}` in the configuration to {step.value}")
    return "; ".join(found) + (": imud looks for the device there at its next start" if found else "")


def _applied(step: PlannedStep, outcome: StepOutcome, message: str = "") -> AppliedStep:
    return AppliedStep(step.name, step.value, step.before, outcome, message)
