"""Store of the writes to the flash of each module, which are counted over all runs of imud and limited per day.

Flash of the controllers in such modules endures some ten thousand erasures. A device that forgets its settings, or
a configuration that contradicts it, must not use them up: imud by itself writes a module LIMIT_ITSELF times within 24
hours, which is a life of some seven years even so; people and programs may write it LIMIT_ASKED times.
"""

from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec

from imud.config.yaml import yaml_block, yaml_comment
from imud.host.clock import HostClock
from imud.host.files import StateFile, replace_file
from imud.model.units import NS_PER_S

FILE_NAME: Final = "settings.json"
DAY_S: Final = 24 * 3600
LIMIT_ITSELF: Final = 4
"""Writes within 24 hours after which imud writes no more by itself; those that were asked for count."""
LIMIT_ASKED: Final = 40
"""Writes within 24 hours after which imud writes no more even when it is asked to."""
MODULES_MAX: Final = 1024
"""Modules that are remembered, those written last; a daemon has 256 devices at most."""


class ModuleRecord(msgspec.Struct):
    """What is known of one module."""

    writes: int = 0
    """Writes to its flash by imud."""
    times_s: list[int] = []  # msgspec copies a mutable default
    """Seconds of UTC of the newest, oldest first, LIMIT_ASKED at most."""
    unreadable: dict[str, Any] = msgspec.field(name="told", default_factory=dict)
    """Values saved in its flash of settings that cannot be read back, as JSON."""


class FlashWrites:
    """Writes to the flash of all modules. Synchronization: the event loop's thread only."""

    def __init__(self, folder: Path | None, host: HostClock) -> None:
        """With `folder` None, imud keeps the counts in memory only."""
        self._file = StateFile(
            folder / FILE_NAME if folder else None, "settings", "writes to flash are counted from the beginning"
        )
        self._modules = self._file.read(dict[str, ModuleRecord])
        self._host = host

    def writes(self, module: str) -> int:
        """Writes to the flash of a module in all runs."""
        return self._record(module).writes

    def writes_day(self, module: str) -> int:
        """Writes within the last 24 hours. Those that a wrong clock dated later than now count as of now."""
        now_s, record = self._host.utc_ns() // NS_PER_S, self._record(module)
        record.times_s = [min(time_s, now_s) for time_s in record.times_s]
        return sum(time_s > now_s - DAY_S for time_s in record.times_s)

    def refusal(self, module: str, *, asked: bool) -> str:
        """Return why the flash of a module may not be written now, one sentence; empty if it may."""
        limit, written = LIMIT_ASKED if asked else LIMIT_ITSELF, self.writes_day(module)
        if written < limit:
            return ""
        who = "" if asked else " by imud itself"
        return f"its flash was written {written} times within 24 hours, and {limit} are allowed{who}: it wears out"

    def count(self, module: str) -> None:
        """Count a write that is about to be made."""
        record = self._modules.pop(module, None) or ModuleRecord()
        record.writes += 1
        record.times_s = [*record.times_s, self._host.utc_ns() // NS_PER_S][-LIMIT_ASKED:]
        self._keep(module, record)

    def unreadable(self, module: str) -> Mapping[str, Any]:
        """Values saved in the flash of a module of settings that cannot be read back, as JSON."""
        return self._record(module).unreadable

    def keep_unreadable(self, module: str, values: Mapping[str, Any]) -> None:
        """Remember such values: they are in the module's flash now."""
        if self.unreadable(module) != values:
            record = self._modules.pop(module, None) or ModuleRecord()
            record.unreadable = dict(values)
            self._keep(module, record)

    def close(self) -> None:
        """Wait until the file is written, for a limited time; may be called twice."""
        self._file.close()

    def _record(self, module: str) -> ModuleRecord:
        return self._modules.get(module) or ModuleRecord()

    def _keep(self, module: str, record: ModuleRecord) -> None:
        """Keep a record as the newest, and no more than MODULES_MAX."""
        self._modules[module] = record
        while len(self._modules) > MODULES_MAX:
            del self._modules[next(iter(self._modules))]
        self._file.write(self._modules)


class ModuleFlash:
    """The flash of one module, as asked for by people (`asked`) or by imud itself: a `FlashBudget`."""

    def __init__(self, writes: FlashWrites, module: str, *, asked: bool) -> None:
        self._writes = writes
        self._module = module
        self._asked = asked

    def refusal(self) -> str:
        """Return why it may not be written now, one sentence; empty if it may."""
        return self._writes.refusal(self._module, asked=self._asked)

    def count(self) -> None:
        """Count a write that is about to be made."""
        self._writes.count(self._module)


FOLDER: Final = "backups"
BACKUPS_MAX: Final = 10


def backup_text(device: str, driver: str, identity: Mapping[str, str], settings: Mapping[str, Any], utc_ns: int) -> str:
    """Format a backup; `settings` has JSON values of all settings that can be set again."""
    time = _time(utc_ns).isoformat(timespec="seconds").replace("+00:00", "Z")
    content = {"device": device, "driver": driver, "time": time, "identity": identity, "settings": settings}
    head = f"Settings of {device} as the device reported them. `imud settings {device} --restore FILE` sets them again."
    return f"{yaml_comment(head)}\n{yaml_block(content)}\n"


class BackupFolder:
    """Backups that imud makes by itself. Its methods wait for the disk: not to be called in the event loop's thread."""

    def __init__(self, state_dir: Path | None) -> None:
        """None keeps no backups."""
        self._folder = state_dir / FOLDER if state_dir else None

    def write(self, device: str, text: str, utc_ns: int) -> Path | None:
        """Write a backup and remove old ones of the device; return its path, None without a folder. Raises OSError."""
        if self._folder is None:
            return None
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
    """What imud keeps about settings of devices beyond a run, in the state directory; None keeps nothing."""

    def __init__(self, state_dir: Path | None, host: HostClock) -> None:
        self.flash = FlashWrites(state_dir, host)
        self.backups = BackupFolder(state_dir)

    def close(self) -> None:
        """Wait until all is written, for a limited time; may be called twice."""
        self.flash.close()


def _time(utc_ns: int) -> datetime:
    return datetime.fromtimestamp(utc_ns / NS_PER_S, UTC)
