"""Execution of a plan of settings: writes, reads of the written values, save and restart."""

import asyncio
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Any, Final

from imud.contracts.command import VerbResult
from imud.contracts.setting import (
    AppliedSettings,
    AppliedStep,
    Effect,
    PlannedStep,
    Reports,
    SettingsPlan,
    SettingsTable,
    StepOutcome,
    Written,
    combined,
)
from imud.device.flash import ModuleFlash
from imud.device.settings_plan import (
    DEVICE_ERRORS,
    NOT_REPORTED,
    PENDING,
    SettingsPort,
    Values,
    as_json,
    differences,
)
from imud.model.errors import (
    BadArgument,
    DeviceRefused,
    NotApplied,
    Rejected,
)
from imud.model.options import shown

LATE_EFFECT_S: Final = 3.0  # maximum time from the reply of the device to the effect of a write, s
LATE_EFFECT_READS: Final = 10  # number of reads in this time


@dataclass
class Applying:
    """Execution of one plan. `wanted` has the types of the table, `reports` contains the last read."""

    table: SettingsTable
    transport: SettingsPort
    flash: ModuleFlash
    wanted: Values
    reports: Reports
    written: dict[str, Any] = field(default_factory=dict)
    """Written values of settings that the device does not report."""
    saved: bool = False
    restarted: bool = False
    restart_doubt: str = ""
    changed: bool = False  # whether imud has written a setting
    # Settings whose script has reported that the value needs a restart, although the table does not require it
    pending: set[str] = field(default_factory=set)
    verified: set[str] = field(default_factory=set)  # settings whose script has verified the value
    heard: bool = True  # whether the device has replied to the newest read
    problem: str = ""

    async def carry_out(self, plan: SettingsPlan) -> AppliedSettings:
        """Execute the plan up to the first failure. Raises no error of the device or its link."""
        done: list[AppliedStep] = []
        while len(done) < len(plan.steps) and not self.problem:
            done += await self._write(plan.steps[len(done) :])
        for step in plan.steps[len(done) :]:
            done.append(AppliedStep(step.name, step.value, step.before, StepOutcome.NOT_DONE))
        unverified_link = [
            step.name
            for step, planned_step in zip(done, plan.steps, strict=True)
            if planned_step.connection and step.outcome is StepOutcome.NOT_VERIFIED
        ]
        if not self.problem and unverified_link and (plan.save or plan.restart):
            self.problem = (
                f"{', '.join(unverified_link)}: {NOT_REPORTED}, and a wrong value makes the device unreachable; imud "
                "did not save it; if you are sure, run the commands save and restart"
            )
        if not self.problem and plan.save:
            await self._save()
        # a plan with such a setting and without a restart keeps the device at the present rate of its bus
        is_planned = Effect.AFTER_RESTART in map(attrgetter("effect"), plan.steps)
        needs_restart = bool(self.pending) and self.saved and not is_planned
        if not self.problem and (plan.restart or (needs_restart and self.table.restart is not None)):
            done = await self._restart(done)
        found = differences(self.table, self.wanted, combined(self.reports).values if self.heard else {}, self.written)
        problem = self.problem and self.problem + self._present()
        return AppliedSettings(
            tuple(done), self.saved, self.restarted, problem, plan.left_out, found, restart_doubt=self.restart_doubt
        )

    async def _write(self, steps: Sequence[PlannedStep]) -> list[AppliedStep]:
        """Write settings up to the first error, read back their reports once, and compare each setting.

        imud checks a setting of the connection by itself.
        """
        sent: list[PlannedStep] = []
        names: set[str] = set()
        failure: Exception | None = None
        for step in steps:
            by_itself, setting = step.connection or step.saves, self.table.table[step.name]
            assert setting.write is not None
            if sent and by_itself:
                break
            sent.append(step)
            if setting.readable:
                names.add(setting.report)
            try:
                if step.saves:
                    self.flash.spend()
                result = await self.transport.run_script(setting.write, self.wanted[step.name])
                self.saved |= step.saves
            except DEVICE_ERRORS as error:
                failure = error
                break
            self.changed = True
            if result in PENDING:
                self.pending.add(step.name)
            if result is Written.VERIFIED:
                self.verified.add(step.name)
            if by_itself:
                break
        # an error can be the sign of a restart, which loses unsaved values
        names_to_read = None if failure or sent[-1].saves else names
        why = await self._read(names_to_read) if names else ""
        if names and not why and (failure is None or isinstance(failure, NotApplied)):
            why = await self._wait_for_effect(sent, names_to_read)
        last = self._compared(sent.pop(), failure, why)  # before the others: imud reports the problem of a failed write
        return [*map(partial(self._compared, why_unread=why), sent), last]

    async def _wait_for_effect(self, steps: Sequence[PlannedStep], names: Collection[str] | None) -> str:
        """Read the reports again while a written value is not present, at most LATE_EFFECT_S.

        A device can confirm a write first and apply it later. Return the reason if the device did not reply.
        """
        reason = ""
        for _ in range(LATE_EFFECT_READS):
            if reason or all(map(self._has_effect, steps)):
                return reason
            await asyncio.sleep(LATE_EFFECT_S / LATE_EFFECT_READS)
            reason = await self._read(names)
        return reason

    def _has_effect(self, step: PlannedStep) -> bool:
        """Return whether the device reports the written value, or reports it only after a restart or never."""
        setting, actual = self.table.table[step.name], combined(self.reports).values
        is_late = step.name in self.pending or (setting.effect is Effect.AFTER_RESTART and not setting.saves)
        if not setting.readable or is_late or step.name not in actual:
            return True
        return setting.agrees(self.wanted[step.name], actual[step.name])

    def _compared(
        self, step: PlannedStep | AppliedStep, error: Exception | None = None, why_unread: str = ""
    ) -> AppliedStep:
        """Compare the written value with the value that imud read back. `error`: error of the script that wrote it.

        `why_unread`: reason why imud could not read the report; empty if imud read it.
        """
        name, setting, actual = step.name, self.table.table[step.name], combined(self.reports).values
        is_read = setting.readable and not why_unread and name in actual
        agrees = is_read and setting.agrees(self.wanted[name], actual[name])
        has_failed = error is not None and not agrees  # it has not failed if only the reply was lost
        is_pending = name in self.pending or (setting.effect is Effect.AFTER_RESTART and not setting.saves)
        outcome, failure, message = StepOutcome.VERIFIED, "", ""
        if has_failed:
            is_known = is_read or isinstance(error, Rejected | BadArgument | DeviceRefused)
            outcome, failure = StepOutcome.NOT_APPLIED if is_known else StepOutcome.NOT_VERIFIED, str(error)
        elif why_unread and setting.readable:
            outcome = StepOutcome.NOT_VERIFIED
            failure = f"the device has not reported its settings after the write: {why_unread}"
        elif not is_read:
            self.written[name] = self.wanted[name]
            if name not in self.verified:
                outcome = StepOutcome.NOT_VERIFIED
                message = NOT_REPORTED
        elif is_pending and not self.restarted:
            outcome = StepOutcome.WRITTEN
        elif not agrees:
            outcome = StepOutcome.NOT_APPLIED
            failure = f"wrote {shown(as_json(self.wanted[name]))}, read back {shown(as_json(actual[name]))}"
        self.changed = self.changed or not has_failed
        self.problem = self.problem or (failure and f"{name}: {failure}")
        return AppliedStep(name, step.value, step.before, outcome, failure or message)

    async def _save(self) -> None:
        save = self.table.save
        assert save is not None
        try:
            self.flash.spend()
            await self.transport.run_script(save)
            self.saved = True
        except DEVICE_ERRORS as error:
            self.problem = f"not saved: {error}"

    async def _restart(self, done: list[AppliedStep]) -> list[AppliedStep]:
        """Restart the device, and compare the written settings with its reports."""
        restart = self.table.restart
        assert restart is not None
        self.transport.samples.mark()
        try:
            result = await self.transport.run_script(restart)
            verified: bool | None
            if isinstance(result, VerbResult):  # the script has checked the effect
                verified, words = result.verified or None, result.evidence
            else:
                verified, words = await self.transport.samples.restarted()
            self.restarted = verified is True
            self.problem = f"restart: {words}" if verified is False else ""
            self.restart_doubt = words if verified is None else ""
        except DEVICE_ERRORS as error:
            self.problem = f"restart: {error}"
        if await self._read(None):
            self.problem = self.problem or "the device does not report its settings after its restart"
        if self.problem:
            return done
        # a device that has ignored the save loses values that it reported before the restart
        is_due = (StepOutcome.WRITTEN, StepOutcome.VERIFIED)
        return [self._compared(one) if one.outcome in is_due else one for one in done]

    async def _read(self, names: Collection[str] | None) -> str:
        """Read reports, None: all. Return an empty text, or the reason if the device did not reply."""
        try:
            read = await self.transport.run_script(self.table.read, names)
        except DEVICE_ERRORS as error:
            self.heard = False
            return str(error)
        kept = {} if names is None else dict(self.reports)
        for name in set(names or ()) - read.keys():  # the device does not send these reports any longer
            kept.pop(name, None)
        self.reports, self.heard = kept | {**read}, True
        return ""

    def _present(self) -> str:
        """Describe the state of the device after a failure, for the end of the message."""
        if not self.heard:
            return "; its present settings are unknown"
        if not self.changed:
            return "; no other setting was written"
        return "" if self.saved else "; the previous writes last until the device restarts"
