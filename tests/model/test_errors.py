"""Messages contain system and library errors as readable text, and no code formats such an error directly."""

import ast
import socket
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from imud.model.errors import reason_of

ROOT = Path(__file__).parents[2]
FOREIGN = {
    "OSError", "PermissionError", "FileNotFoundError", "ConnectionError", "error", "ValidationError", "DecodeError",
    "UnicodeDecodeError", "UnicodeError", "SerialException", "CanError", "TypeError",
}  # fmt: skip
"""Errors with text for programmers: `[Errno 2] No such file …`, `(25, 'Inappropriate …')`, "Expected `int`"."""
ALLOWED = {
    ("imud/formats/jsonrpc.py", "parse_object"): "what is wrong with JSON, and at which byte, in plain words",
    ("imud/model/options.py", "value_problem"): "takes the place out of it, nothing else",
    ("imud/model/options.py", "disagreements"): "what `__post_init__` of imud's own settings says",
}


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (FileNotFoundError(2, "No such file or directory", "/var/lib/imud/found.new"), "No such file or directory"),
        (termios.error(25, "Inappropriate ioctl for device"), "Inappropriate ioctl for device"),
        (serial.SerialException("Could not configure port: (5, 'Input/output error')"), "Input/output error"),
        (serial.SerialException(13, "could not open port /dev/x: [Errno 13] Permission denied"), "Permission denied"),
        (OSError("Multiple exceptions: [Errno 111] Connect call failed ('::1', 1), [Errno 1] x"), "Connection refused"),
        (ConnectionRefusedError(111, "Connect call failed ('127.0.0.1', 2947)"), "Connection refused"),
        (socket.gaierror(-2, "Name or service not known"), "Name or service not known"),
        (OSError(0, "no number of the system"), "no number of the system"),
        (ValueError("Not a valid baudrate: 7"), "Not a valid baudrate: 7"),
        (OSError(), "Base class for I/O related errors."),
    ],
)
def test_reason_of(error: Exception, words: str) -> None:
    assert reason_of(error) == words


def foreign_texts() -> Iterator[tuple[str, str, int]]:
    """Yield file, function and line of each place that formats a foreign error directly."""
    for path in sorted((ROOT / "imud").rglob("*.py")):
        text = path.read_text()
        nodes = list(ast.walk(ast.parse(text))) if "except" in text else []
        functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
        for handler in (node for node in nodes if isinstance(node, ast.ExceptHandler)):
            for line in _texts_of(handler):
                inner = max((one for one in functions if one.lineno < line <= (one.end_lineno or 0)), key=_line_of)
                yield path.relative_to(ROOT).as_posix(), inner.name, line


def _line_of(node: ast.stmt) -> int:
    return node.lineno


def _texts_of(handler: ast.ExceptHandler) -> Iterator[int]:
    """Yield the lines of an error handler that format the error, pass it to str() or log it."""
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    names = {kind.attr if isinstance(kind, ast.Attribute) else getattr(kind, "id", "") for kind in kinds}
    if not names & FOREIGN or handler.name is None:
        return
    for node in ast.walk(handler):
        if isinstance(node, ast.FormattedValue):
            shown: list[ast.expr] = [node.value]
        elif isinstance(node, ast.Call):
            called = node.func.id if isinstance(node.func, ast.Name) else ""
            owner = node.func.value if isinstance(node.func, ast.Attribute) else None
            shown = node.args if called == "str" or (isinstance(owner, ast.Name) and owner.id == "log") else []
        else:
            continue
        if any(isinstance(one, ast.Name) and one.id == handler.name for one in shown):
            yield node.lineno


def test_no_foreign_text_reaches_a_message() -> None:
    found = [(path, function, line) for path, function, line in foreign_texts() if (path, function) not in ALLOWED]
    assert not found, f"use reason_of or wrong_values: {found}"
