"""Values of a configuration that do not fit the host: a text file as a certificate, /dev/null as a GPIO chip.

The type of an option states the kind of its value (`imud.model.host_object`). This module finds all such values of a
configuration and looks at the named objects. It opens regular files only, and no device: opening a serial port changes
its modem lines, and opening a watchdog starts it. The device number and /sys show the kind of a device node.

An error is a value that is wrong on every host with this object. A warning is a value that can become right later or
for another user: a missing file, an address of a network that is down. Disabled outputs have no findings.
"""

import errno
import grp
import os
import re
import socket
import stat
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

import msgspec
from msgspec import inspect

from imud.config.model import Config, DeviceConfig
from imud.config.schema import TABLES, General, Tables
from imud.config.yaml import Path as KeyPath
from imud.host.files import KINDS, read_regular
from imud.host.network import open_socket
from imud.model.errors import reason_of
from imud.model.host_object import HOST_OBJECT, HostObject
from imud.model.options import shown

SYS: Final = Path("/sys")
DEVICES: Final = Path("/dev")
MOUNTS: Final = Path("/proc/self/mounts")
SECRET_BYTES_MAX: Final = 4096  # maximum size of a file with a password or token, bytes
EXPIRY_DAYS: Final = 30  # time before the end of a certificate in which `imud check` warns, days
MEMORY_FILE_SYSTEMS: Final = frozenset(("tmpfs", "ramfs", "devtmpfs", "hugetlbfs"))
PSEUDO_TERMINALS: Final = range(136, 144)  # major numbers without an entry in /sys (Documentation/admin-guide/devices)
# Device numbers of terminals that are not serial ports: /dev/tty, /dev/console, /dev/ptmx, and the virtual consoles
TERMINAL_MAJORS: Final = frozenset((4, 5))
TERMINAL_MINORS: Final = range(64)


class HostFinding(NamedTuple):
    """A value that does not fit the host."""

    path: KeyPath  # key of the value
    message: str  # expected and received value, and the next step
    is_error: bool  # whether the value is wrong on every host; False for a warning


class NamedObject(NamedTuple):
    """A value of the configuration that names an object of the host."""

    path: KeyPath
    kind: HostObject
    value: Any
    options: msgspec.Struct  # options that contain the value
    is_default: bool = False


class Host(NamedTuple):
    """The host, or a simulated host of a test."""

    now_s: float  # UTC as seconds since 1970, for the expiry of certificates
    sys: Path = SYS
    mounts: Path = MOUNTS


class _Wrong(Exception):
    """The value is wrong on every host."""


class _Doubtful(Exception):
    """The value may become right later, or for another user."""


Check = Callable[[NamedObject, Host], None]


def findings(config: Config, host: Host, tables: Tables = TABLES) -> Iterator[HostFinding]:
    """Yield the values of a configuration that do not fit the host, in the order of the file's sections."""
    for named in named_objects(config, tables):
        try:
            CHECKS[named.kind](named, host)
        except _Wrong as error:
            yield HostFinding(named.path, str(error), is_error=True)
        except _Doubtful as error:
            if not named.is_default:  # imud works without the groups and directories of its package
                yield HostFinding(named.path, str(error), is_error=False)
    yield from _findings_of_rows(config, tables)


def _findings_of_rows(config: Config, tables: Tables) -> Iterator[HostFinding]:
    """Yield the values that the row of a link or an output recognizes, for example an interface without CAN."""
    for device in config.devices:
        for problem in tables.links[device.link].host_problems(device.link_settings):
            path = ("devices", device.name, device.link, problem.key)
            yield HostFinding(path, problem.message, problem.is_error)
    for name, options in config.publishers.items():
        if name in tables.publishers and tables.publishers[name].wanted(options):
            for problem in tables.publishers[name].host_problems(options):
                yield HostFinding((name, problem.key), problem.message, problem.is_error)


# --- values that name an object ---------------------------------------------------------------------------------------


def named_objects(config: Config, tables: Tables = TABLES) -> Iterator[NamedObject]:
    """Yield each value of enabled parts that names an object of the host."""
    general = General(state_dir=config.state_dir)
    yield from _objects_of(general, ())
    for name, options in config.publishers.items():
        if name in tables.publishers and tables.publishers[name].wanted(options):
            # the recorder also runs with `enabled: false` if its flight recorder is enabled
            yield from _objects_of(options, (name,))
    for device in config.devices:
        yield from _objects_of_device(device)


def _objects_of_device(device: DeviceConfig) -> Iterator[NamedObject]:
    path: KeyPath = ("devices", device.name)
    yield from _objects_of(device.link_settings, (*path, device.link))
    if device.options is not None:
        yield from _objects_of(device.options, (*path, "options"))
    if device.rmc is not None:
        yield from _objects_of(device.rmc, (*path, "rmc"))
    if device.lines is not None:
        yield from _objects_of(device.lines, (*path, "lines"))


def _objects_of(options: msgspec.Struct, path: KeyPath) -> Iterator[NamedObject]:
    info = inspect.type_info(type(options))
    assert isinstance(info, inspect.StructType)
    for field in info.fields:
        value = getattr(options, field.name)
        for named in _objects_in(field.type, value, (*path, field.name), options):
            yield named._replace(is_default=value == field.default)


def _objects_in(info: inspect.Type, value: Any, path: KeyPath, options: msgspec.Struct) -> Iterator[NamedObject]:
    if isinstance(value, msgspec.Struct):
        if getattr(value, "enabled", True):
            yield from _objects_of(value, path)
        return
    for choice, kind in _choices(info, None):
        if kind is not None:
            if value not in (None, "", []):
                yield NamedObject(path, kind, value, options)
        elif isinstance(choice, inspect.DictType) and isinstance(value, Mapping):
            for key, item in value.items():
                yield from _objects_in(choice.key_type, key, (*path, key), options)
                yield from _objects_in(choice.value_type, item, (*path, key), options)
        elif isinstance(choice, inspect.ListType) and isinstance(value, list):
            for index, item in enumerate(value):
                yield from _objects_in(choice.item_type, item, (*path, index), options)


def _choices(info: inspect.Type, kind: HostObject | None) -> Iterator[tuple[inspect.Type, HostObject | None]]:
    """Yield the types of a union or the single type, each with its kind of object."""
    if isinstance(info, inspect.Metadata):
        yield from _choices(info.type, (info.extra or {}).get(HOST_OBJECT, kind))
    elif isinstance(info, inspect.UnionType):
        for choice in info.types:
            yield from _choices(choice, kind)
    elif not isinstance(info, inspect.NoneType):
        yield info, kind


# --- regular files ----------------------------------------------------------------------------------------------------


def _read(named: NamedObject, expected: str, bytes_max: int) -> bytes:
    """Return the content of a file of at most `bytes_max` bytes."""
    path = str(named.value)
    try:
        content = read_regular(path, bytes_max + 1)
    except FileNotFoundError:
        raise _Doubtful(
            f"expected {expected}, got {path}, which does not exist; create it before imud starts"
        ) from None
    except PermissionError:
        raise _Doubtful(
            f"expected {expected}, got {path}, which this user may not read; run `imud check` as the user of the daemon"
        ) from None
    except OSError as error:
        raise _Wrong(
            f"expected {expected}, got {path}: {error.strerror or reason_of(error)}; name another file"
        ) from None
    if len(content) > bytes_max:
        raise _Wrong(f"expected {expected} of at most {bytes_max} bytes, got {path} with more; name another file")
    _require_absolute(path)
    return content


def _require_absolute(path: str) -> None:
    """Raise _Doubtful for a relative path, which is correct only if the user starts imud in the right folder."""
    if not os.path.isabs(path):
        message = f"expected an absolute path, because the service runs in the folder /, got {path}"
        raise _Doubtful(f"{message}; try {os.path.abspath(path)}")


def _check_certificates(named: NamedObject, host: Host) -> None:
    # the import of ssl needs 3 MB, and `imud run` without TLS does not load this module
    from imud.host.certificates import PEM_BYTES_MAX, certificate_validities

    content = _read(named, "certificates (PEM)", PEM_BYTES_MAX)
    try:
        validities = certificate_validities(content)
    except ValueError as error:
        raise _Wrong(
            f"expected certificates (PEM, `-----BEGIN CERTIFICATE-----`), got {named.value} with {error}; copy the "
            "certificate in this format"
        ) from None
    now = datetime.fromtimestamp(host.now_s, UTC)
    end = min(validity.end for validity in validities)
    if all(validity.end <= now for validity in validities):
        raise _Wrong(
            f"expected a valid certificate, got {named.value}, which expired on {end:%Y-%m-%d}; replace the file"
        )
    if end <= now:
        raise _Doubtful(f"{named.value} contains a certificate that expired on {end:%Y-%m-%d}; remove it from the file")
    start = max(validity.start for validity in validities)
    if start > now:
        raise _Doubtful(
            f"{named.value} contains a certificate that is valid from {start:%Y-%m-%d}, and the clock shows "
            f"{now:%Y-%m-%d}; check the clock of this host"
        )
    if (end - now).days < EXPIRY_DAYS:
        raise _Doubtful(f"{named.value} contains a certificate that expires on {end:%Y-%m-%d}; replace it before")


def _check_client_certificate(named: NamedObject, host: Host) -> None:
    """Check the certificate, and that its key belongs to it."""

    doubt: _Doubtful | None = None
    try:
        _check_certificates(named, host)
    except _Doubtful as error:
        doubt = error
    key_path = getattr(named.options, "key_file", None)
    if key_path is None or _is_key(named._replace(value=key_path), host):
        _check_pair(named.value, key_path)
    if doubt is not None:
        raise doubt


def _is_key(named: NamedObject, host: Host) -> bool:
    """Return whether the file contains a key. Otherwise its own check reports the reason."""
    try:
        _check_key(named, host)
    except (_Wrong, _Doubtful):
        return False
    return True


def _check_pair(certificate: str, key: str | None) -> None:
    import ssl

    from imud.host.certificates import load_client_certificate

    try:
        load_client_certificate(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), certificate, key)
    except ValueError as error:
        raise _Wrong(
            f"expected a certificate and its key, got {certificate} and the key in {key or certificate} ({error}); "
            "name the files that belong together"
        ) from None
    except OSError:
        return  # a missing or unreadable file: `_check_certificates` has reported it


def _check_key(named: NamedObject, _host: Host) -> None:
    from imud.host.certificates import PEM_BYTES_MAX

    content = _read(named, "a key (PEM)", PEM_BYTES_MAX)
    if b"PRIVATE KEY-----" not in content:
        raise _Wrong(
            f"expected a key (PEM, `-----BEGIN PRIVATE KEY-----`), got {named.value} without a key; name the key"
        )


def _check_secret(named: NamedObject, _host: Host) -> None:
    content = _read(named, "a file with a password or token in its first line", SECRET_BYTES_MAX)
    line = content.partition(b"\n")[0].strip()
    try:
        text = line.decode()
    except UnicodeDecodeError:
        text = ""
    if not text.isprintable() or not text:
        raise _Wrong(
            f"expected a password or token in the first line, got {named.value} with "
            f"{'other bytes' if line else 'an empty line'}; write the password or token to the file"
        )


def _check_output_file(named: NamedObject, _host: Host) -> None:
    parts = urlsplit(named.value)
    if parts.scheme != "file":
        return
    path = named.value.removeprefix("file://")
    _require_kind(path, stat.S_ISREG, "a file for lines")
    folder = os.path.dirname(path)
    if not os.path.exists(folder):
        raise _Doubtful(f"expected a file in an existing directory, got {path}; create {folder}")


# --- directories and sockets ------------------------------------------------------------------------------------------


def _status(path: str) -> os.stat_result | None:
    """Return the status of a path; None if it does not exist or if this user may not look at it."""
    try:
        return os.stat(path)
    except NotADirectoryError:
        raise _Wrong(f"expected a path through directories, got {path}, which leads through a file") from None
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENAMETOOLONG):
            raise _Wrong(f"expected a usable path, got {path}: {error.strerror}") from None
        return None


def _require_kind(path: str, is_kind: Callable[[int], bool], expected: str) -> None:
    """Raise _Wrong if an object of another kind exists at a path."""
    status = _status(path)
    if status is not None and not is_kind(status.st_mode):
        raise _Wrong(f"expected {expected}, got {path}, which is {_kind_of(status.st_mode)}; name another path")


def _kind_of(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "a directory"
    return next((name for is_kind, name in KINDS if is_kind(mode)), "a regular file")


def _check_directory(named: NamedObject, _host: Host) -> None:
    path = str(named.value)
    _require_kind(path, stat.S_ISDIR, "a directory")
    _require_absolute(path)


def _check_memory_directory(named: NamedObject, host: Host) -> None:
    _check_directory(named, host)
    file_system = _file_system_of(str(named.value), host.mounts)
    if file_system and file_system not in MEMORY_FILE_SYSTEMS:
        raise _Doubtful(
            f"expected a directory in memory (tmpfs), got {named.value} on {file_system}, to which the kernel writes "
            "each sample; try /run/imud/shm or /dev/shm/imud"
        )


def _file_system_of(path: str, mounts: Path) -> str:
    """Return the type of the file system that contains a path, or will contain it; empty if it is unknown."""
    real = os.path.realpath(path)
    file_system, length = "", 0
    try:
        lines = mounts.read_text("utf-8", "replace").splitlines()
    except OSError:
        return ""
    for line in lines:
        _, place, kind, *_ = line.split(" ")
        is_parent = real == place or real.startswith(place.rstrip("/") + "/")
        if is_parent and len(place) >= length:
            file_system, length = kind, len(place)
    return file_system


def _check_server_socket(named: NamedObject, _host: Host) -> None:
    _require_kind(str(named.value), stat.S_ISSOCK, "a socket or an unused path")


def _check_peer_socket(named: NamedObject, _host: Host) -> None:
    path = str(named.value)
    _require_kind(path, stat.S_ISSOCK, "the socket of chronyd")
    if not os.path.isabs(path):
        raise _Wrong(f"expected an absolute path of a socket, got {path}; try /run/{os.path.basename(path)}")


# --- device nodes -----------------------------------------------------------------------------------------------------


def _subsystem(device_number: int, sys: Path) -> str:
    """Return the subsystem of a character device, for example `tty`; empty if it is unknown."""
    if os.major(device_number) in PSEUDO_TERMINALS:
        return "tty"
    try:
        link = os.readlink(sys / "dev" / "char" / f"{os.major(device_number)}:{os.minor(device_number)}" / "subsystem")
    except OSError:
        return ""
    return os.path.basename(link)


def _require_device(path: str, subsystem: str, expected: str, example: str, host: Host) -> None:
    """Raise _Wrong if a path is not, or cannot be, a device node of a subsystem. A missing node can appear later."""
    if not os.path.isabs(path):
        raise _Wrong(f"expected the path of {expected}, got {path}; try /dev/{os.path.basename(path)}")
    status = _status(path)
    if status is None:
        return
    if not stat.S_ISCHR(status.st_mode):
        raise _Wrong(f"expected {expected}, got {path}, which is {_kind_of(status.st_mode)}; try {example}")
    kind = _subsystem(status.st_rdev, host.sys)
    if kind not in ("", subsystem):
        raise _Wrong(f"expected {expected}, got {path}, a device of the kind {kind}; try {example}")
    if subsystem == "tty" and _is_terminal(status.st_rdev):
        raise _Wrong(f"expected {expected}, got {path}, a console; try {example}")


def _is_terminal(device_number: int) -> bool:
    return os.major(device_number) in TERMINAL_MAJORS and os.minor(device_number) in TERMINAL_MINORS


def _check_serial_port(named: NamedObject, host: Host) -> None:
    _require_device(str(named.value), "tty", "a serial port", "/dev/ttyUSB0", host)


def _check_spi_port(named: NamedObject, host: Host) -> None:
    _require_device(str(named.value), "spidev", "an SPI port", "/dev/spidev0.0", host)


def _check_i2c_bus(named: NamedObject, host: Host) -> None:
    _require_device(f"{DEVICES}/i2c-{named.value}", "i2c-dev", "an I2C bus", "another number", host)


def _check_gpio_chip(named: NamedObject, host: Host) -> None:
    path = os.path.join(DEVICES, named.value)  # an absolute path stays unchanged
    if os.path.isabs(named.value) or os.path.exists(path):
        _require_device(path, "gpio", "a GPIO chip", "/dev/gpiochip0 (`gpiodetect` lists the chips)", host)


# --- addresses, groups and programs -----------------------------------------------------------------------------------


def _check_address(named: NamedObject, _host: Host) -> None:
    """Raise _Doubtful if the host does not have the address now. A DHCP server may assign it later."""
    address = str(named.value)
    if address == "localhost":
        return
    parsed = ip_address(address)
    if parsed.is_multicast or address == "255.255.255.255":
        raise _Wrong(f"expected an address of this host, got {address}, the address of a group; try 0.0.0.0")
    try:
        with open_socket(address, socket.SOCK_DGRAM) as sock:
            sock.bind((address, 0))
    except OSError as error:
        addresses = "`ip -brief address` lists the addresses"
        raise _Doubtful(f"expected an address of this host, got {address}: {reason_of(error)}; {addresses}") from None


def _check_group(named: NamedObject, _host: Host) -> None:
    try:
        grp.getgrnam(named.value)
    except KeyError:
        raise _Doubtful(
            f"expected a group of this host, got {shown(named.value)}; create it with `groupadd --system "
            f"{re.sub(r'[^A-Za-z0-9_-]', '', named.value) or 'NAME'}`"
        ) from None


def _check_program(named: NamedObject, _host: Host) -> None:
    path = str(named.value[0])
    _require_kind(path, stat.S_ISREG, "a program")
    if _status(path) is None:
        raise _Doubtful(f"expected a program, got {path}, which does not exist; install it")
    if not os.access(path, os.X_OK):
        raise _Doubtful(f"expected a program, got {path}, which is not executable; run `chmod +x {path}`")


CHECKS: Final[Mapping[HostObject, Check]] = {
    HostObject.CA_CERTIFICATES: _check_certificates,
    HostObject.CLIENT_CERTIFICATE: _check_client_certificate,
    HostObject.CLIENT_KEY: _check_key,
    HostObject.SECRET: _check_secret,
    HostObject.OUTPUT_FILE: _check_output_file,
    HostObject.DIRECTORY: _check_directory,
    HostObject.MEMORY_DIRECTORY: _check_memory_directory,
    HostObject.SERVER_SOCKET: _check_server_socket,
    HostObject.PEER_SOCKET: _check_peer_socket,
    HostObject.SERIAL_PORT: _check_serial_port,
    HostObject.SPI_PORT: _check_spi_port,
    HostObject.I2C_BUS: _check_i2c_bus,
    HostObject.GPIO_CHIP: _check_gpio_chip,
    HostObject.LISTEN_ADDRESS: _check_address,
    HostObject.INTERFACE_ADDRESS: _check_address,
    HostObject.GROUP: _check_group,
    HostObject.PROGRAM: _check_program,
}
