"""Backends of python-can: which of them imud can configure, and which of them need a library that this host lacks."""

from ctypes.util import find_library
from importlib.util import find_spec
from typing import Final

from imud.model.options import unknown_name

# Backends with keys that imud does not have. `socketcand` needs host and port.
NOT_CONFIGURABLE: Final = frozenset(("socketcand",))
# Backends that python-can supports on Windows only
WINDOWS_ONLY: Final = frozenset(("etas", "ixxat", "nican", "nixnet", "systec", "usb2can", "vector"))
# Library of the vendor that a backend loads, without `lib` and `.so`
LIBRARIES: Final = {"kvaser": "canlib", "neousys": "wdt_dio", "pcan": "pcanbasic"}
# Python module that a backend imports
MODULES: Final = {
    "canalystii": "canalystii",
    "cantact": "cantact",
    "gs_usb": "gs_usb",
    "neovi": "ics",
    "udp_multicast": "msgpack",
}


def backends() -> list[str]:
    """Return the names of the backends that imud can configure, also of other packages."""
    from can.interfaces import BACKENDS  # late, because SocketCAN does not need python-can

    return sorted(set(BACKENDS) - NOT_CONFIGURABLE)


def check_backend(backend: str) -> None:
    """Raise ValueError for a backend that imud cannot configure."""
    names = backends()
    if backend in NOT_CONFIGURABLE:
        reason = f"imud has no keys for host and port of {backend}"
        raise ValueError(f"backend: expected a backend of python-can ({', '.join(names)}), got {backend}; {reason}")
    if backend not in names:
        raise ValueError(f"backend: {unknown_name('a backend of python-can', backend, names)}")


def backend_problem(backend: str) -> tuple[str, bool] | None:
    """Return why a backend does not fit this host, and whether it can never work; None if no reason is known."""
    if backend in WINDOWS_ONLY:
        return (
            f"expected a backend that works on Linux, got {backend}, which needs Windows; try slcan or socketcan",
            True,
        )
    library = LIBRARIES.get(backend)
    if library is not None and find_library(library) is None:
        message = f"expected the library lib{library} of the vendor for {backend}, got none; install it"
        return f"{message} before imud starts", False
    module = MODULES.get(backend)
    if module is not None and find_spec(module) is None:
        return f"expected the Python module {module} for {backend}, got none; install it before imud starts", False
    return None
