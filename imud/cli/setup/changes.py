"""One change of this machine: announced before it is made, made, undone. Two kinds: a file's content, and a command.

A file is exchanged as a whole; its owner and mode stay. It is taken back only while it is as it was left: what a person
wrote since is never overwritten. A command names the commands that take it back, and one whose output shows its effect.
"""

import difflib
import os
import shlex
import stat
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from imud.cli.doctor.surroundings import Surroundings
from imud.errors import ImudError, reason_of
from imud.files import read_regular, replace_file

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
