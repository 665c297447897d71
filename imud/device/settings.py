"""Settings of one device: comparison with the declared settings, and repair if `on_difference` requests it.

    link opened, device identified, device restarted, command executed ─▶ read ─▶ compare ─▶ event, status
                                                                                    │ on_difference
                                                                                    └─▶ plan ─▶ apply ─▶ event

If a device loses its settings repeatedly, imud waits longer before each repair (PAUSES_S). imud writes the flash of a
device a limited number of times per day (`flash.py`).
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any, Final

import msgspec

from imud.contracts.command import Target
from imud.contracts.driver import PolledDriver
from imud.contracts.setting import (
    AppliedSettings,
    OnDifference,
    SettingDifference,
    SettingsPlan,
    SettingsReport,
    SettingsState,
    SettingsStatus,
    SettingsTable,
    StepOutcome,
    declared_values,
)
from imud.device.flash import ModuleFlash, SettingsFiles, backup_text
from imud.device.identity import identity_words
from imud.device.settings_plan import (
    DEVICE_ERRORS,
    Applying,
    Values,
    advice,
    as_json,
    completed,
    described_settings,
    differences,
    make_plan,
    unverified,
    wanted_values,
    words,
)
from imud.device.transport import DeviceContext, Transport
from imud.model.errors import BadArgument, CommandError, reason_of
from imud.model.event import EventKind
from imud.model.options import shown
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.sampling.clock import SampleClock

log = logging.getLogger(__name__)

BEGIN_NS: Final = NS_PER_S
"""Time from the search to the first comparison, ns. imud queries the identity first, which identifies the flash."""
SETTLE_NS: Final = NS_PER_S // 2
"""Time from the first sample after a restart to the comparison, ns. A device may ignore requests at its start."""
AGAIN_NS: Final = 60 * NS_PER_S
"""Interval of comparisons of a polled device, ns. It has no counter that shows a restart."""
OWN_NS: Final = 2 * NS_PER_S
# Additional time until the first sample after a requested restart, ns
BOOT_NS: Final = 8 * NS_PER_S
"""Time after a script in which a restart of the device counter is a result of the script, ns. imud compares the
settings at the end of the script. A second comparison would pause the samples again."""
WAIT_S: Final = 10.0  # maximum wait of a command for another command, s
PLAN_NS: Final = 10 * NS_PER_S  # maximum age of the values of a plan that `apply` uses without a new read, ns
BACKUP_LIMIT_S: Final = 5.0  # maximum wait of a command for the disk, s
READ_AGAIN_NS: Final = 5 * NS_PER_S  # pause before imud reads the settings again after an error, ns
READ_TRIES: Final = 3  # number of reads before imud waits for the next restart, replug or command
PAUSES_S: Final = (0, 10, 60, 600, 3600)
"""Pauses before the first, second, … repair within PAUSES_FORGOTTEN_S, s. The last pause repeats."""
PAUSES_FORGOTTEN_S: Final = 2 * 3600  # time after which a repair no longer counts, s


class RepairPauses:
    """Pauses between the repairs of a device. The first repair of another device has no pause."""

    def __init__(self) -> None:
        self._device = ""
        self._repaired_ns: list[int] = []  # CLOCK_MONOTONIC of the repairs within PAUSES_FORGOTTEN_S

    def remaining_ns(self, device: str, now_ns: int) -> int:
        """Return the remaining pause before the next repair of `device`, ns; 0 or less if a repair may start."""
        if device != self._device:
            self._device = device
            self._repaired_ns.clear()
        forgotten_ns = now_ns - PAUSES_FORGOTTEN_S * NS_PER_S
        self._repaired_ns = [time_ns for time_ns in self._repaired_ns if time_ns > forgotten_ns]
        pause_s = PAUSES_S[min(len(self._repaired_ns), len(PAUSES_S) - 1)]
        return self._repaired_ns[-1] + pause_s * NS_PER_S - now_ns if self._repaired_ns else 0

    def add(self, now_ns: int) -> None:
        """Count a repair of the device of the last `remaining_ns`."""
        self._repaired_ns.append(now_ns)


class SettingsKeeper:
    """Settings of one device; an attachment. Synchronization: the loop's thread only."""

    def __init__(self, context: DeviceContext, transport: Transport, files: SettingsFiles) -> None:
        """All devices share `files`."""
        self._config = context.config
        self._transport = transport
        self._identity = transport.identity
        self._events = context.events
        self._host = context.host
        self._files = files
        self._writes = files.flash
        self._clock: SampleClock | None = None
        # CLOCK_MONOTONIC until which a restart of the device counter is a result of a script of imud
        self._own_until_ns = self._resets = 0
        self.resets_requested = 0  # number of restarts of the device counter that a script of imud caused
        self._lock = asyncio.Lock()
        self._wanted = asyncio.Event()
        self._due_ns: int | None = None  # CLOCK_MONOTONIC of the next comparison; None: after the next event
        self._tries = 0
        self._actual: Values | None = None
        self._target: Target | None = None
        # values that imud wrote since the last restart, of settings that the device does not report
        self._written: dict[str, Any] = {}
        self._unsaved = False  # whether a write since the last restart may be missing in flash
        self._saved: Values | None = None  # while `_unsaved`: the values before the write; None if they are unknown
        self._reported: Mapping[str, SettingDifference] = {}
        self._problem = ""
        self._read_ns: int | None = None
        # resets of the device counter at a plan that no other script has followed; None without such a plan
        self._planned_resets: int | None = None
        self._repairs = 0
        self._pauses = RepairPauses()

    # --- the attachment -----------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """Forget the settings: imud has found the device again, or another device."""
        self._clock, self._resets = clock, clock.status().resets
        self._actual = self._planned_resets = None
        self._after_start(BEGIN_NS)

    def tick(self, now_ns: int, _newest: Sample | None) -> None:
        """Wake `run` if a comparison is due and the device can reply. Detect a restart of the device counter."""
        if self._clock is not None and (resets := self._clock.status().resets) != self._resets:
            is_own = self.busy or now_ns < self._own_until_ns + BOOT_NS
            self.resets_requested, self._resets = self.resets_requested + is_own * (resets - self._resets), resets
            if self._declared and not self.busy and now_ns >= self._own_until_ns:
                self._after_start(SETTLE_NS)
        is_due = self._declared and self._due_ns is not None and now_ns >= self._due_ns
        if is_due and not self.busy and self._transport.can_be_asked:
            self._wanted.set()

    def commanded(self, *, saved: bool = False) -> None:
        """Note that a command was executed. It may have changed any setting, or `saved` all settings."""
        if not self._unsaved:
            self._saved = self._actual
        self._unsaved, self._tries = not saved, 0
        self._due_ns = self._host.now_ns()

    def saved(self) -> None:
        """Note that the flash contains the present settings: a command saved them and changed no value."""
        self._unsaved = False

    def stop(self) -> None:
        """Forget the settings: the link ended. A second call does nothing."""
        self._actual = self._due_ns = self._planned_resets = None
        self._wanted.clear()

    def close(self) -> None:
        self.stop()

    def _after_start(self, after_ns: int) -> None:
        """Note that the device has the settings of its flash, and compare them after `after_ns`."""
        self._reported, self._written, self._unsaved, self._tries = {}, {}, False, 0
        self._due_ns = self._host.now_ns() + after_ns

    @property
    def busy(self) -> bool:
        """Whether imud reads or writes settings, or executes a command."""
        return self._lock.locked()

    @asynccontextmanager
    async def exclusive(self) -> AsyncIterator[None]:
        """Lock the settings for a command. The values of an earlier plan are then out of date.

        Raises CommandError if another command, for example a calibration, does not end within WAIT_S.
        """
        try:
            async with asyncio.timeout(WAIT_S):
                await self._lock.acquire()
        except TimeoutError:
            raise CommandError(
                f"{self._config.name}: another command or a calibration is still running; try again later"
            ) from None
        self._planned_resets = None
        try:
            yield
        finally:
            self._own_until_ns = self._host.now_ns() + OWN_NS
            self._lock.release()

    @property
    def flash(self) -> ModuleFlash:
        """Flash of the present device, for writes that a user or program requested."""
        return ModuleFlash(self._writes, self._module, asked=True)

    def spend_flash(self) -> None:
        """Count a write to flash before a command makes it. Raises CommandError if the limit is reached."""
        if refusal := self.flash.refusal():
            raise CommandError(f"{self._config.name}: {refusal}")
        self.flash.count()

    async def run(self) -> None:
        """Compare the settings when a comparison is due. Ends only by an internal error."""
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            with suppress(CommandError):  # another command is running: imud compares after it
                async with self.exclusive():
                    self._due_ns = None
                    await self._keep()

    # --- requests -----------------------------------------------------------------------------------------------------

    def status(self) -> SettingsStatus | None:
        """Return the newest comparison; None if the driver has no table of settings."""
        table = self._known_table()
        if table is None:
            return None
        found = self._differences(table)
        state = SettingsState.DIFFER if found else SettingsState.AGREE
        state = SettingsState.UNKNOWN if self._actual is None else state
        return SettingsStatus(
            state if self._declared else SettingsState.UNDECLARED,
            self._config.on_difference,
            self._problem,
            found,
            unverified(table, self._declared, self._actual or {}) if self._actual is not None else (),
            self._read_ns,
            self._repairs,
            self._writes.writes(self._module),
            self._writes.writes_day(self._module),
        )

    async def report(self, *, fresh: bool) -> SettingsReport:
        """Return all settings: read now if `fresh`, otherwise the last values.

        Raises CommandError, TransferError, DeviceRefused, LinkError.
        """
        table = self._table()
        if fresh:
            async with self.exclusive():
                await self._read(table)
        status = self.status()
        assert status is not None
        return SettingsReport(
            self._config.name,
            self._driver_name,
            identity_words(self._identity.identity),
            status,
            described_settings(table, self._declared, self._actual),
        )

    async def plan(self, given: Mapping[str, Any] | None, *, save: bool) -> SettingsPlan:
        """Return the plan to set the values `given` (None: the declared settings). Raises as `report`."""
        table = self._table()
        wanted = self._wanted_values(table, given)
        async with self.exclusive():
            actual = await self._read(table)
            wanted = completed(table, wanted, actual)
            plan = self._make_plan(table, wanted, actual, save=save, unsaved=self._unsaved, by_name=given is not None)
            self._planned_resets = self._counter_resets
            return plan

    async def apply(self, given: Mapping[str, Any] | None, *, save: bool) -> AppliedSettings:
        """Set the values `given` (None: the declared settings). Raises as `report`, before the first write.

        imud uses the values of a plan if they are younger than PLAN_NS and no other script or restart followed.
        """
        table = self._table()
        wanted = self._wanted_values(table, given)
        planned = self._planned_values()
        async with self.exclusive():
            actual = planned if planned is not None else await self._read(table)
            wanted = completed(table, wanted, actual)
            return await self._apply(table, wanted, actual, save=save, asked=True, by_name=given is not None)

    def _planned_values(self) -> Values | None:
        """Return the values of a plan that are still valid; None if there are none."""
        if self.busy or self._read_ns is None or self._planned_resets != self._counter_resets:
            return None
        return self._actual if self._host.now_ns() - self._read_ns <= PLAN_NS else None

    @property
    def _counter_resets(self) -> int:
        return self._clock.status().resets if self._clock is not None else 0

    async def back_up(self, verb: str) -> None:
        """Write a backup before a verb that resets all settings, and report its file. The caller holds `exclusive`.

        If the backup fails, imud raises an event and runs the verb anyway: the verb may repair the device.
        """
        table = self._known_table()
        if table is None:
            return
        try:
            actual = await self._read(table)
            settable = [name for name, setting in table.table.items() if setting.write is not None and name in actual]
            values = {name: as_json(actual[name]) for name in settable}
            device, utc_ns = self._config.name, self._host.utc_ns()
            words = identity_words(self._identity.identity)
            text = backup_text(device, self._driver_name, words, values, utc_ns)
            writing = asyncio.to_thread(self._files.backups.write, device, text, utc_ns)
            file = await asyncio.wait_for(writing, BACKUP_LIMIT_S)
        except TimeoutError:
            self._raise(f"no backup of the settings before {verb}: the disk does not respond")
            return
        except (*DEVICE_ERRORS, OSError) as error:
            self._raise(f"no backup of the settings before {verb}: {reason_of(error)}")
            return
        if file is not None:
            self._raise(f"settings before {verb} are in {file}", file=str(file))
        else:
            self._raise(f"no backup of the settings before {verb}: there is no state directory")

    # --- comparison ---------------------------------------------------------------------------------------------------

    async def _keep(self) -> None:
        """Read the settings, report differences, and repair them if `on_difference` requests it."""
        table = self._known_table()
        if table is None:
            return
        try:
            actual = await self._read(table)
        except DEVICE_ERRORS as error:
            self._not_read(error)
            return
        self._tries, self._problem = 0, ""
        found = self._differences(table)
        self._report_differences(found)
        if isinstance(self._transport.driver, PolledDriver):
            self._due_ns = self._host.now_ns() + AGAIN_NS
        if self._config.on_difference is not OnDifference.REPORT:
            await self._repair(table, actual)

    async def _repair(self, table: SettingsTable, actual: Values) -> None:
        """Apply the declared settings, or set the time of the next repair."""
        save = self._config.on_difference is OnDifference.APPLY_AND_SAVE
        try:
            unsaved = self._unsaved and not self._is_saved(actual)
            plan = self._make_plan(table, self._declared, actual, save=save, unsaved=unsaved)
        except BadArgument as error:
            self._complain(f"cannot set the settings: {error}")
            return
        self._problem = "; ".join(f"{name} {why}" for name, why in plan.left_out.items())
        if plan.empty:
            return
        now_ns = self._host.now_ns()
        wait_ns = self._pauses.remaining_ns(self._module, now_ns)
        if wait_ns > 0:
            self._due_ns = now_ns + wait_ns
            self._problem = f"the device loses its settings; imud sets them again in {wait_ns / NS_PER_S:.0f} s"
            return
        self._pauses.add(now_ns)
        self._repairs += 1
        applied = await self._apply(table, self._declared, actual, save=save, asked=False)
        self._announce(applied)

    def _is_saved(self, actual: Values) -> bool:
        """Return whether flash contains the declared settings, because commands changed no value."""
        return actual == self._saved and all(name in actual for name in self._declared)

    async def _read(self, table: SettingsTable) -> Values:
        def read(target: Target) -> Any:
            self._target = target
            return table.read(target)

        actual: Values = await self._transport.run_script(read)
        self._actual, self._read_ns = actual, self._host.now_ns()
        return actual

    async def _apply(
        self, table: SettingsTable, wanted: Values, actual: Values, *, save: bool, asked: bool, by_name: bool = False
    ) -> AppliedSettings:
        plan = self._make_plan(table, wanted, actual, save=save, unsaved=self._unsaved, by_name=by_name)
        flash = ModuleFlash(self._writes, self._module, asked=asked)
        applying = Applying(table, self._transport.run_script, flash, wanted, actual)
        try:
            done = await applying.carry_out(plan)
        finally:
            self._written |= applying.written
            self._unsaved |= applying.changed
            self._actual = applying.actual if applying.heard else None
            self._read_ns = self._host.now_ns()
            if applying.saved:
                self._unsaved = False
                unreadable = {name: as_json(value) for name, value in self._all_written(table).items()}
                self._writes.keep_unreadable(self._module, unreadable)
        if asked:  # a repair raises an event, which the log contains
            log.info("%s: %s", self._config.name, _summary(done) or "all settings already have these values")
        self._report_differences(self._differences(table), quiet=True)
        if applying.changed:
            await self._transport.read_back(identity=done.restarted)
        return msgspec.structs.replace(done, advice=advice(self._config, plan, done))

    def _make_plan(
        self, table: SettingsTable, wanted: Values, actual: Values, *, save: bool, unsaved: bool, by_name: bool = False
    ) -> SettingsPlan:
        assert self._target is not None
        written = self._all_written(table)
        return make_plan(table, self._target, wanted, actual, written, save=save, unsaved=unsaved, by_name=by_name)

    def _all_written(self, table: SettingsTable) -> dict[str, Any]:
        """Return the written values of settings that the device does not report: saved, or since its restart."""
        found: dict[str, Any] = {}
        for name, value in self._writes.unreadable(self._module).items():
            try:
                found |= wanted_values(table, {name: value})
            except BadArgument:
                log.debug("%s: %s of an earlier version is not used", self._config.name, name)
        return found | self._written

    # --- events -------------------------------------------------------------------------------------------------------

    def _report_differences(self, found: Mapping[str, SettingDifference], *, quiet: bool = False) -> None:
        """Raise an event for new differences. With `quiet` a reply or another event already reports them."""
        if found and found != self._reported and not quiet:
            detail = {name: shown(one.actual) for name, one in found.items()}
            self._raise(f"settings differ from the declared settings: {words(found)}", **detail)
        elif not found and self._reported:
            self._raise("settings agree with the declared settings again")
        self._reported = found

    def _announce(self, applied: AppliedSettings) -> None:
        """Raise an event for a repair."""
        if applied.problem:
            self._problem = applied.problem
            now_ns = self._host.now_ns()
            self._due_ns = now_ns + max(self._pauses.remaining_ns(self._module, now_ns), NS_PER_S)
        detail = {step.name: str(step.outcome) for step in applied.steps}
        self._raise(_summary(applied), saved=applied.saved, **detail)

    def _not_read(self, error: Exception) -> None:
        """Set the time of the next read; after READ_TRIES report the error."""
        self._tries += 1
        self._actual = None
        if self._tries < READ_TRIES:
            self._problem = f"cannot read the settings: {error}"
            self._due_ns = self._host.now_ns() + READ_AGAIN_NS
        else:
            self._complain(f"cannot read the settings after {self._tries} tries: {error}")

    def _complain(self, problem: str) -> None:
        if problem != self._problem:
            self._raise(problem)
        self._problem = problem

    def _raise(self, message: str, **detail: str | bool) -> None:
        self._events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message, **detail)

    # --- parts --------------------------------------------------------------------------------------------------------

    @property
    def _declared(self) -> Values:
        return declared_values(self._config.declared)

    @property
    def _driver_name(self) -> str:
        driver = self._transport.driver
        return driver.name if driver is not None else self._config.driver

    @property
    def _module(self) -> str:
        """Key of the device in the counts of flash writes: serial number; without one the name of the device."""
        serial_number = self._identity.identity.serial_number
        return f"{self._driver_name} {serial_number}" if serial_number else f"device {self._config.name}"

    def _differences(self, table: SettingsTable) -> dict[str, SettingDifference]:
        if self._actual is None:
            return {}
        return differences(table, self._declared, self._actual, self._all_written(table))

    def _known_table(self) -> SettingsTable | None:
        driver = self._transport.driver
        return driver.device_settings if driver is not None else None

    def _table(self) -> SettingsTable:
        table = self._known_table()
        if table is None:
            name = self._driver_name
            raise CommandError(f"{self._config.name}: driver {name} cannot read or write device settings")
        return table

    def _wanted_values(self, table: SettingsTable, given: Mapping[str, Any] | None) -> Values:
        if given is not None:
            return wanted_values(table, given)
        if not self._declared:
            raise BadArgument(f"{self._config.name}: expected values, or `settings` in the configuration, got neither")
        return self._declared


def _summary(applied: AppliedSettings) -> str:
    """Describe the steps, for example `settings: mode set to "6-axis" (was "9-axis"); saved to flash`."""
    parts = []
    for step in applied.steps:
        if step.outcome is StepOutcome.NOT_DONE:
            continue
        before = f" (was {shown(step.before)})" if step.before is not None else ""
        note = "" if step.outcome is StepOutcome.DONE else f": {step.outcome}"
        parts.append(f"{step.name} set to {shown(step.value)}{before}{note}")
    ends = ["saved to flash"] * applied.saved + ["restarted"] * applied.restarted
    ends += [applied.problem] if applied.problem else []
    return "settings: " + "; ".join([", ".join(parts), *ends] if parts else ends) if parts or ends else ""
