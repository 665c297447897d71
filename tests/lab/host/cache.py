"""The cache of built kernels: one folder per hash of all inputs of the build.

Layout of `${XDG_CACHE_HOME:-~/.cache}/imud-lab` (or IMUD_LAB_CACHE):

    lock              held (flock) by the process that builds
    failed-build.log  log of the last failed build
    new-*             build in progress; the next build removes the leftover of a killed build
    <name>-<key>/     finished build; created by rename, so it is complete

A new build removes finished folders that were not used for MAX_AGE_S.
"""

import contextlib
import fcntl
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.lab.host.errors import LabError

MAX_AGE_S = 14 * 86400  # two weeks
LOCK_WAIT_S = 45 * 60  # a cold build takes 5 minutes on two idle cores; a busy host is slower
LOCK_POLL_S = 0.2  # interval of lock attempts


def cache_root(suffix: str = "") -> Path:
    """Return the cache folder. With a suffix, return a folder next to it with its own lock.

    Raises LabError if its path contains characters that make does not support.
    """
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    root = Path(f"{os.environ.get('IMUD_LAB_CACHE') or Path(base) / 'imud-lab'}{suffix}").absolute()
    if any(character.isspace() or character in ":#$," for character in str(root)):
        raise LabError(
            f"cannot use the cache folder {str(root)!r}: expected no spaces and :#$, in its path; set IMUD_LAB_CACHE"
        )
    return root


def key_of(*parts: bytes) -> str:
    """Return 16 hex digits of the SHA-256 of the parts and their lengths, so that different splits never match."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()[:16]


def require_space(folder: Path, needed_bytes: int) -> None:
    """Raise LabError if the file system of `folder` has less than `needed_bytes` free."""
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < needed_bytes:
        raise LabError(
            f"no space: {folder} has {free_bytes / 1e9:.1f} GB free, the build needs {needed_bytes / 1e9:.1f} GB"
            " (set IMUD_LAB_CACHE to another place)"
        )


@contextlib.contextmanager
def locked(root: Path, say: Callable[[str], None], wait_s: float = LOCK_WAIT_S) -> Iterator[None]:
    """Hold the build lock. Report once if another build holds it. Raises LabError after `wait_s`."""
    with open(root / "lock", "w", encoding="ascii") as file:
        give_up_s = time.monotonic() + wait_s
        told = False
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() >= give_up_s:
                    raise LabError(
                        f"cannot lock {root / 'lock'}: another build has held it for {wait_s:.0f} s"
                    ) from error
            if not told:
                say("waiting for another build")
                told = True
            time.sleep(LOCK_POLL_S)
        yield


def find(name: str, root: Path | None = None) -> Path | None:
    """Return the finished folder `name` of `root` (default cache_root()) and mark it as used; None if missing."""
    folder = (root or cache_root()) / name
    try:
        os.utime(folder)
    except FileNotFoundError:
        return None
    return folder


def get(
    name: str, make: Callable[[Path], None], needed_bytes: int, say: Callable[[str], None], root: Path | None = None
) -> Path:
    """Return the folder `name` of `root` (cache_root()). If it is absent, `make(folder)` fills a new folder, which is
    then renamed.

    Safe for any number of processes: one process makes the folder, the others wait and use the result. A failed or
    killed make leaves no folder `name`. The lock is not recursive: `make` must not call this function.
    """
    root = root or cache_root()
    try:
        root.mkdir(parents=True, exist_ok=True)
        found = find(name, root)
        if found is None:
            with locked(root, say):
                found = find(name, root) or _make_locked(root, name, make, needed_bytes)
    except OSError as error:
        raise LabError(f"cache folder {root}: {error}") from error
    return found


def _make_locked(root: Path, name: str, make: Callable[[Path], None], needed_bytes: int) -> Path:
    _remove_old(root)
    require_space(root, needed_bytes)
    fresh = Path(tempfile.mkdtemp(prefix="new-", dir=root))
    try:
        make(fresh)
        fresh.chmod(0o755)
        return fresh.rename(root / name)
    except LabError as error:
        raise LabError(f"{error}{_keep_log(root, fresh)}") from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _keep_log(root: Path, fresh: Path) -> str:
    """Save the log of a failed build. Return its place for the end of the error line."""
    log = fresh / "build.log"
    if not log.exists():
        return ""
    return f" (log: {log.rename(root / 'failed-build.log')})"


def _remove_old(root: Path) -> None:
    """Remove old folders and leftovers. With the lock, every `new-*` is a leftover, because no other build runs."""
    oldest_s = time.time() - MAX_AGE_S
    for folder in root.iterdir():
        if folder.is_dir() and (folder.name.startswith("new-") or folder.stat().st_mtime < oldest_s):
            shutil.rmtree(folder, ignore_errors=True)
