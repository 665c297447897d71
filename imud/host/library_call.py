"""Calls of libraries: an exception of any class becomes a LinkError.

A library can raise every class of exception: errors of the system, its own errors, NameError in place of a missing
driver, SystemExit. An exception that leaves a link ends the device or the daemon.
"""

from types import TracebackType
from typing import Final

from imud.host.log import printable
from imud.model.errors import ImudError, LinkError, reason_of

REASON_CHARACTERS: Final = 200  # maximum length of the text of a library in a message


# Exceptions of Python with a text for users. The text of other exceptions of Python needs the name of the class.
READABLE: Final = (OSError, ValueError, ImportError)


def library_reason(error: BaseException) -> str:
    """Return the reason of an exception of a library, one line."""
    if isinstance(error, OSError):
        return printable(reason_of(error), REASON_CHARACTERS)
    text = str(error) and reason_of(Exception(str(error)))  # the arguments of other errors are not system errors
    if not text or (type(error).__module__ == "builtins" and not isinstance(error, READABLE)):
        text = ": ".join(filter(None, (type(error).__name__, text)))
    return printable(text, REASON_CHARACTERS)


class LibraryCall:
    """Context of one or several calls of a library, without `await`. Synchronization: none required."""

    __slots__ = ("_expected", "_operation")

    def __init__(self, operation: str, *expected: type[Exception]) -> None:
        """`operation` follows "cannot" in the error. The caller processes the `expected` exceptions itself."""
        self._operation = operation
        self._expected = expected

    def __enter__(self) -> None:
        return None

    def __exit__(
        self, _kind: type[BaseException] | None, error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        """Raise LinkError in place of an unexpected exception."""
        if error is None or isinstance(error, (ImudError, *self._expected)):
            return
        raise LinkError(f"cannot {self._operation}: {library_reason(error)}") from error
