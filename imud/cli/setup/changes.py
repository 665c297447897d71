"""One change of this machine: announced before it is made, made, undone. Two kinds: a file's content, and a command.

A file is exchanged as a whole; its owner and mode stay. It is taken back only while it is as it was left: what a person
wrote since is never overwritten. A command names the commands that take it back, and one whose output shows its effect.
"""

import difflib
import fcntl
import os
import shlex
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import msgspec

from imud.cli.doctor.surroundings import Surroundings
from imud.host.files import read_regular, replace_file
from imud.model.errors import ImudError, reason_of

Words = tuple[str, ...]
"""A command."""

FILE_BYTES_MAX: Final = 1 << 20
"""Of a file that is changed; a configuration is no larger."""
NEW_MODE: Final = 0o644
FOLDER_MODE: Final = 0o755


class ChangeRefused(ImudError):
    """A change is not made, or not taken back, because something is not as expected. Example: a file edited since."""


class FileChange(msgspec.Struct, frozen=True, tag="file"):
    """A file gets this content."""

    why: str
    """What for, a clause for people."""
    path: str
    content: bytes
    then: tuple[Words, ...] = ()
    """Commands that make programs see it; run after it was made and after it was taken back. They may fail."""
    copy_of: str = ""
    """The file that this is a copy of, with its owner and mode; empty for others."""


class CommandChange(msgspec.Struct, frozen=True, tag="command"):
    """A command is run."""

    why: str
    words: Words
    undo: tuple[Words, ...]
    """What takes it back; nothing for a command that leaves nothing to take back."""
    look: Words
    """Its output is the same again when the command is taken back."""
    optional: bool = False
    """Whether it matters little that it fails, made or taken back."""


Change = FileChange | CommandChange


class ChangeRecord(msgspec.Struct):
    """A change that was begun."""

    change: Change
    content_before: bytes | None = None
    """Of a file; None where there was none."""
    seen_before: str = ""
    """Output of a command's `look`."""
    done: bool = False
    """False for one that was interrupted: it may or may not have been made."""


# --- announced --------------------------------------------------------------------------------------------------------


def describe(at: Surroundings, change: Change) -> list[str]:
    """What the change does, and the lines of a file that it adds and removes."""
    if isinstance(change, CommandChange):
        return [f"{change.why}: {shlex.join(change.words)}"]
    before = content_of(at, change.path)
    lines = [f"{change.path}{'' if before is not None else ' (new)'}: {change.why}", *_differences(before, change)]
    return lines + [f"  then: {shlex.join(words)}" for words in change.then]


def describe_undo(record: ChangeRecord) -> list[str]:
    """What taking it back does."""
    change = record.change
    if isinstance(change, FileChange):
        what = "is removed" if record.content_before is None else "gets its former content"
        return [f"{change.path} {what} ({change.why})"]
    return [shlex.join(words) for words in change.undo] or [f"nothing to do ({shlex.join(change.words)})"]


def _differences(before: bytes | None, change: FileChange) -> list[str]:
    if change.copy_of:
        return []
    old, new = ((text or b"").decode("utf-8", "replace").splitlines() for text in (before, change.content))
    compared = list(difflib.unified_diff(old, new, n=0, lineterm=""))[2:]
    return [f"  {line}" for line in compared if not line.startswith("@@")]


# --- made and taken back ----------------------------------------------------------------------------------------------


def begun(at: Surroundings, change: Change) -> ChangeRecord:
    """Look at what is there before the change. Raises ChangeRefused, OSError."""
    if isinstance(change, FileChange):
        return ChangeRecord(change, content_before=content_of(at, change.path))
    return ChangeRecord(change, seen_before=_output(at, change.look))


def make(at: Surroundings, record: ChangeRecord) -> list[str]:
    """Make the change; return what did not work and does not matter. Raises ChangeRefused, OSError."""
    change = record.change
    if isinstance(change, FileChange):
        if content_of(at, change.path) != record.content_before:
            raise ChangeRefused(f"{change.path} has just been changed by another program: run `imud setup` again")
        write(at, change.path, change.content, change.copy_of or change.path)
        return run_all(at, change.then)
    failed = run_all(at, (change.words,))
    if failed and not change.optional:
        raise ChangeRefused(failed[0])
    return failed


def take_back(at: Surroundings, record: ChangeRecord) -> list[str]:
    """Restore what was there before; return what did not work and does not matter.

    No-op for what is as it was before. Raises ChangeRefused where it was changed since, or a command fails.
    """
    change = record.change
    if isinstance(change, CommandChange):
        if _output(at, change.look) == record.seen_before:
            return []
        failed = run_all(at, change.undo)
        if failed and not change.optional:
            raise ChangeRefused(failed[0])
        return failed
    now = content_of(at, change.path)
    if now == record.content_before:
        return []
    if now != change.content:
        gone = " removed" if now is None else " changed"
        raise ChangeRefused(f"{change.path} was{gone} since `imud setup` wrote it: it is left as it is")
    if record.content_before is None:
        at.at(change.path).unlink()
    else:
        write(at, change.path, record.content_before, change.path)
    return run_all(at, change.then)


def run_all(at: Surroundings, commands: Sequence[Words]) -> list[str]:
    """Run commands in order; return a sentence for each that failed."""
    failed = []
    for words in commands:
        try:
            output = at.run(words)
        except OSError as error:
            failed.append(f"`{shlex.join(words)}` could not be run: {reason_of(error)}")
            continue
        if output.status:
            failed.append(f"`{shlex.join(words)}` failed: {output.complaint or f'exit status {output.status}'}")
    return failed


def _output(at: Surroundings, words: Words) -> str:
    """What a command says; empty for one that is not installed."""
    try:
        return at.run(words).text.strip()
    except OSError:
        return ""


# --- files ------------------------------------------------------------------------------------------------------------


def content_of(at: Surroundings, path: str) -> bytes | None:
    """The content of a regular file; None where there is none. Raises ChangeRefused for links and others, OSError."""
    file = at.at(path)
    try:
        mode = file.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    if stat.S_ISLNK(mode):
        raise ChangeRefused(f"{path} is a symbolic link to {os.readlink(file)}: imud setup does not change it")
    content = read_regular(file, FILE_BYTES_MAX + 1)
    if len(content) > FILE_BYTES_MAX:
        raise ChangeRefused(f"{path}: expected at most {FILE_BYTES_MAX} bytes, got more: imud setup does not change it")
    return content


def write(at: Surroundings, path: str, content: bytes, like: str) -> None:
    """Exchange a file as a whole, with owner and mode of the file `like`; it is on the medium when this returns.

    Raises OSError; the old file is left then.
    """
    file = at.at(path)
    file.parent.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
    try:
        now = at.at(like).stat()
        replace_file(file, content, mode=stat.S_IMODE(now.st_mode), owner=(now.st_uid, now.st_gid))
    except FileNotFoundError:
        replace_file(file, content, mode=NEW_MODE, owner=(os.geteuid(), os.getegid()))
    sync_folder(file.parent)


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the medium; no-op where its file system cannot."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


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
