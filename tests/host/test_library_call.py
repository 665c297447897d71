"""Exceptions of libraries become LinkErrors with a reason."""

import asyncio
import errno

import can
import pytest

from imud.host.library_call import REASON_CHARACTERS, LibraryCall
from imud.model.errors import LinkError, LinkMissing


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENODEV, "x"), "No such device"),
        (ValueError("invalid literal"), "invalid literal"),
        (ImportError("Please install python-ics"), "Please install python-ics"),
        (NameError("name 'canOpen' is not defined"), "NameError: name 'canOpen' is not defined"),
        (can.CanOperationError("write failed", 5), "write failed [Error Code 5]"),
        (can.CanInitializationError("[Errno 2] could not open port"), "No such file or directory"),
        (SystemExit(1), "SystemExit: 1"),
        (asyncio.CancelledError(), "CancelledError"),
        (KeyboardInterrupt(), "KeyboardInterrupt"),
        (RuntimeError("two\nlines \x1b[0m"), r"RuntimeError: two\nlines \x1b[0m"),
        (RuntimeError("x" * 9999), "RuntimeError: " + "x" * (REASON_CHARACTERS - 15) + "…"),
    ],
)
def test_reason_of_library_error(error: BaseException, reason: str) -> None:
    with pytest.raises(LinkError) as raised, LibraryCall("open can0"):
        raise error
    assert str(raised.value) == f"cannot open can0: {reason}"
    assert raised.value.__cause__ is error


def test_expected_and_own_errors_pass() -> None:
    with pytest.raises(LinkMissing, match="gone"), LibraryCall("open can0"):
        raise LinkMissing("gone")
    with pytest.raises(KeyError), LibraryCall("open can0", KeyError):
        raise KeyError
