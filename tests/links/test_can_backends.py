"""Backends of python-can: names, missing libraries, and the message of a failed open."""

import can
import pytest

from imud.links import can_backends
from imud.links.can_backends import LIBRARIES, MODULES, NOT_CONFIGURABLE, WINDOWS_ONLY, backend_problem, check_backend
from imud.links.python_can import PythonCanLink
from imud.model.errors import LinkError


def test_tables_have_backends_of_python_can_only() -> None:
    """`gs_usb` and the others keep their names in a new version of python-can."""
    assert {*LIBRARIES, *MODULES, *WINDOWS_ONLY, *NOT_CONFIGURABLE} <= set(can.interfaces.BACKENDS)


def test_unknown_backends_are_refused() -> None:
    for backend in set(can.interfaces.BACKENDS) - NOT_CONFIGURABLE:
        check_backend(backend)
    with pytest.raises(ValueError, match=r"^backend: expected .* got socketcand; imud has no keys for host and port"):
        check_backend("socketcand")
    with pytest.raises(ValueError, match="did you mean kvaser"):
        check_backend("kvasr")


def test_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can_backends, "find_library", lambda _name: None)
    assert backend_problem("slcan") is None
    problem = backend_problem("kvaser")
    assert problem is not None
    assert not problem[1]
    assert backend_problem("vector") == (
        "expected a backend that works on Linux, got vector, which needs Windows; try slcan or socketcan",
        True,
    )
    monkeypatch.setattr(can, "Bus", lambda *_arguments, **_keys: canGetNumberOfChannels())  # type: ignore[name-defined]  # noqa: F821 - as python-can without the library
    with pytest.raises(LinkError, match=r"^cannot open 0 \(kvaser\): NameError: .*; expected the library libcanlib"):
        PythonCanLink("kvaser", "0").open()
