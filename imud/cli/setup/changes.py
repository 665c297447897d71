"""Changes of the host, and the journal that allows to undo them. A change is a new file content or a command.

imud replaces a file as a whole and keeps its owner and mode. It restores a file only if no other program changed the
file after `imud setup`. A command change names the commands that undo it, and a command that shows its effect.
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

Words = tuple[str, ...]  # words of a command line

FILE_BYTES_MAX: Final = 1 << 20  # maximum size of a changed file, bytes: the maximum size of a configuration
NEW_MODE: Final = 0o644
FOLDER_MODE: Final = 0o755


class ChangeRefused(ImudError):
    """Error of a change or an undo. Example: another program changed the file."""


class FileChange(msgspec.Struct, frozen=True, tag="file"):
    """New content of a file."""

    why: str  # purpose of the change, for the user
    path: str
    content: bytes
    # Commands after the change and after its undo, so that programs use the file. They can fail.
    then: tuple[Words, ...] = ()
    copy_of: str = ""  # original of a copy, which gets the same owner and mode; empty for other files


class CommandChange(msgspec.Struct, frozen=True, tag="command"):
    """Execution of a command."""

    why: str
    words: Words
    undo: tuple[Words, ...]  # commands that undo the change; empty if nothing needs an undo
    look: Words  # command with the same output before the change and after the undo
    optional: bool = False  # whether `imud setup` continues if the change or its undo fails


Change = FileChange | CommandChange


class ChangeRecord(msgspec.Struct):
    """Started change, as stored in the journal."""

    change: Change
    content_before: bytes | None = None  # previous content of a file; None if the file did not exist
    seen_before: str = ""  # previous output of the command `look`
    done: bool = False  # false after an interruption: the change is perhaps incomplete


# --- description ------------------------------------------------------------------------------------------------------


def describe(at: Surroundings, change: Change) -> list[str]:
    """Describe a change: its purpose, and the added and removed lines of a file."""
    if isinstance(change, CommandChange):
        return [f"{change.why}: {shlex.join(change.words)}"]
    before = content_of(at, change.path)
    lines = [f"{change.path}{'' if before is not None else ' (new)'}: {change.why}", *_differences(before, change)]
    return lines + [f"  then: {shlex.join(words)}" for words in change.then]


def describe_undo(record: ChangeRecord) -> list[str]:
    """Describe the undo of a change."""
    change = record.change
    if isinstance(change, FileChange):
        verb = "remove" if record.content_before is None else "restore"
        return [f"{verb} {change.path} ({change.why})"]
    return [shlex.join(words) for words in change.undo] or [f"no undo needed ({shlex.join(change.words)})"]


def _differences(before: bytes | None, change: FileChange) -> list[str]:
    if change.copy_of:
        return []
    old, new = ((text or b"").decode("utf-8", "replace").splitlines() for text in (before, change.content))
    # without the two header lines with file names
    compared = list(difflib.unified_diff(old, new, n=0, lineterm=""))[2:]
    return [f"  {line}" for line in compared if not line.startswith("@@")]


# --- change and undo --------------------------------------------------------------------------------------------------


def begun(at: Surroundings, change: Change) -> ChangeRecord:
    """Return a record with the state before the change. Raises ChangeRefused, OSError."""
    if isinstance(change, FileChange):
        return ChangeRecord(change, content_before=content_of(at, change.path))
    return ChangeRecord(change, seen_before=_output(at, change.look))


def make(at: Surroundings, record: ChangeRecord) -> list[str]:
    """Make the change. Return the errors of optional commands. Raises ChangeRefused, OSError."""
    change = record.change
    if isinstance(change, FileChange):
        if content_of(at, change.path) != record.content_before:
            raise ChangeRefused(f"another program changed {change.path} in the meantime; run `imud setup` again")
        write(at, change.path, change.content, change.copy_of or change.path)
        return run_all(at, change.then)
    failed = run_all(at, (change.words,))
    if failed and not change.optional:
        raise ChangeRefused(failed[0])
    return failed


def take_back(at: Surroundings, record: ChangeRecord) -> list[str]:
    """Restore the state before the change. Return the errors of optional commands.

    Do nothing if the state is already restored. Raises ChangeRefused if another program changed the file, or if a
    command fails.
    """
    change = record.change
    if isinstance(change, CommandChange):
        # already undone, for example by the user
        if _output(at, change.look) == record.seen_before:
            return []
        failed = run_all(at, change.undo)
        if failed and not change.optional:
            raise ChangeRefused(failed[0])
        return failed
    now = content_of(at, change.path)
    if now == record.content_before:
        return []
    # the user changed the file: never overwrite this change
    if now != change.content:
        verb = "removed" if now is None else "changed"
        raise ChangeRefused(f"{change.path} was {verb} after `imud setup` wrote it, so imud does not change it")
    if record.content_before is None:
        at.at(change.path).unlink()
    else:
        write(at, change.path, record.content_before, change.path)
    return run_all(at, change.then)


def run_all(at: Surroundings, commands: Sequence[Words]) -> list[str]:
    """Run commands in order. Return an error for each failed command."""
    failed = []
    for words in commands:
        try:
            output = at.run(words)
        except OSError as error:
            failed.append(f"cannot run `{shlex.join(words)}`: {reason_of(error)}")
            continue
        if output.status:
            failed.append(f"`{shlex.join(words)}` failed: {output.complaint or f'exit status {output.status}'}")
    return failed


def _output(at: Surroundings, words: Words) -> str:
    """Return the output of a command; empty if the command is not installed."""
    try:
        return at.run(words).text.strip()
    except OSError:
        return ""


# --- files ------------------------------------------------------------------------------------------------------------


def content_of(at: Surroundings, path: str) -> bytes | None:
    """Return the content of a regular file; None if it does not exist. Raises ChangeRefused for links, OSError."""
    file = at.at(path)
    try:
        mode = file.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    if stat.S_ISLNK(mode):
        raise ChangeRefused(f"cannot change {path}: it is a symbolic link to {os.readlink(file)}")
    content = read_regular(file, FILE_BYTES_MAX + 1)
    if len(content) > FILE_BYTES_MAX:
        raise ChangeRefused(f"cannot change {path}: expected at most {FILE_BYTES_MAX} bytes, got more")
    return content


def write(at: Surroundings, path: str, content: bytes, like: str) -> None:
    """Replace a file as a whole, with the owner and mode of the file `like`, and synchronise it.

    Raises OSError; the previous file then stays.
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
    """Synchronise the names in a folder."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with suppress(OSError):  # some file systems do not support fsync of a folder
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


FOLDER: Final = "/var/lib/imud-setup"
FILE: Final = f"{FOLDER}/journal.json"
JOURNAL_FOLDER_MODE: Final = 0o700
JOURNAL_BYTES_MAX: Final = 16 << 20  # maximum size of the journal, bytes: some hundred versions of a configuration


class Journal:
    """Journal of the changes, oldest first. Only one process uses it at a time."""

    def __init__(self, at: Surroundings, say: Callable[[str], None]) -> None:
        """Read the journal. `say` prints notes. Raises ImudError if the journal is invalid."""
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
            reason = reason_of(error) if isinstance(error, OSError) else "the content is invalid"
            raise ImudError(f"cannot read the journal {self._file}: {reason}") from error

    def carry_out(self, changes: Sequence[Change]) -> list[str]:
        """Make all changes in order. Return the errors of optional commands.

        Raises ChangeRefused or OSError at the first failed change. The journal contains the changes before it.
        """
        notes: list[str] = []
        for change in changes:
            record = begun(self._at, change)
            # store the record first: an interrupted change can then be undone
            self.records.append(record)
            self._save()
            notes += make(self._at, record)
            record.done = True
            self._save()
        return notes

    def take_back(self) -> list[str]:
        """Undo all changes, newest first. Return the reasons of failed undos. Their changes stay in the journal.

        If imud cannot restore a file, the backup of the file stays too. Raises OSError if writing a file fails.
        """
        refused: list[str] = []
        left: set[str] = set()
        for place in range(len(self.records) - 1, -1, -1):
            change = self.records[place].change
            path, original = (change.path, change.copy_of) if isinstance(change, FileChange) else ("", "")
            if original in left:
                refused.append(f"imud keeps {path}, the backup of {original}")
                continue
            try:
                notes = take_back(self._at, self.records[place])
            except ChangeRefused as reason:
                refused.append(str(reason))
                # keep the backup of a file that stays
                left.add(path)
                continue
            for note in notes:
                self._say(f"  {note}")
            # store each undo, so that an interrupted undo can continue
            del self.records[place]
            self._save()
        return list(dict.fromkeys(refused))

    def _save(self) -> None:
        """Write and synchronise the journal, or remove an empty journal. Raises OSError."""
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
    """Hold the lock during the context. Raises ImudError if another `imud setup` runs, OSError."""
    path = at.at("/run/imud-setup.lock")
    path.parent.mkdir(exist_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(path, flags, 0o600)
    try:
        try:
            # the kernel releases the lock if the process ends
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ImudError("another `imud setup` is running; wait until it ends") from None
        yield
    finally:
        os.close(descriptor)
