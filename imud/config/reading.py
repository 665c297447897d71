"""Load a configuration file: read and check the whole file with its devices, then make a `Config`."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from ipaddress import IPv4Address, IPv6Address, ip_address
from itertools import chain, islice
from pathlib import Path
from re import compile as pattern
from typing import Any, Final, NamedTuple

from imud.config.model import Config, DeviceConfig
from imud.config.parts import (
    check_attitude,
    check_declination,
    lines_of_device,
    lines_once,
    read_frame,
    read_lines,
    read_rmc,
)
from imud.config.schema import TABLES, DeviceGeneral, General, Keys, S, Tables
from imud.config.yaml import FILE_BYTES_MAX, Problem, no_pause, path_text, read_yaml
from imud.config.yaml import Path as KeyPath
from imud.contracts.command import Target
from imud.contracts.condition import ConditionLimits
from imud.contracts.driver import CanDriver, Driver, PolledDriver
from imud.contracts.lines import DeviceLines
from imud.contracts.link import CanUse, Claim, LinkType, conflict_of
from imud.contracts.publisher import OutputListener, PublisherType
from imud.contracts.registry import problems_of
from imud.contracts.setting import SettingsTable, declared_values
from imud.contracts.status import Deviations
from imud.host.files import read_regular
from imud.model.errors import BadArgument, ConfigError
from imud.model.options import Options, got, shown, unknown_name
from imud.model.sample import DEVICE_NAME_PATTERN
from imud.model.units import NS_PER_S, NS_PER_US

PROBLEMS_SHOWN: Final = 20
MISSING: Final = "is the path right?"  # hint if a file does not exist


def load(
    path: Path | str,
    tables: Tables = TABLES,
    pause: Callable[[], None] = no_pause,
    missing: str = MISSING,
) -> Config:
    """Read a configuration file. Raises ConfigError with all problems, one per line.

    imud calls `pause` after each piece of work of less than a millisecond. `missing` is the hint if the file does not
    exist.
    """
    return parse(content_of(path, missing), str(path), tables, pause)


def load_options(path: Path | str, schema: type[S]) -> S:
    """Read a YAML file that contains only the keys of `schema`. Raises ConfigError with all problems, one per line."""
    tree = read_yaml(content_of(path))
    keys = Keys(tree)
    options = keys.part(schema, tree.data, ()) if tree.complete else None
    problems = [*tree.problems, *keys.problems_besides(tree.problems)]
    if problems or options is None:
        raise ConfigError(_report(problems, str(path)))
    return options


def content_of(path: Path | str, missing: str = MISSING) -> bytes:
    """Return the content of a configuration file, at most one byte above the limit. Raises ConfigError."""
    try:
        return read_regular(path, FILE_BYTES_MAX + 1)
    except OSError as error:
        hint = "check its owner and mode" if isinstance(error, PermissionError) else missing
        raise ConfigError(f"cannot read {path}: {error.strerror}; {hint}") from None


def parse(text: str | bytes, filename: str, tables: Tables = TABLES, pause: Callable[[], None] = no_pause) -> Config:
    """Read a configuration from text. `filename` is for messages, `pause` as in `load`. Raises ConfigError."""
    tree = read_yaml(text.encode() if isinstance(text, str) else text, pause)
    keys = Keys(tree)
    config = _config(keys, tables, pause) if tree.complete else None
    problems = [*tree.problems, *keys.problems_besides(tree.problems)]
    if problems or config is None:
        raise ConfigError(_report(problems, filename))
    known = "\n".join(ignored := _lines(keys.ignored, filename))
    broken = [*problems_of(tables.drivers).values(), *problems_of(tables.publishers).values()]
    return replace(config, ignored=(*ignored, *(problem for problem in broken if problem not in known)))


def _config(keys: Keys, tables: Tables, pause: Callable[[], None]) -> Config | None:
    """Make the configuration; None if it has problems."""
    top = keys.mapping((), keys.tree.data)
    if top is None:
        return None
    ignored = [name for name in top if keys.ignores(tables.publishers, name, (name,), "output")]
    keys.unknown_keys((), top, [*General.__struct_fields__, *tables.publishers, *ignored, "devices"])
    general = keys.settings(General, (), {key: top[key] for key in General.__struct_fields__ if key in top})
    publishers = {name: keys.row(tables.publishers, name, top.get(name)) for name in tables.publishers}
    for name, options in publishers.items():
        for path, message in tables.publishers[name].check(options, tables.drivers).items() if options else ():
            keys.problem((name, *path), message)
    outputs = {name: options for name, options in publishers.items() if options is not None}
    for clash in listener_clashes(outputs, tables.publishers):
        keys.problem(*clash)
    devices = DeviceReader(keys, tables, pause, outputs).devices(top)
    if general is None or devices is None or keys.problems:
        return None
    used = tuple(device for device, enabled in devices if enabled)
    return Config(
        log_level=general.log_level,
        state_dir=general.state_dir,
        publishers={name: settings for name, settings in publishers.items() if settings is not None},
        devices=used,
        disabled=tuple(device.name for device, enabled in devices if not enabled),
    )


def _report(problems: Sequence[Problem], filename: str) -> str:
    lines = _lines(sorted(problems)[:PROBLEMS_SHOWN], filename)
    if len(problems) > PROBLEMS_SHOWN:
        lines.append(f"… and {len(problems) - PROBLEMS_SHOWN} more problems")
    return "\n".join(lines)


def _lines(problems: Iterable[Problem], filename: str) -> list[str]:
    return [
        f"{filename}:{one.mark.line}:{one.mark.column}: {f'{path_text(one.path)}: ' * bool(one.path)}{one.message}"
        for one in problems
    ]


# --- conflicts of ports, addresses and frames -------------------------------------------------------------------------


class Clash(NamedTuple):
    """Two devices, or an output and a device, that cannot have the same port, address or frames."""

    path: KeyPath  # key to change
    message: str  # expected value, received value, and the owner


class _Owned(NamedTuple):
    claim: Claim
    owner: str


def clashes(
    devices: Sequence[DeviceConfig],
    links: Mapping[str, LinkType[Any]],
    drivers: Mapping[str, Driver],
    pause: Callable[[], None] = no_pause,
    outputs: Mapping[str, Sequence[Claim]] = {},
) -> Iterator[Clash]:
    """Return the conflicts of each device with the devices before it, and of each output with the devices. imud follows
    symbolic links and opens no port."""
    places: dict[str, list[_Owned]] = {}
    buses: dict[str, list[tuple[CanUse, str]]] = {}
    for device in devices:
        owner = f"{device.name} (line {device.line})" if device.line else device.name
        for part, claim in _claims(device, links):
            held = places.setdefault(_place(claim), [])
            for other in held:
                if conflict := conflict_of(claim, other.claim, other.owner):
                    yield Clash(("devices", device.name, part, conflict.key), conflict.message)
                    break
            held.append(_Owned(claim, owner))
        use = _can_use(device, links, drivers)
        if use is not None:
            uses = buses.setdefault(use.bus, [])
            yield from _can_clash(device.name, use, uses)
            uses.append((use, owner))
        pause()
    for output, claims in outputs.items():
        for claim in claims:
            for other in places.get(_place(claim), ()):
                if conflict := conflict_of(claim, other.claim, other.owner):
                    yield Clash((output, conflict.key), conflict.message)
                    break


def listener_clashes(outputs: Mapping[str, Options], rows: Mapping[str, PublisherType]) -> Iterator[Clash]:
    """Return the conflicts of the enabled outputs that listen on one TCP port of overlapping addresses."""
    previous: list[tuple[str, OutputListener]] = []
    for name, options in outputs.items():
        for listener in rows[name].listeners(options) if rows[name].wanted(options) else ():
            for other, other_listener in previous:
                if _share_port(listener, other_listener):
                    key = ".".join((other, *other_listener.path))
                    message = f"expected a TCP port that no other output uses, got {listener.port}, the value of {key}"
                    yield Clash((name, *listener.path), f"{message}; try {listener.port + 1}")
                    break
            previous.append((name, listener))


def _share_port(listener: OutputListener, other: OutputListener) -> bool:
    """Return whether the kernel refuses the second of these listeners. Port 0 is any free port."""
    return listener.port == other.port != 0 and _overlap(_listen_ip(listener.address), _listen_ip(other.address))


def _listen_ip(address: str) -> IPv4Address | IPv6Address:
    ip = ip_address("127.0.0.1" if address == "localhost" else address)
    return getattr(ip, "ipv4_mapped", None) or ip


def _overlap(ip: IPv4Address | IPv6Address, other: IPv4Address | IPv6Address) -> bool:
    """Return whether a connection can match both addresses. `::` also receives IPv4 (ipv6(7), IPV6_V6ONLY is 0)."""
    wildcards = [address for address in (ip, other) if address.is_unspecified]
    return ip == other or any(wildcard.version == 6 or ip.version == other.version for wildcard in wildcards)


def owner_of(device: DeviceConfig, others: Sequence[DeviceConfig], links: Mapping[str, LinkType[Any]]) -> str:
    """Return the device in `others` with which `device` cannot share its port; empty if there is none."""
    mine = _claims(device, links)
    for other in others:
        for _, theirs in _claims(other, links) if other.name != device.name else ():
            if any(_place(theirs) == _place(one) and conflict_of(one, theirs, "") for _, one in mine):
                return other.name
    return ""


def _claims(device: DeviceConfig, links: Mapping[str, LinkType[Any]]) -> list[tuple[str, Claim]]:
    """Return the claims of a device, each with its part of the configuration."""
    found = [(device.link, claim) for claim in links[device.link].claims(device.link_settings)]
    if device.rmc is not None and device.rmc.port:
        found.append(("rmc", Claim(place=device.rmc.port, key="port")))
    return found


def _place(claim: Claim) -> str:
    return os.path.realpath(claim.place) if claim.place.startswith("/") else claim.place


def _can_use(device: DeviceConfig, links: Mapping[str, LinkType[Any]], drivers: Mapping[str, Driver]) -> CanUse | None:
    """Return the frames that a device needs on a shared bus; None if they are unknown before the detection."""
    claims = _claims(device, links)
    if device.options is None or not claims:
        return None
    driver = drivers[device.driver]
    if not isinstance(driver, CanDriver):
        return None
    return CanUse(_place(claims[0][1]), driver.filters(device.options), driver.cyclic(device.options))


def _can_clash(name: str, use: CanUse, uses: Sequence[tuple[CanUse, str]]) -> Iterator[Clash]:
    """Yield the conflicts of the frames that a device needs. The first owner of a frame is enough."""
    path: KeyPath = ("devices", name, "options")
    for other, owner in uses:
        if both := use.both_receive(other):
            yield Clash(path, f"expected no device on {use.bus} with the frame {both} of {owner}, got this device")
            return
        if both := use.both_send(other):
            message = f"expected one device on {use.bus} for which imud sends {both}, got this device and {owner}"
            yield Clash(path, f"{message}; remove the key here")
            return


class DeclaredReader:
    """Reader of the declared settings of devices. `drivers` is the registry of drivers."""

    def __init__(self, keys: Keys, drivers: Mapping[str, Driver]) -> None:
        self._keys = keys
        self._drivers = drivers

    def read(self, path: KeyPath, device: Mapping[str, Any]) -> Options | None:
        """Read the key `settings` of a device; None if the key is absent or invalid."""
        key = (*path, "settings")
        if device.get("settings") is None:
            return None
        driver = device.get("driver", "auto")
        if driver == "auto":
            message = f"expected the name of a driver next to settings, got auto; {self._known()}"
            self._keys.problem(key, message, at_key=True)
            return None
        if not isinstance(driver, str) or driver not in self._drivers:
            return None  # the driver reports this problem
        table = self._table(driver)
        if table is None:
            message = f"expected a driver with a table of settings, got {driver}; "
            self._keys.problem(key, message + self._known(), at_key=True)
            return None
        if device.get("identify") is False:
            message = "expected identify: true, because imud reads the settings only then, got false"
            self._keys.problem(key, message, at_key=True)
            return None
        return self._keys.part(table.declarable, device["settings"], key)

    def check(self, path: KeyPath, driver: str, declared: Options, options: Options | None, link: Options) -> None:
        """Report settings that exclude each other or contradict the address of the device."""
        table = self._drivers[driver].device_settings
        assert table is not None  # `read` has accepted the settings
        key, values = (*path, "settings"), declared_values(declared)
        for name, value in values.items():
            place = _fixed(name, options, link) if table.table[name].connection else None
            if place not in (None, value):
                message = f"expected {shown(place)}, the value that imud uses to open the device, got {shown(value)}; "
                hint = f"change it with `imud settings {path[-1]} --set {name}=… --save`, "
                self._keys.problem((*key, name), f"{message}{hint}or use auto if the link supports it")
        baud = getattr(link, "baud", 0)
        try:
            table.check(Target(options, baud if isinstance(baud, int) else 0), values)
        except BadArgument as error:
            self._keys.problem(key, str(error))

    def check_lines(self, path: KeyPath, driver: str, declared: Options, lines: DeviceLines) -> None:
        """Report lines that have no function with the declared settings."""
        found = self._drivers[driver].declared_line_differences(declared_values(declared), lines)
        for key, words in found.items():
            self._keys.problem((*path, "lines", key), f"with the declared settings, {words}", at_key=True)

    def _table(self, driver: str) -> SettingsTable | None:
        try:
            return self._drivers[driver].device_settings
        except ImportError:  # the driver reports this problem
            return None

    def _known(self) -> str:
        names = [name for name in self._drivers if self._table(name) is not None]
        return f"drivers with settings: {', '.join(names) or 'none'}"


def _fixed(name: str, options: Options | None, link: Options) -> object:
    """Return the value with which imud opens the device; None if imud searches for it or the key does not exist."""
    for part in (link, options):
        value = getattr(part, name, None)
        if value is not None and value != "auto":
            return value
    return None


# Maximum number of devices, more than one process can serve. A longer file is a mistake of a generator.
DEVICES_MAX: Final = 256
NOISE: Final = "noise"
CONDITION: Final = "condition"
DEVICE_NAME: Final = pattern(DEVICE_NAME_PATTERN)


class DeviceReader:
    def __init__(self, keys: Keys, tables: Tables, pause: Callable[[], None], outputs: Mapping[str, Options]) -> None:
        """imud calls `pause` after each device. `outputs` contains the options of each output."""
        self._keys = keys
        rows = tables.publishers
        self._outputs = {name: rows[name].claims(one) for name, one in outputs.items()}
        self._output_lines = [
            ((name, *path), it) for name, one in outputs.items() for path, it in rows[name].used_lines(one)
        ]
        self._tables = tables
        self._declared = DeclaredReader(keys, tables.drivers)
        self._pause = pause

    def devices(self, top: Mapping[str, Any]) -> list[tuple[DeviceConfig, bool]] | None:
        """Read the valid devices, each with its key `enabled`; None if the key is missing or empty."""
        path: KeyPath = ("devices",)
        if "devices" not in top:
            self._keys.problem((), "expected the key devices with a name and keys for each device, got none")
            return None
        if top["devices"] is None:
            self._keys.problem(path, "expected a name and keys for each device, got nothing; write {} for no device")
            return None
        found = self._keys.mapping(path, top["devices"]) or {}
        if len(found) > DEVICES_MAX:
            self._keys.problem(path, f"expected at most {DEVICES_MAX} devices, got {len(found)}")
        devices = [self._device(name, data) for name, data in islice(found.items(), DEVICES_MAX)]
        made = [device for device in devices if device is not None]
        used = [device for device, enabled in made if enabled]
        for clash in clashes(used, self._tables.links, self._tables.drivers, self._pause, self._outputs):
            self._keys.problem(*clash)
        self._buses_carry(used)
        lines_once(self._keys, chain(*map(lines_of_device, used), self._output_lines))
        return made

    def _device(self, name: str, data: object) -> tuple[DeviceConfig, bool] | None:
        self._pause()
        path: KeyPath = ("devices", name)
        if not DEVICE_NAME.fullmatch(name):
            rule = "1 to 32 characters of a-z, 0-9, _ and -, starting with a letter or digit"
            self._keys.problem(path, f"expected a device name of {rule}, got {got(name)}", at_key=True)
        keys = self._keys.mapping(path, data)
        if keys is None or self._keys.ignores(self._tables.drivers, keys.get("driver"), (*path, "driver"), "device"):
            return None
        own = DeviceGeneral.__struct_fields__
        self._keys.unknown_keys(
            path, keys, [*own, "options", "settings", "lines", "rmc", "frame", NOISE, CONDITION, *self._tables.links]
        )
        general = self._keys.settings(DeviceGeneral, path, {key: keys[key] for key in own if key in keys})
        options = self._options(path, keys)
        declared = self._declared.read(path, keys)
        link = self._link(path, keys)
        lines = read_lines(self._keys, (*path, "lines"), keys, self._tables.drivers)
        rmc = read_rmc(self._keys, (*path, "rmc"), keys, self._tables.drivers)
        frame = read_frame(self._keys, (*path, "frame"), keys)
        noise = self._keys.part(Deviations, keys[NOISE], (*path, NOISE)) if NOISE in keys else None
        limits = self._keys.part(ConditionLimits, keys.get(CONDITION), (*path, CONDITION))
        if general is None or link is None or limits is None:
            return None
        link_name, link_settings = link
        known = general.driver == "auto" or options is not None
        if known and self._driver_fits(path, general.driver, link_name) and options is not None:
            self._go_together(path, general.driver, options, link_name, link_settings)
        self._usable(path, general.driver, link_name, link_settings)
        if declared is not None:
            self._declared.check(path, general.driver, declared, options, link_settings)
            if lines is not None:
                self._declared.check_lines(path, general.driver, declared, lines)
        check_declination(self._keys, path, general, options, self._tables.drivers)
        check_attitude(self._keys, path, general, options, self._tables.drivers)
        line = self._keys.tree.key_mark(path).line
        own_keys = general.driver, options, general.identify, link_name, link_settings
        frames = frame, general.convention, general.declination_deg
        made = DeviceConfig(
            name, *own_keys, line, lines, rmc, declared, general.on_difference, *frames, noise, limits, general.attitude
        )  # fmt: skip
        return made, general.enabled

    def _options(self, path: KeyPath, keys: Mapping[str, Any]) -> Options | None:
        driver = keys.get("driver", "auto")
        if driver == "auto":
            if keys.get("options") is not None:
                names = ", ".join(self._tables.drivers)
                message = f"expected the name of a driver next to options, got auto; drivers: {names}"
                self._keys.problem((*path, "options"), message, at_key=True)
            return None
        if not isinstance(driver, str):
            return None
        if driver not in self._tables.drivers:
            self._keys.problem((*path, "driver"), unknown_name("a driver", driver, ["auto", *self._tables.drivers]))
            return None
        return self._keys.row(self._tables.drivers, driver, keys.get("options"), (*path, "options"))

    def _link(self, path: KeyPath, keys: Mapping[str, Any]) -> tuple[str, Options] | None:
        names = [name for name in self._tables.links if name in keys]
        if len(names) != 1:
            found = " and ".join(names) or "none"
            message = f"expected exactly one link ({', '.join(self._tables.links)}), got {found}"
            self._keys.problem(path, message, at_key=True)
            return None
        settings = self._keys.row(self._tables.links, names[0], keys[names[0]], (*path, names[0]))
        return None if settings is None else (names[0], settings)

    def _driver_fits(self, path: KeyPath, driver: str, link: str) -> bool:
        """Report a driver if the link cannot carry its protocol."""
        links, drivers = self._tables.links, self._tables.drivers
        if driver == "auto" and not links[link].searchable:
            known = ", ".join(self._fitting((name, name, link) for name in drivers))
            self._keys.problem(path, f"expected the name of a driver for {link} ({known}), got auto", at_key=True)
            return False
        if driver in drivers and link not in (fitting := self._fitting((name, driver, name) for name in links)):
            message = f"expected a link that {driver} can use ({', '.join(fitting)}), got {link}"
            self._keys.problem((*path, link), message, at_key=True)
            return False
        return True

    def _go_together(self, path: KeyPath, driver: str, options: Options, link: str, link_settings: Options) -> None:
        """Report values of options and link that the driver does not support."""
        for problem in self._tables.drivers[driver].problems(options, link_settings):
            part = link if problem.part == "link" else problem.part
            self._keys.problem((*path, part, problem.key), problem.message)

    def _usable(self, path: KeyPath, driver: str, link: str, settings: Options) -> None:
        """Report options that the link does not support."""
        frames = False
        with suppress(ImportError, KeyError):  # another check reports a missing or failing driver
            frames = isinstance(self._tables.drivers[driver], CanDriver)
        if problem := self._tables.links[link].problem(settings, frames):
            self._keys.problem((*path, link), problem)

    def _fitting(self, pairs: Iterable[tuple[str, str, str]]) -> list[str]:
        """Return the names of the fitting (name, driver, link), as far as their libraries are installed."""
        found = []
        for name, driver, link in pairs:
            with suppress(ImportError):
                if self._tables.links[link].fits(self._tables.drivers[driver]):
                    found.append(name)
        return found

    def _buses_carry(self, devices: Sequence[DeviceConfig]) -> None:
        """Report rates whose reads take more time than a bus has for all its devices."""
        shares: dict[tuple[str, str], float] = {}
        for device in devices:
            driver = self._tables.drivers.get(device.driver)
            bus = self._tables.links[device.link].bus_of(device.link_settings)
            rate_hz = getattr(device.link_settings, "rate_hz", 0.0)
            if not isinstance(driver, PolledDriver) or device.options is None or not bus or not rate_hz:
                continue  # another check reports invalid options
            if not self._tables.links[device.link].fits(driver):
                continue
            read_ns = driver.read_ns(device.options, device.link_settings)
            before = shares.get((device.link, bus), 0.0)
            share = shares[device.link, bus] = before + rate_hz * read_ns / NS_PER_S
            if share > 1 and read_ns:
                others = f", and other devices use {before:.0%} of it" if before else ""
                most = int(max(0.0, 1 - before) * NS_PER_S / read_ns)
                message = (
                    f"expected at most {most}, got {rate_hz:g}: a read takes at least {read_ns / NS_PER_US:.0f} µs of "
                    f"{bus}{others}"
                )
                self._keys.problem(("devices", device.name, device.link, "rate_hz"), message)
