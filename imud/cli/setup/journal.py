"""What `imud setup` has changed, on disk before each change, so that all of it can be taken back.

The journal has its own folder, which only root may write: `imud setup --undo` writes what it says, as root, and the
state directory of the daemon belongs to the daemon's user. A change that was interrupted, by a signal or by a power
failure, stands there as begun; taking it back looks whether it was made.
"""

import fcntl
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

import msgspec

from imud.cli.doctor.surroundings import Surroundings
from imud.cli.setup.changes import (
    Change,
    ChangeRecord,
    ChangeRefused,
    FileChange,
    begun,
    make,
    sync_folder,
    take_back,
)
from imud.errors import ImudError, reason_of
from imud.files import read_regular, replace_file

FOLDER: Final = "/var/lib/imud-setup"
FILE: Final = f"{FOLDER}/journal.json"
JOURNAL_FOLDER_MODE: Final = 0o700
JOURNAL_BYTES_MAX: Final = 16 << 20
"""Some hundred versions of a configuration."""


class Journal:
    """The changes that were made, oldest first. One process at a time has it."""

    def __init__(self, at: Surroundings, say: Callable[[str], None]) -> None:
        """Read it. `say` gets a line for everything that is done. Raises ImudError for one that cannot be used."""
        self._at = at
        self._say = say
        self._file = at.at(FILE)
        self.records = self._read()

    def _read(self) -> list[ChangeRecord]:
        try:
            return msgspec.json.decode(read_regular(self._file, JOURNAL_BYTES_MAX), type=list[ChangeRecord])
        except FileNotFoundError:
            return []
        except (OSError, msgspec.DecodeError, UnicodeError) as error:
            reason = reason_of(error) if isinstance(error, OSError) else "it is not what imud wrote"
            raise ImudError(f"{self._file} cannot be used: {reason}") from error

    def carry_out(self, changes: Sequence[Change]) -> list[str]:
        """Make all changes in order; return what did not work and does not matter.

        Raises ChangeRefused and OSError at the first that cannot be made; those before it are made, and recorded.
        """
        notes: list[str] = []
        for change in changes:
            record = begun(self._at, change)
            self.records.append(record)
            self._save()
            notes += make(self._at, record)
            record.done = True
            self._save()
        return notes

    def take_back(self) -> list[str]:
        """Take all changes back, newest first; return why some of them were not. These stay in the journal.

        The copy of a file stays as long as the file does: it has what the file was before.
        Raises OSError where a file cannot be written.
        """
        refused: list[str] = []
        left: set[str] = set()
        for place in range(len(self.records) - 1, -1, -1):
            change = self.records[place].change
            path, original = (change.path, change.copy_of) if isinstance(change, FileChange) else ("", "")
            if original in left:
                refused.append(f"{path} stays, since it has the former content of {original}")
                continue
            try:
                notes = take_back(self._at, self.records[place])
            except ChangeRefused as reason:
                refused.append(str(reason))
                left.add(path)
                continue
            for note in notes:
                self._say(f"  {note}")
            del self.records[place]
            self._save()
        return list(dict.fromkeys(refused))

    def _save(self) -> None:
        """Have it on the medium; an empty one is removed. Raises OSError."""
        folder = self._file.parent
        if self.records:
            folder.mkdir(mode=JOURNAL_FOLDER_MODE, parents=True, exist_ok=True)
            replace_file(self._file, msgspec.json.encode(self.records), mode=0o600)
            sync_folder(folder)
        else:
            self._file.unlink(missing_ok=True)
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def locked(at: Surroundings) -> Iterator[None]:
    """Hold the lock against a second `imud setup`. Raises ImudError where one runs, OSError."""
    path = at.at("/run/imud-setup.lock")
    path.parent.mkdir(exist_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(path, flags, 0o600)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ImudError("another `imud setup` is running: wait until it has ended") from None
        yield
    finally:
        os.close(descriptor)
