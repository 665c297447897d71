"""Backups of a device's settings: YAML with the identity of the module, which `imud settings --restore` sets again.

imud writes one by itself, into the state directory, before an action that loses all settings. Of each device the newest
BACKUPS_MAX are kept.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from imud.files import replace_file
from imud.formats.yaml_text import yaml_block, yaml_comment
from imud.runtime.settings.flash import FlashWrites
from imud.units import NS_PER_S

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

    def __init__(self, state_dir: Path | None, utc_ns: Callable[[], int]) -> None:
        """`utc_ns` reads CLOCK_REALTIME."""
        self.utc_ns = utc_ns
        self.flash = FlashWrites(state_dir, utc_ns)
        self.backups = BackupFolder(state_dir)

    def close(self) -> None:
        """Wait until all is written, for a limited time; may be called twice."""
        self.flash.close()


def _time(utc_ns: int) -> datetime:
    return datetime.fromtimestamp(utc_ns / NS_PER_S, UTC)
