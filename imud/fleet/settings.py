"""Options of the output `mqtt`."""

import re
from collections.abc import Collection, Iterator, Mapping
from enum import StrEnum
from typing import Annotated, Final, Literal, NamedTuple
from urllib.parse import urlsplit

import msgspec

from imud.contracts.driver import Driver
from imud.contracts.lines import LINE_VERBS
from imud.contracts.publisher import PublisherType, make_later
from imud.model.host_object import CaFile, CertificateFile, Directory, KeyFile, SecretFile
from imud.model.options import Options, is_host, shown, unknown_name
from imud.model.units import NS_PER_S

MEGABYTE: Final = 1_000_000
BROKERS_MAX: Final = 16  # Maximum number of brokers. imud tries them in order, and more brokers would take minutes.
EVERY: Final = "*"  # key for all devices without an entry of their own
STATUS_S: Final = 60.0  # default interval of the status messages, s
SET: Final = "set"  # command that changes settings; `set.NAME` allows it for one setting
Measure = Literal["mean", "min", "max", "rms"]
# Pattern of a name, at most 64 characters. MQTT limits a topic to 65,535 bytes, and a client ID contains three names.
NAME_PATTERN: Final = "[A-Za-z0-9_-]{1,64}"
_NAME: Final = re.compile(NAME_PATTERN)
Name = Annotated[str, msgspec.Meta(pattern=f"^({NAME_PATTERN})?$", extra={"words": "letters, digits, _ and -"})]


LOCALHOST: Final = ("localhost", "localhost6", "ip6-localhost")  # names of many hosts, which identify no gateway


class Whole(StrEnum):
    """Formats of complete samples."""

    NONE = "none"
    JSON = "json"
    SLOTS = "slots"


class DeviceSending(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Messages that imud sends for a device."""

    rate_hz: Annotated[float, msgspec.Meta(ge=0.01, le=100)] | None = 1.0
    """Statistics intervals per second; null: no statistics."""
    values: Annotated[list[Measure], msgspec.Meta(min_length=1)] = msgspec.field(
        default_factory=lambda: list[Measure](("mean", "min", "max", "rms"))
    )
    """Statistics of each interval: `mean`, `min`, `max`, `rms` (root mean square)."""
    whole: Whole = Whole.NONE
    """Format of all samples: `json`, compressed `slots`, or `none` for statistics only."""
    batch_s: Annotated[float, msgspec.Meta(ge=0.1, le=60)] = 1.0
    """Time that one message covers, s."""
    events: bool = True
    """Send the events of the device."""
    status: bool = True
    """Send the status of the device (retained), after each change and every `status_s`."""
    settings: bool = True
    """Send the device settings and their differences from the declared settings (retained), after each change."""

    @property
    def batch_ns(self) -> int:
        return round(self.batch_s * NS_PER_S)


class CommandOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the command channel."""

    enabled: bool = False
    """Accept commands for devices over the broker. The rights on the broker decide who can send commands."""
    actions: Annotated[list[str], msgspec.Meta(max_length=256)] = msgspec.field(default_factory=list[str])
    """Allowed commands: `COMMAND` for all devices, `DEVICE/COMMAND` for one device. `set` allows the change of all
    settings, `set.NAME` of one setting. imud rejects all other commands."""
    max_age_s: Annotated[float, msgspec.Meta(ge=1, le=600)] = 30.0
    """Maximum difference between `issued_utc_ns` of a request and the clock of the gateway, s."""
    per_minute: Annotated[int, msgspec.Meta(ge=1, le=600)] = 30
    """Maximum number of requests per minute."""

    def __post_init__(self) -> None:
        """Raise ValueError if an entry is not the name of a command."""
        for entry in self.actions:
            device, slash, action = entry.rpartition("/")
            name = action.removeprefix(f"{SET}.")
            if not is_name(name) or (slash and not is_name(device)):
                raise ValueError(
                    f"actions: expected names of commands, {SET}.SETTING, or DEVICE/COMMAND, got {shown(entry)}"
                )

    def allows(self, device: str, action: str, settings: Collection[str] = ()) -> bool:
        """Return whether the configuration allows this command. `settings`: names of settings that `set` changes."""
        allowed = {entry.removeprefix(f"{device}/") for entry in self.actions}
        each = {f"{SET}.{name.partition('.')[0]}" for name in settings}
        return action in allowed or (action == SET and bool(each) and each <= allowed)

    @property
    def max_age_ns(self) -> int:
        return round(self.max_age_s * NS_PER_S)


class Broker(NamedTuple):
    """Address of a broker from its URL."""

    host: str
    port: int
    tls: bool
    websockets: bool
    path: str  # path of the WebSocket

    @property
    def name(self) -> str:
        """Return the URL without user and password."""
        scheme = ("wss" if self.tls else "ws") if self.websockets else ("mqtts" if self.tls else "mqtt")
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{scheme}://{host}:{self.port}{self.path if self.websockets else ''}"


PORTS: Final = {"mqtt": 1883, "mqtts": 8883, "ws": 80, "wss": 443}  # supported URL schemes and their default ports


def is_name(text: str) -> bool:
    """Return whether `text` is a valid name of a site, a gateway or a device."""
    return _NAME.fullmatch(text) is not None


def broker_of(url: str) -> Broker | None:
    """Return the broker of a URL; None if the URL is invalid or contains a user or a password."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return None
    host = parts.hostname or ""
    websockets = parts.scheme in ("ws", "wss")
    if parts.scheme not in PORTS or not is_host(host) or parts.query or parts.fragment or "@" in parts.netloc:
        return None
    if (parts.path not in ("", "/") and not websockets) or port == 0:
        return None
    path = parts.path if websockets and parts.path not in ("", "/") else "/mqtt"
    return Broker(host, port or PORTS[parts.scheme], parts.scheme in ("mqtts", "wss"), websockets, path)


class MqttOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the output `mqtt`."""

    enabled: bool = False
    """Send to an MQTT broker. Needs the extra `imud[mqtt]`."""
    brokers: Annotated[list[str], msgspec.Meta(min_length=1, max_length=BROKERS_MAX)] = msgspec.field(
        default_factory=lambda: ["mqtt://127.0.0.1:1883"]
    )
    """Brokers of one cluster, in the order of the attempts: `mqtt://HOST:PORT`, `mqtts` (TLS), `ws` or `wss`
    (WebSocket)."""
    version: Literal["5", "3.1.1"] = "5"
    """Version of MQTT. With 3.1.1, messages that the broker rejects are lost."""
    site: Name = "default"
    """Name of the site, second level of all topics."""
    gateway: Name = ""
    """Name of this gateway, third level of all topics, unique on the broker; empty: the host name up to the
    first dot."""
    user: str = ""
    """User name for the broker; empty: none."""
    password_file: SecretFile | None = None
    """File with the password in its first line, read at each connection; null: no password."""
    ca_file: CaFile | None = None
    """CA certificates (PEM) for the broker; null: the certificates that the system trusts."""
    cert_file: CertificateFile | None = None
    """Client certificate (PEM) of this gateway; null: no certificate."""
    key_file: KeyFile | None = None
    """Key of the certificate (PEM, without a passphrase); null if `cert_file` contains the key."""
    keep_alive_s: Annotated[int, msgspec.Meta(ge=5, le=3600)] = 30
    """Keep-alive time, s. imud detects a dead connection within twice this time."""
    retry_max_s: Annotated[float, msgspec.Meta(ge=1, le=3600)] = 60.0
    """Maximum pause between two connection attempts, s. Pauses are random and grow from 4 s."""
    messages_per_s: Annotated[float, msgspec.Meta(ge=0.1, le=100_000)] | None = None
    """Maximum number of stream messages per second, above the rate of new messages; null: no limit."""
    newest_first: bool = False
    """Send new messages before older messages. Streams are then not in order."""
    spool_directory: Directory = "/var/lib/imud/mqtt"
    """Directory of the spool. imud creates it."""
    spool_mb: Annotated[float, msgspec.Meta(ge=1, le=1_000_000)] = 256.0
    """Maximum size of the spool, MB (10⁶ bytes). If it is full, imud first replaces the oldest samples by statistics,
    then drops the oldest messages."""
    spool_hours: Annotated[float, msgspec.Meta(ge=0.01, le=8760)] = 168.0
    """Maximum age of a message in the spool, hours."""
    status_s: Annotated[float, msgspec.Meta(ge=1, le=3600)] = STATUS_S
    """Interval of the status messages of devices and gateway, s."""
    commands: CommandOptions = CommandOptions()
    """Options of the command channel."""
    home_assistant: bool = False
    """Announce devices with `status` to Home Assistant. The gateway must be allowed to write below
    `homeassistant/device/`."""
    devices: dict[str, DeviceSending] = msgspec.field(default_factory=lambda: {EVERY: DeviceSending()})
    """Messages by device name; `*`: all other devices."""

    def __post_init__(self) -> None:
        """Raise ValueError if a URL, a name, or a combination of keys is invalid."""
        if self.gateway.lower() in LOCALHOST:
            raise ValueError(f"gateway: expected a name that no other gateway has, got {shown(self.gateway)}")
        for url in self.brokers:
            if broker_of(url) is None:
                raise ValueError(
                    f"brokers: expected a URL such as mqtts://broker.example:8883 (mqtt, mqtts, ws or wss; no user, "
                    f"no password), got {shown(url)}"
                )
        if self.key_file is not None and self.cert_file is None:
            raise ValueError("key_file: expected cert_file as well, got none")
        if self.password_file is not None and not self.user:
            raise ValueError("password_file: expected user as well, got none")
        for name in self.devices:
            if name != EVERY and not is_name(name):
                raise ValueError(f"devices: expected names of devices or *, got {shown(name)}")

    def sending(self, device: str) -> DeviceSending | None:
        """Return the options of a device; None if imud sends nothing."""
        return self.devices.get(device, self.devices.get(EVERY))

    @property
    def spool_bytes(self) -> int:
        return round(self.spool_mb * MEGABYTE)

    @property
    def spool_age_ns(self) -> int:
        return round(self.spool_hours * 3600 * NS_PER_S)


def check_commands(options: MqttOptions, drivers: Mapping[str, Driver]) -> Mapping[tuple[str, ...], str]:
    """Return the error of each allowed command that no driver has, by the path of the key."""
    problems = list(_unknown_commands(options.commands.actions, drivers)) if options.commands.actions else []
    return {("commands", "actions"): "; ".join(problems)} if problems else {}


def _unknown_commands(entries: Collection[str], drivers: Mapping[str, Driver]) -> Iterator[str]:
    verbs, settings, renamed = {SET, *LINE_VERBS}, set[str](), dict[str, set[str]]()
    for name in drivers:
        try:
            driver = drivers[name]
        except ImportError:  # an extra is missing
            continue
        table = driver.device_settings.table if driver.device_settings is not None else {}
        writable = {setting for setting, one in table.items() if one.write is not None}
        verbs |= set(driver.verbs)
        settings |= writable
        for old, words in driver.renamed.items():
            renamed.setdefault(old, set()).update(_settings_in(words, writable))
    for entry in entries:
        device, slash, action = entry.rpartition("/")
        if action in verbs:
            continue
        if action in renamed:
            new = ", ".join(f"{device}{slash}{SET}.{name}" for name in sorted(renamed[action]))
            step = f"use {new}" if new else "remove it"
            yield f"expected a command, got {shown(entry)}, which is a setting now; {step}"
        elif not action.startswith(f"{SET}."):
            yield unknown_name("a command", action, sorted(verbs))
        elif (name := action.removeprefix(f"{SET}.")) not in settings:
            yield unknown_name(f"a setting after {SET}.", name, sorted(settings))


def _settings_in(words: str, known: Collection[str]) -> set[str]:
    """Return the settings in a value of `Driver.renamed`. An argument in a name stands for any text."""
    names = [word.partition("=")[0].partition(".")[0] for word in words.split() if "=" in word]
    patterns = [re.compile(re.sub(r"\\{\w+\\}", r"\\w+", re.escape(name))) for name in names]
    return {name for name in known if any(pattern.fullmatch(name) for pattern in patterns)}


PUBLISHER = PublisherType("mqtt", MqttOptions, make_later("imud.fleet.publisher:MqttPublisher"), check=check_commands)
