"""Where an export is written: a file that is there whole or not at all, or standard output."""

import os
import stat
import sys
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self

from imud.errors import BadArgument, ImudError, reason_of
from imud.files import WRITE_FLAGS

MODE: Final = 0o666
"""Of a new file, from which the umask takes its bits."""


class ExportFile:
    """The output of one export. As a context: what is written until an error is removed, unless it went to a pipe.

    A file grows under another name in the same folder, and gets its own when it is whole: a program that waits for it
    never sees half of it, and a killed export leaves nothing that could be taken for one.
    """

    def __init__(self, path: Path | None, *, source: Path, force: bool, binary: bool) -> None:
        """None is standard output. Raises BadArgument where the file must not be written, or a terminal gets bytes."""
        self.written_bytes = 0
        self.name = "standard output" if path is None else str(path)
        """For people."""
        self._path: Path | None = None
        """The file to be; None where it is written in place."""
        self._part: Path | None = None
        self._file = self._open(path, source, force, binary)

    def write(self, data: bytes) -> None:
        """Append bytes. Raises ImudError where the disk is full or fails, BrokenPipeError where nobody reads."""
        try:
            self._file.write(data)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise self._failure(error) from error
        self.written_bytes += len(data)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            try:
                self._finish()
            except BrokenPipeError:
                raise
            except OSError as problem:
                self._discard()
                raise self._failure(problem) from problem
        else:
            self._discard()

    def _open(self, path: Path | None, source: Path, force: bool, binary: bool) -> BinaryIO:
        if path is None:
            if binary and sys.stdout.isatty():
                raise BadArgument("-o: expected a file, or a pipe on standard output; MCAP is not for terminals")
            return sys.stdout.buffer
        try:
            there = path.stat()
        except FileNotFoundError:
            there = None
        except OSError as error:
            raise self._failure(error) from error
        if there is not None and stat.S_ISREG(there.st_mode):
            if path.samefile(source):
                raise BadArgument(f"-o {path}: expected another file than the one that is exported")
            if not force:
                raise BadArgument(f"-o {path}: expected no file of this name, there is one; --force replaces it")
        try:
            if there is not None and not stat.S_ISREG(there.st_mode):
                return path.open("wb", buffering=0)  # a FIFO or a device
            self._path = path
            self._part = path.with_name(f".{path.name}.{os.getpid()}.part")
            return open(os.open(self._part, WRITE_FLAGS, MODE), "wb", buffering=0)
        except OSError as error:
            raise self._failure(error) from error

    def _finish(self) -> None:
        self._file.flush()
        if self._path is None:
            if self._file is not sys.stdout.buffer:
                self._file.close()
            return
        assert self._part is not None
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self._part, self._path)

    def _discard(self) -> None:
        if self._file is not sys.stdout.buffer:
            with suppress(OSError):
                self._file.close()
        if self._part is not None:
            with suppress(OSError):
                self._part.unlink()

    def _failure(self, error: OSError) -> ImudError:
        return ImudError(f"{self.name}: {reason_of(error)}; nothing is left of this export")
