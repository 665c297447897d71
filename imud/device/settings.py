"""Identity and settings of one device: read, compared with the declared settings, and repaired if this is configured.

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
from itertools import islice
from typing import Any, Final

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.command import REQUESTED_BY
from imud.contracts.driver import SAMPLE_COUNTER, Identity, PolledDriver
from imud.contracts.setting import (
    AppliedSettings,
    OnDifference,
    Reports,
    SettingDifference,
    SettingsPlan,
    SettingsReport,
    SettingsState,
    SettingsStatus,
    SettingsTable,
    StepOutcome,
    combined,
    declared_values,
)
from imud.contracts.status import WorkStatus
from imud.device.flash import FlashValues, ModuleFlash, SettingsFiles, backup_text
from imud.device.health import DeviceEvents
from imud.device.settings_plan import (
    DEVICE_ERRORS,
    SettingsPort,
    Values,
    advice,
    as_json,
    completed,
    described_settings,
    differences,
    make_plan,
    settable_values,
    wanted_values,
    words,
)
from imud.device.settings_writes import Applying
from imud.host.clock import HostClock
from imud.host.log import printable
from imud.model.errors import BadArgument, CommandError, reason_of
from imud.model.event import EventKind
from imud.model.options import shown
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.recording.observer import PathObserver
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
READ_AGAIN_NS: Final = 5 * NS_PER_S  # pause before imud reads the settings again after an error, ns
READ_TRIES: Final = 3  # number of reads before imud waits for the next restart, replug or command
PAUSES_S: Final = (0, 10, 60, 600, 3600)
"""Pauses before the first, second, … repair within PAUSES_FORGOTTEN_S, s. The last pause repeats."""
WORDS_MAX: Final = 200  # maximum number of settings or details of one device. The HI14 has the most, about 60.
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


class SettingsComparison:
    """Comparison of the declared settings of a device with its settings, and their repair if this is configured."""

    def __init__(self, settings: "DeviceSettings", config: DeviceConfig, host: HostClock) -> None:
        self.problem = ""  # reason why imud could not read or write the settings, one sentence
        self.repairs = 0  # number of repairs since start
        self._settings = settings
        self._on_difference = config.on_difference
        self._host = host
        self._wanted = asyncio.Event()
        self.due_ns: int | None = None  # CLOCK_MONOTONIC of the next comparison; None: after the next event
        self._tries = 0
        self._pauses = RepairPauses()

    def schedule(self, after_ns: int) -> None:
        """Compare after this time, because the settings can have changed."""
        self._tries, self.due_ns = 0, self._host.now_ns() + after_ns

    def start_if_due(self, now_ns: int | None) -> None:
        """Start the scheduled comparison if its time has passed; None: in any case."""
        if self.due_ns is not None and (now_ns is None or now_ns >= self.due_ns):
            self._wanted.set()

    def cancel(self) -> None:
        self.due_ns = None
        self._wanted.clear()

    async def run(self) -> None:
        """Compare the settings when a comparison is due. Ends only by an internal error."""
        settings = self._settings
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            with suppress(CommandError):  # another command is running: imud compares after it
                async with settings.lock.hold("the comparison of the settings", can_restart=False):
                    self.due_ns = None
                    if settings.table is not None:
                        await self._compare(settings.table)

    async def _compare(self, table: SettingsTable) -> None:
        """Compare the settings, report differences, and repair them if this is configured."""
        settings = self._settings
        try:
            actual = await settings.valid_values()
        except DEVICE_ERRORS as error:
            self._not_read(error)
            return
        self._tries, self.problem = 0, ""
        settings.report_differences()
        if settings.is_polled and settings.declared:
            self.due_ns = self._host.now_ns() + AGAIN_NS
        if self._on_difference is not OnDifference.REPORT:
            await self._repair(table, actual)

    async def _repair(self, table: SettingsTable, actual: Values) -> None:
        """Apply the declared settings, or set the time of the next repair."""
        settings, save = self._settings, self._on_difference is OnDifference.APPLY_AND_SAVE
        try:
            plan = settings.plan_repair(table, actual, save=save)
        except BadArgument as error:
            self._complain(f"cannot set the settings: {error}")
            return
        self.problem = "; ".join(f"{name} {why}" for name, why in plan.left_out.items())
        if plan.empty:
            return
        now_ns = self._host.now_ns()
        wait_ns = self._pauses.remaining_ns(settings.module, now_ns)
        if wait_ns > 0:
            self.due_ns = now_ns + wait_ns
            self.problem = f"the device loses its settings; imud sets them again in {wait_ns / NS_PER_S:.0f} s"
            return
        self._pauses.add(now_ns)
        self.repairs += 1
        self._announce(await settings.carry_out(table, settings.declared, actual, save=save, asked=False))

    def _announce(self, applied: AppliedSettings) -> None:
        """Raise an event for a repair."""
        if applied.problem:
            self.problem = applied.problem
            now_ns = self._host.now_ns()
            self.due_ns = now_ns + max(self._pauses.remaining_ns(self._settings.module, now_ns), NS_PER_S)
        detail = {step.name: str(step.outcome) for step in applied.steps}
        self._settings.raise_event(_summary(applied), saved=applied.saved, **detail)

    def _not_read(self, error: Exception) -> None:
        """Set the time of the next read; after READ_TRIES report the error."""
        self._tries += 1
        self._settings.forget()
        if self._tries < READ_TRIES:
            self.problem = f"cannot read the settings: {error}"
            self.due_ns = self._host.now_ns() + READ_AGAIN_NS
        else:
            self._complain(f"cannot read the settings after {self._tries} tries: {error}")

    def _complain(self, problem: str) -> None:
        if problem != self.problem:
            self._settings.raise_event(problem)
        self.problem = problem


class WorkLock:
    """Lock of a device for one command, calibration or change of settings at a time."""

    def __init__(self, device: str, host: HostClock) -> None:
        self._device = device
        self._host = host
        self._lock = asyncio.Lock()
        self.work: WorkStatus | None = None  # work that holds the lock
        self.can_restart = False  # whether this work can restart the device counter
        self.ended_ns = -OWN_NS - BOOT_NS  # CLOCK_MONOTONIC of the end of the last work that can restart it, ns

    @asynccontextmanager
    async def hold(self, work: str, stop: str = "", *, can_restart: bool = True) -> AsyncIterator[None]:
        """Hold the lock for `work`, for example `the command save`. `stop`: how a user can stop it. `can_restart`:
        whether the work can restart the device counter.

        Raises CommandError if other work does not end within WAIT_S, and immediately during work that a user can stop
        (a calibration). The error names the work.
        """
        wait_s = 0.0 if self.work is not None and self.work.stop else WAIT_S
        try:
            async with asyncio.timeout(wait_s):
                await self._lock.acquire()
        except TimeoutError:
            words = self.work.words(self._host.now_ns()) if self.work is not None else "other work has just ended"
            raise CommandError(f"{self._device}: {words}; try again later") from None
        self.work = WorkStatus(work, self._host.now_ns(), REQUESTED_BY.get() or "imud", stop)
        self.can_restart = can_restart
        try:
            yield
        finally:
            if self.can_restart:
                self.ended_ns = self._host.now_ns()
            self.work, self.can_restart = None, False
            self._lock.release()


class DeviceSettings:
    """Identity and settings of one device; an attachment. Synchronization: the loop's thread only."""

    def __init__(
        self, config: DeviceConfig, transport: SettingsPort, events: DeviceEvents, observer: PathObserver,
        host: HostClock, files: SettingsFiles,
    ) -> None:  # fmt: skip
        """All devices share `files`."""
        self.identity = Identity()
        # key of the device in the counts of flash writes: its serial number; without one the name of the device
        self.module = f"device {config.name}"
        self.shown: Mapping[str, str] = {}  # settings with readable names and values
        self.answered = False  # whether the device replied to all requests of the newest query; set by the transport
        self._config = config
        self.declared = declared_values(config.declared)
        self._transport = transport
        self._events = events
        self._observer = observer
        self._host = host
        self._files = files
        self._reports: Reports = {}
        self.values: Values = {}  # values of the settings that the device reported last
        self.is_current = False  # whether the device still has the settings of `_reports`
        self._read_ns: int | None = None
        # resets of the device counter at the newest read of all reports if no other script followed; None otherwise
        self._read_resets: int | None = None
        self._clock: SampleClock | None = None
        self.resets = 0  # resets of the device counter at the last tick
        self.resets_requested = 0  # number of restarts of the device counter that a script of imud caused
        self.lock = WorkLock(config.name, host)
        # values that imud wrote since the last restart, of settings that the device does not report
        self._written: dict[str, Any] = {}
        self.is_unsaved = False  # whether a write since the last restart may be missing in flash
        self._saved: Values | None = None  # while `is_unsaved`: the values before the write; None if they are unknown
        self._in_flash = FlashValues()
        self._differing: Mapping[str, SettingDifference] = {}
        self.comparison = SettingsComparison(self, config, host)

    # --- the attachment -----------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """Note that the settings may differ: imud has found the device again, or another device."""
        self._clock, self.resets = clock, clock.resets
        self.is_current = False
        self._after_start(BEGIN_NS)
        if not self.declared:
            self.comparison.cancel()  # the query of the identity reads the settings
        self._in_flash.found()

    def tick(self, now_ns: int, _newest: Sample | None) -> None:
        """Detect a restart of the device counter. Start a comparison if one is due and the device can reply."""
        if (resets := self.counter_resets) != self.resets:
            own_until_ns = self.lock.ended_ns + OWN_NS
            is_own = self.lock.can_restart or now_ns < own_until_ns + BOOT_NS
            self._count_resets(resets, is_own=is_own)
            if not self.lock.can_restart and now_ns >= own_until_ns:
                self._in_flash.started()
                self._after_start(SETTLE_NS)
                if not self._transport.may_ask:
                    self.is_current = False  # imud does not know which unsaved values the restart has removed
                if not self.declared and (self._read_ns is None or not self._transport.may_ask):
                    self.comparison.cancel()  # imud has not read the settings, or must not
        if self.comparison.due_ns is not None and self.lock.work is None and self._transport.can_be_asked:
            self.comparison.start_if_due(now_ns)

    def _count_resets(self, resets: int, *, is_own: bool) -> None:
        """Note the resets of the device counter. `is_own`: a script of imud caused the new resets."""
        if is_own:
            self.resets_requested += resets - self.resets
        self.resets = resets

    def after_silence(self) -> None:
        """Compare the settings of a device that has no counter: it can have restarted in the pause of its samples."""
        driver = self._transport.driver
        if driver is None or driver.tick_ns != SAMPLE_COUNTER:
            return
        if self.declared or (self.is_unsaved and self._transport.may_ask):
            self._read_resets = None
            self.comparison.schedule(SETTLE_NS)
        elif self.is_unsaved:
            self.is_current = False  # imud must not read which values a restart has removed

    def forget(self) -> None:
        """Note that the settings of the device may differ from the last values."""
        self.is_current = False

    @property
    def is_polled(self) -> bool:
        """Whether imud must compare the settings regularly, because no counter shows a restart."""
        return isinstance(self._transport.driver, PolledDriver)

    def stop(self) -> None:
        """Note that the settings may differ: the link ended. A second call does nothing."""
        self.is_current = False
        self.comparison.cancel()

    close = stop

    def _after_start(self, after_ns: int) -> None:
        """Note that the device has the settings of its flash, and compare them after `after_ns`."""
        self._differing, self._written, self.is_unsaved = {}, {}, False
        self._read_resets = None
        self.comparison.schedule(after_ns)

    # --- reports of the device ----------------------------------------------------------------------------------------

    def update_identity(self, identity: Identity) -> None:
        """Store a new identity. Raise an event if another device has replied."""
        before = self.identity
        self.identity = identity = completed_identity(printable_identity(identity), before)
        number = identity.serial_number
        self.module = f"{self._driver_name} {number}" if number else f"device {self._config.name}"
        if before.serial_number and identity.serial_number != before.serial_number:
            message = f"another device: serial number {identity.serial_number}, was {before.serial_number}"
            self.raise_event(message, serial_number=identity.serial_number)
            self._forget_device()

    def _forget_device(self) -> None:
        """Discard all values of a former device on the same port. The next read stores the values of the new device."""
        self._reports = {}
        self.values = {}
        self.shown = {}
        self.is_current = False
        self._read_ns = self._read_resets = None
        self._written = {}
        self.is_unsaved = False
        self._saved = None
        self._in_flash.found()
        self._differing = {}

    def update(self, reports: Reports, *, own: bool = False) -> None:
        """Store all reports. Raise an event if a known setting has another value, and compare the GPIO lines.

        `own`: a command of imud has just run, so the change is expected.
        """
        driver, known, report, before = self._transport.driver, self.shown, combined(reports), self.values
        self._reports, self.values, self.is_current = reports, report.values, True
        self._read_ns = now_ns = self._host.now_ns()
        if self._in_flash.follows:
            self._in_flash.saved(self.values, is_certain=True)
        if self.is_unsaved and not own and before != self._saved == self.values:
            self.is_unsaved = False  # a restart without a counter: the device has the values of its flash again
        text = printable_words(report.words)
        self.shown = printable_words(driver.shown_settings(text)) if driver is not None else text
        changed, texts = {}, []
        for name, value in self.shown.items():
            if known.get(name, value) != value:
                changed[name] = value
                texts.append(f"{name} is {value}, was {known[name]}")
        if changed:
            what = "a command changed settings of the device" if own else "settings of the device changed"
            level = logging.INFO if own else logging.WARNING
            self._events.report(level, now_ns, EventKind.CONFIGURATION, f"{what}: {', '.join(texts)}", changed)
        if self._observer.listeners:
            self._observer.described(self._transport.where, identity_words(self.identity), self.shown)
        self._transport.attachments.compare_settings(self.values, driver)
        self._transport.use_axes(self.shown)

    async def read(self, *, own: bool = False) -> Values:
        """Read all reports; no report if the driver has no table of settings. Raises as `report`. `own` as `update`."""
        table = self.table
        if table is None:
            self.update({}, own=own)
            return {}
        self.update(await self._transport.run_script(table.read, None), own=own)
        self._read_resets = self.counter_resets
        if self.comparison.due_ns is not None and self._transport.can_be_asked:
            self.comparison.start_if_due(None)
        return self.values

    async def read_again(self, *, identity: bool) -> None:
        """Read all reports after a command, and the identity if the device may have restarted."""
        self.is_current = False
        if self.table is None or not self._transport.may_ask:
            return
        try:
            if identity:
                await self._transport.read_identity()
            await self.read(own=True)
        except DEVICE_ERRORS as error:
            log.info("%s: settings not read back: %s", self._config.name, error)

    async def valid_values(self) -> Values:
        """Return the present values: of the newest read, or of a new read if they can be out of date.

        They are valid for PLAN_NS if no other script and no restart followed. Raises as `report`.
        """
        is_valid = self.is_current and self._read_ns is not None and self._read_resets == self.counter_resets
        if is_valid and self._host.now_ns() - (self._read_ns or 0) <= PLAN_NS:
            return self.values
        return await self.read()

    @property
    def counter_resets(self) -> int:
        return self._clock.resets if self._clock is not None else 0

    # --- requests -----------------------------------------------------------------------------------------------------

    def status(self) -> SettingsStatus | None:
        """Return the newest comparison; None if the driver has no table of settings."""
        table = self.table
        if table is None:
            return None
        found = self.differences()
        state = SettingsState.DIFFER if found else SettingsState.AGREE
        state = state if self.is_current else SettingsState.UNKNOWN
        not_reported = self.declared.keys() - self.values.keys()
        is_known = self.is_unsaved and self.is_current
        lost, unknown = self._in_flash.lost(self._saved, self.values) if is_known else ({}, ())
        return SettingsStatus(
            state if self.declared else SettingsState.UNDECLARED,
            self._config.on_difference,
            self.comparison.problem,
            found,
            tuple(filter(not_reported.__contains__, table.table)) if self.is_current else (),
            self._read_ns, self.comparison.repairs,
            self._files.flash.record(self.module).writes, self._files.flash.writes_day(self.module),
            self.is_unsaved and table.save is not None,
            as_json(lost), unknown,
        )  # fmt: skip

    async def report(self, *, fresh: bool) -> SettingsReport:
        """Return all settings: read now if `fresh`, otherwise the last values.

        Raises CommandError, TransferError, DeviceRefused, LinkError.
        """
        if fresh:
            self._transport.require_replies()
        table = self._table()
        if fresh:
            async with self.lock.hold("a read of the settings", can_restart=False):
                await self.read()
        status = self.status()
        assert status is not None
        actual = self.values if self.is_current else None
        found = described_settings(table, self.declared, actual, self._in_flash)
        return SettingsReport(self._config.name, self._driver_name, identity_words(self.identity), status, found)

    async def plan(self, given: Mapping[str, Any] | None, *, save: bool) -> SettingsPlan:
        """Return the plan to set the values `given` (None: the declared settings). Raises as `report`."""
        self._transport.require_replies()
        table = self._table()
        wanted = _wanted(self._config.name, table, given, self.declared)
        async with self.lock.hold("a plan of settings", can_restart=False):
            actual = await self.read()
            wanted = completed(table, wanted, actual)
            target, written = self._transport.target, self._all_written(table)
            by_name, unsaved = given is not None, self.is_unsaved
            return make_plan(table, target, wanted, actual, written, save=save, unsaved=unsaved, by_name=by_name)

    async def apply(self, given: Mapping[str, Any] | None, *, save: bool) -> AppliedSettings:
        """Set the values `given` (None: the declared settings). Raises as `report`, before the first write."""
        self._transport.require_replies()
        table = self._table()
        wanted = _wanted(self._config.name, table, given, self.declared)
        async with self.lock.hold("a change of settings"):
            actual = await self.valid_values()
            wanted = completed(table, wanted, actual)
            return await self.carry_out(table, wanted, actual, save=save, asked=True, by_name=given is not None)

    def script_follows(self, *, changes: bool) -> None:
        """Note that a script runs, and whether it can change the settings."""
        self._read_resets = None
        if changes:
            self._transport.attachments.set_alarm_ranges(None)  # the script can change the ranges

    def flash_is_current(self, *, changed: bool) -> None:
        """Note that the device has the settings of its flash: after a save or a restart.

        `changed`: the settings can differ from the last values.
        """
        self.is_unsaved, is_certain = False, self.table is None or self.table.save_is_certain
        if changed or (is_certain and not self.is_current):
            self._in_flash.started()
        else:
            self._in_flash.saved(self.values, is_certain=is_certain)

    def changed(self, *, unsaved: bool) -> None:
        """Note that a command can have changed any setting, and whether the flash may not contain the change."""
        if unsaved:
            self._mark_unsaved(self.values if self.is_current else None)
        self._read_resets = None
        if self.declared:
            self.comparison.schedule(0)

    def _mark_unsaved(self, before: Values | None) -> None:
        """Note that the flash does not contain the present settings. `before`: the values before the write."""
        if not self.is_unsaved:
            self.is_unsaved = True
            self._saved = before
            # A restart since the last tick can be earlier or later than the write. The change counts as unsaved until
            # the next read shows the values: a wrong warning is better than a lost value without a warning.
            self._count_resets(self.counter_resets, is_own=self.lock.can_restart)
        self._in_flash.follows = False

    def spend_flash(self) -> None:
        """Count a write to flash before a command makes it. Raises CommandError if the limit is reached."""
        flash, module = self._files.flash, self.module
        if refusal := flash.refusal(module, asked=True):
            raise CommandError(f"{self._config.name}: {refusal}")
        flash.count(module)

    async def back_up(self, verb: str) -> None:
        """Write a backup before a verb that resets all settings, and report its file.

        If the backup fails, imud raises an event and runs the verb anyway: the verb may repair the device.
        """
        table = self.table
        if table is None:
            return
        try:
            actual = await self.read()
            values, utc_ns = settable_values(table, actual), self._host.utc_ns()
            identity = identity_words(self.identity)
            text = backup_text(self._config.name, self._driver_name, identity, values, utc_ns)
            file = await self._files.backups.write_soon(self._config.name, text, utc_ns)
        except (*DEVICE_ERRORS, OSError) as error:
            self.raise_event(f"no backup of the settings before {verb}: {reason_of(error)}")
            return
        self.raise_event(f"settings before {verb} are in {file}", file=str(file))

    # --- comparison ---------------------------------------------------------------------------------------------------

    async def carry_out(
        self, table: SettingsTable, wanted: Values, actual: Values, *, save: bool, asked: bool, by_name: bool = False
    ) -> AppliedSettings:
        """Set the values `wanted`. `asked`: a user or program requested it. The caller holds `exclusive`."""
        target, written, unsaved = self._transport.target, self._all_written(table), self.is_unsaved
        plan = make_plan(table, target, wanted, actual, written, save=save, unsaved=unsaved, by_name=by_name)
        flash = ModuleFlash(self._files.flash, self.module, asked=asked)
        applying = Applying(table, self._transport, flash, wanted, self._reports)
        self._transport.attachments.set_alarm_ranges(None)  # the new settings can change the ranges
        self._read_resets = None
        self.lock.can_restart = True
        try:
            done = await applying.carry_out(plan)
        finally:
            self._written |= applying.written
            if applying.changed:
                self._mark_unsaved(actual)
            self.update(applying.reports, own=True)
            self.is_current = applying.heard
            if applying.saved:
                self.is_unsaved = False
                self._in_flash.saved(self.values, is_certain=table.save_is_certain)
                unreadable = {name: as_json(value) for name, value in self._all_written(table).items()}
                self._files.flash.keep_unreadable(self.module, unreadable)
        if asked:  # a repair raises an event, which the log contains
            log.info("%s: %s", self._config.name, _summary(done) or "all settings already have these values")
        self.report_differences(quiet=True)
        if done.restarted and self._transport.may_ask:
            with suppress(*DEVICE_ERRORS):
                await self._transport.read_identity()
        not_saved = "" if done.problem else self.not_saved
        return msgspec.structs.replace(done, advice=advice(self._config, plan, done), not_saved=not_saved)

    @property
    def not_saved(self) -> str:
        """That the flash lacks a change, and the next step; empty if it contains all settings or cannot be written."""
        is_lost = self.is_unsaved and self.table is not None and self.table.save is not None
        return f"not saved; run `imud command {self._config.name} save`" if is_lost else ""

    def plan_repair(self, table: SettingsTable, actual: Values, *, save: bool) -> SettingsPlan:
        """Return the plan to set the declared settings. Raises BadArgument."""
        # flash contains the declared settings if commands changed no value
        saved = actual == self._saved and all(name in actual for name in self.declared)
        target, written, unsaved = self._transport.target, self._all_written(table), self.is_unsaved and not saved
        return make_plan(table, target, self.declared, actual, written, save=save, unsaved=unsaved)

    def _all_written(self, table: SettingsTable) -> dict[str, Any]:
        """Return the written values of settings that the device does not report: saved, or since its restart."""
        found: dict[str, Any] = {}
        for name, value in self._files.flash.record(self.module).unreadable.items():
            with suppress(BadArgument):  # another version of imud saved the value
                found |= wanted_values(table, {name: value})
        return found | self._written

    # --- events -------------------------------------------------------------------------------------------------------

    def report_differences(self, *, quiet: bool = False) -> None:
        """Raise an event for new differences. With `quiet` a reply or another event already reports them."""
        found = self.differences()
        if found and found != self._differing and not quiet:
            detail = {name: shown(one.actual) for name, one in found.items()}
            self.raise_event(f"settings differ from the declared settings: {words(found)}", **detail)
        elif not found and self._differing:
            self.raise_event("settings agree with the declared settings again")
        self._differing = found

    def raise_event(self, message: str, /, **detail: str | bool) -> None:
        self._events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message, **detail)

    # --- parts --------------------------------------------------------------------------------------------------------

    @property
    def _driver_name(self) -> str:
        driver = self._transport.driver
        return driver.name if driver is not None else self._config.driver

    def differences(self) -> dict[str, SettingDifference]:
        """Return the differences of the present settings from the declared settings."""
        table = self.table
        if table is None or not self.is_current:
            return {}
        return differences(table, self.declared, self.values, self._all_written(table))

    @property
    def table(self) -> SettingsTable | None:
        """Table of the driver; None before imud has found the device, and for a driver without a table."""
        driver = self._transport.driver
        return driver.device_settings if driver is not None else None

    def _table(self) -> SettingsTable:
        table = self.table
        if table is None:
            raise CommandError(f"{self._config.name}: {self._driver_name} cannot read or write device settings")
        return table


def _wanted(device: str, table: SettingsTable, given: Mapping[str, Any] | None, declared: Values) -> Values:
    """Return the values `given` (None: the declared values). Raises BadArgument."""
    if given is not None:
        return wanted_values(table, given)
    if not declared:
        raise BadArgument(f"{device}: expected values, or `settings` in the configuration, got neither")
    return declared


def _summary(applied: AppliedSettings) -> str:
    """Describe the steps, for example `settings: mode set to "6-axis" (was "9-axis"); saved to flash; restarted`."""
    parts = []
    for step in applied.steps:
        if step.outcome is StepOutcome.NOT_DONE:
            continue
        before = f" (was {shown(step.before)})" if step.before is not None else ""
        note = "" if step.outcome is StepOutcome.VERIFIED else f": {step.outcome}"
        parts.append(f"{step.name} set to {shown(step.value)}{before}{note}")
    ends = [*applied.ends, *([applied.problem] if applied.problem else [])]
    return "settings: " + "; ".join([", ".join(parts), *ends] if parts else ends) if parts or ends else ""


def completed_identity(identity: Identity, before: Identity) -> Identity:
    """Return `identity` with its empty members from `before`, unless both belong to different devices.

    An adapter that was just plugged in can lose bytes of the first replies.
    """
    pairs = ((identity.product, before.product), (identity.serial_number, before.serial_number))
    if any(new and old and new != old for new, old in pairs):
        return identity
    return Identity(
        identity.product or before.product,
        identity.serial_number or before.serial_number,
        identity.firmware or before.firmware,
        before.details if identity.details is None else identity.details,
    )


def printable_identity(identity: Identity) -> Identity:
    """Return an identity with texts of limited length in printable characters."""
    product, serial, firmware = map(printable, (identity.product, identity.serial_number, identity.firmware))
    return Identity(product, serial, firmware, None if identity.details is None else printable_words(identity.details))


def printable_words(words: Mapping[str, str]) -> dict[str, str]:
    """Return the first WORDS_MAX names and texts of a device, in printable characters of limited length."""
    return {printable(name): printable(text) for name, text in islice(words.items(), WORDS_MAX)}


def identity_words(identity: Identity) -> dict[str, str]:
    """Return an identity as the mapping in `DeviceStatus`, without empty members."""
    words = {
        "product": identity.product,
        "serial_number": identity.serial_number,
        "firmware": identity.firmware,
        **(identity.details or {}),
    }
    return {name: value for name, value in words.items() if value}
