"""State of each device over all runs of imud: flash writes, limited per day, last calibrations, and backups.

The flash of such devices endures about 10,000 writes. imud by itself makes at most LIMIT_ITSELF writes in 24 hours: at
this rate the flash lasts about seven years. Users and programs may make LIMIT_ASKED writes in 24 hours.
"""

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec

from imud.config.yaml import yaml_block, yaml_comment
from imud.contracts.command import CalibrationResult, LastCalibration
from imud.contracts.setting import SavedState
from imud.device.pending_updates import PendingUpdates
from imud.host.clock import HostClock
from imud.host.files import StateFile, replace_file
from imud.model.errors import CommandError
from imud.model.units import NS_PER_S

FILE_NAME: Final = "settings.json"
DAY_S: Final = 24 * 3600
LIMIT_ITSELF: Final = 4  # maximum number of writes in 24 hours before imud stops its own writes. All writes count.
LIMIT_ASKED: Final = 40  # maximum number of writes in 24 hours, also on request
MODULES_MAX: Final = 1024
"""Maximum number of records: the devices that imud wrote last. A daemon has at most 256 devices."""


class ModuleRecord(msgspec.Struct):
    """Flash writes and calibrations of one device."""

    writes: int = 0  # number of writes by imud
    times_s: list[int] = []  # msgspec copies a mutable default
    """UTC of the newest LIMIT_ASKED writes, s, oldest first."""
    unreadable: dict[str, Any] = msgspec.field(name="told", default_factory=dict)
    """Saved values of settings that the device does not report, as JSON."""
    calibrations: dict[str, LastCalibration] = {}  # last result of each kind


class FlashWrites:
    """Flash writes and calibrations of all devices. Synchronization: the loop's thread only."""

    def __init__(self, folder: Path | None, host: HostClock) -> None:
        """`folder` contains the file; None: imud keeps the counts in memory."""
        self._file = StateFile(
            folder / FILE_NAME if folder else None, "settings", "imud counts the writes to flash from 0"
        )
        self._modules = self._file.read(dict[str, ModuleRecord])
        self._host = host

    def record(self, module: str) -> ModuleRecord:
        """Return the record of a device; an empty record if no record exists."""
        return self._modules.get(module) or ModuleRecord()

    def writes_day(self, module: str) -> int:
        """Return the number of writes in the last 24 hours. A write in the future (a wrong clock) counts as of now."""
        now_s, record = self._host.utc_ns() // NS_PER_S, self.record(module)
        record.times_s = [min(time_s, now_s) for time_s in record.times_s]
        return sum(time_s > now_s - DAY_S for time_s in record.times_s)

    def refusal(self, module: str, *, asked: bool) -> str:
        """Return why imud must not write the flash now, one sentence; empty if it may. `asked`: a user requested it."""
        limit, written = LIMIT_ASKED if asked else LIMIT_ITSELF, self.writes_day(module)
        if written < limit:
            return ""
        who = "" if asked else " of imud itself"
        return f"its flash was written {written} times in 24 hours, the limit{who} is {limit}: flash wears out"

    def count(self, module: str) -> None:
        """Count a write, before imud makes it."""
        record = self._modules.pop(module, None) or ModuleRecord()
        record.writes += 1
        record.times_s = [*record.times_s, self._host.utc_ns() // NS_PER_S][-LIMIT_ASKED:]
        self._keep(module, record)

    def keep_unreadable(self, module: str, values: Mapping[str, Any]) -> None:
        """Store the saved values of settings that the device does not report."""
        if self.record(module).unreadable != values:
            record = self._modules.pop(module, None) or ModuleRecord()
            record.unreadable = dict(values)
            self._keep(module, record)

    def keep_calibration(self, module: str, result: CalibrationResult) -> None:
        """Store the result of a calibration."""
        record = self._modules.pop(module, None) or ModuleRecord()
        last = LastCalibration(self._host.utc_ns(), result.verified, result.saved, result.problem, result.checks)
        record.calibrations = record.calibrations | {result.kind: last}
        self._keep(module, record)

    def close(self) -> None:
        """Wait for the end of the last write, for a limited time. A second call does nothing."""
        self._file.close()

    def _keep(self, module: str, record: ModuleRecord) -> None:
        """Store the record as the newest, and remove the oldest records above MODULES_MAX."""
        self._modules[module] = record
        while len(self._modules) > MODULES_MAX:
            del self._modules[next(iter(self._modules))]
        self._file.write(self._modules)


@dataclass
class ModuleFlash:
    """Flash of one device, for writes of a user or program (`asked`) or of imud itself."""

    writes: FlashWrites
    module: str
    asked: bool

    def spend(self) -> None:
        """Count a write before imud makes it. Raises CommandError if the limit is reached."""
        if refusal := self.writes.refusal(self.module, asked=self.asked):
            raise CommandError(refusal)
        self.writes.count(self.module)


class FlashValues:
    """Values of the settings in the flash of one device, as far as imud knows them.

    imud cannot read the flash. After a start of the device that imud observed, the first values that it reads are equal
    to the values of the flash. After a save, the flash contains the present values.
    """

    def __init__(self) -> None:
        self.follows = False  # whether the next read values are equal to the flash
        self._values: Mapping[str, Any] | None = None

    def found(self) -> None:
        """Note that imud found a device. It can have unsaved changes of another program."""
        self._values, self.follows = None, False

    def started(self) -> None:
        """Note that the device started and now has the values of its flash, or that it saved unknown values."""
        self._values, self.follows = None, True

    def saved(self, values: Mapping[str, Any], *, is_certain: bool) -> None:
        """Note that the device confirmed a save of these values. `is_certain`: whether the flash now contains them."""
        self._values, self.follows = dict(values) if is_certain else None, False

    def state(self, name: str, actual: object) -> tuple[SavedState, object]:
        """Compare a present value with the flash. Return the state and the value in flash; None if it is unknown."""
        if self._values is None or name not in self._values or actual is None:
            return SavedState.UNKNOWN, None
        saved = self._values[name]
        return SavedState.SAME if saved == actual else SavedState.DIFFERS, saved

    def lost(self, before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
        """Return the present values that flash does not contain, and the names whose value in flash is unknown.

        `before`: the values before the unsaved change; None if they are unknown.
        """
        states = {name: self.state(name, one)[0] for name, one in now.items()}
        changed = {name for name, one in now.items() if before is not None and before.get(name) != one}
        unknown = tuple(name for name, one in states.items() if one is SavedState.UNKNOWN and name in changed)
        lost = {name: now[name] for name, one in states.items() if one is SavedState.DIFFERS or name in unknown}
        return lost, unknown


FOLDER: Final = "backups"
BACKUP_LIMIT_S: Final = 5.0  # maximum wait of a command for the disk, s
BACKUPS_MAX: Final = 10  # maximum number of backups of one device


def backup_text(device: str, driver: str, identity: Mapping[str, str], settings: Mapping[str, Any], utc_ns: int) -> str:
    """Return the text of a backup. `settings` contains the JSON values of all writable settings."""
    time = _time(utc_ns).isoformat(timespec="seconds").replace("+00:00", "Z")
    content = {"device": device, "driver": driver, "time": time, "identity": identity, "settings": settings}
    head = f"Settings of {device} as the device reported them. `imud settings {device} --restore FILE` sets them again."
    return f"{yaml_comment(head)}\n{yaml_block(content)}\n"


class BackupFolder:
    """Folder of automatic backups."""

    def __init__(self, state_dir: Path | None) -> None:
        """`state_dir` contains the folder; None: imud writes no backups."""
        self._folder = state_dir / FOLDER if state_dir else None

    async def write_soon(self, device: str, text: str, utc_ns: int) -> Path:
        """Write a backup in another thread and return its path. Raises OSError also without a folder or a reply."""
        writing = asyncio.to_thread(self.write, device, text, utc_ns)
        try:
            return await asyncio.wait_for(writing, BACKUP_LIMIT_S)
        except TimeoutError:
            raise OSError("the disk does not respond") from None

    def write(self, device: str, text: str, utc_ns: int) -> Path:
        """Write a backup and remove old backups. Return its path. Raises OSError also without a folder."""
        if self._folder is None:
            raise OSError("there is no state directory")
        self._folder.mkdir(mode=0o750, parents=True, exist_ok=True)
        file = self._folder / f"{device}.{_time(utc_ns):%Y%m%dT%H%M%S.%fZ}.yaml"
        replace_file(file, text.encode())
        self._remove_old(self._folder, device)
        return file

    @staticmethod
    def _remove_old(folder: Path, device: str) -> None:
        mine = sorted(file for file in folder.glob(f"{device}.*.yaml") if file.name.count(".") == 3)
        for file in mine[:-BACKUPS_MAX]:
            with suppress(OSError):
                file.unlink()


class SettingsFiles:
    """Files about device settings in the state directory. With `state_dir` None, imud writes no files."""

    def __init__(self, state_dir: Path | None, host: HostClock) -> None:
        self.flash = FlashWrites(state_dir, host)
        self.backups = BackupFolder(state_dir)
        self.updates = PendingUpdates(state_dir, host)

    def close(self) -> None:
        self.flash.close()
        self.updates.close()


def _time(utc_ns: int) -> datetime:
    return datetime.fromtimestamp(utc_ns / NS_PER_S, UTC)
