"""Contract of the configuration: settings of the output `mqtt`, and what is sent of a device."""

from enum import StrEnum
from typing import Annotated, Final, Literal, NamedTuple
from urllib.parse import urlsplit

import msgspec

from imud.fleet.messages import NAME_PATTERN, is_name
from imud.model.options import Options, is_host, shown
from imud.model.units import NS_PER_S

MEGABYTE: Final = 1_000_000
BROKERS_MAX: Final = 16
"""Brokers in the list: each is tried in turn, and a turn of more would take minutes."""
EVERY: Final = "*"
"""Stands for the devices that are not named."""
Measure = Literal["mean", "min", "max", "rms"]
Name = Annotated[str, msgspec.Meta(pattern=f"^({NAME_PATTERN})?$", extra={"words": "letters, digits, _ and -"})]


class Whole(StrEnum):
    """Forms of whole samples."""

    NONE = "none"
    JSON = "json"
    SLOTS = "slots"


class DeviceSending(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is sent of a device."""

    rate_hz: Annotated[float, msgspec.Meta(ge=0.01, le=100)] | None = 1.0
    """Intervals a second that statistics are made of, from all samples in each; null for none."""
    values: Annotated[list[Measure], msgspec.Meta(min_length=1)] = msgspec.field(
        default_factory=lambda: list[Measure](("mean", "min", "max", "rms"))
    )
    """What is sent of each interval: its `mean`, `min`, `max`, `rms` (root mean square)."""
    whole: Whole = Whole.NONE
    """Whether every sample is sent as well: as `json`, as compressed `slots`, or not (`none`)."""
    batch_s: Annotated[float, msgspec.Meta(ge=0.1, le=60)] = 1.0
    """Intervals and samples of so much time are sent in one message, s."""
    events: bool = True
    """Whether its events are sent."""
    status: bool = True
    """Whether its state is sent, retained, when it changes and every `status_s`."""
    settings: bool = True
    """Whether its own settings are sent, retained, when they change: what it reports, and what is not as declared."""

    @property
    def batch_ns(self) -> int:
        """`batch_s` in nanoseconds."""
        return round(self.batch_s * NS_PER_S)


class CommandOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the command channel."""

    enabled: bool = False
    """Whether actions of devices may be asked for over the broker, by whoever its rights let write to
    `imud/SITE/GATEWAY/DEVICE/command`."""
    actions: Annotated[list[str], msgspec.Meta(max_length=256)] = msgspec.field(default_factory=list[str])
    """What may be asked for: names of actions, as `imud command DEVICE` lists them, for all devices, or `DEVICE/ACTION`
    for one. All others are refused."""
    max_age_s: Annotated[float, msgspec.Meta(ge=1, le=600)] = 30.0
    """A request that is older by its `issued_utc_ns`, or so far ahead of the gateway's clock, is refused, s."""
    per_minute: Annotated[int, msgspec.Meta(ge=1, le=600)] = 30
    """Requests within a minute; more are refused."""

    def __post_init__(self) -> None:
        """Raise ValueError for what is no name of an action."""
        for entry in self.actions:
            device, slash, action = entry.rpartition("/")
            if not is_name(action) or (slash and not is_name(device)):
                raise ValueError(f"actions: expected names of actions, or DEVICE/ACTION, got {shown(entry)}")

    def allows(self, device: str, action: str) -> bool:
        """Whether a request for it is carried out."""
        return action in self.actions or f"{device}/{action}" in self.actions

    @property
    def max_age_ns(self) -> int:
        """`max_age_s` in nanoseconds."""
        return round(self.max_age_s * NS_PER_S)


class Broker(NamedTuple):
    """A broker, taken from its URL."""

    host: str
    port: int
    tls: bool
    websockets: bool
    path: str
    """Of websockets."""

    @property
    def name(self) -> str:
        """The URL without anything secret."""
        scheme = ("wss" if self.tls else "ws") if self.websockets else ("mqtts" if self.tls else "mqtt")
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{scheme}://{host}:{self.port}{self.path if self.websockets else ''}"


PORTS: Final = {"mqtt": 1883, "mqtts": 8883, "ws": 80, "wss": 443}
"""Schemes of URLs and their usual ports."""


def broker_of(url: str) -> Broker | None:
    """The broker that a URL names; None for a URL that names none. User and password are not taken from it."""
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
    """Settings of the output `mqtt`."""

    enabled: bool = False
    """Whether imud sends to an MQTT broker. Needs the extra `imud[mqtt]`."""
    brokers: Annotated[list[str], msgspec.Meta(min_length=1, max_length=BROKERS_MAX)] = msgspec.field(
        default_factory=lambda: ["mqtt://127.0.0.1:1883"]
    )
    """Brokers in the order in which they are tried, each as `mqtts://HOST:PORT`: `mqtt`, `mqtts` with TLS, `ws` and
    `wss` by websockets. All of one cluster: what one acknowledged is not sent to another."""
    version: Literal["5", "3.1.1"] = "5"
    """Version of MQTT. With 3.1.1 a broker cannot say that it refuses a message, and what it refuses is lost."""
    site: Name = "default"
    """Name of the place, second level of all topics."""
    gateway: Name = ""
    """Name of this gateway, third level; unique on the broker. Empty: the host's name up to the first dot."""
    user: str = ""
    """Name for the broker; empty for none."""
    password_file: str | None = None
    """File that has the password in its first line; null for none. It is read at each connection."""
    ca_file: str | None = None
    """Certificates (PEM) that the broker's is to be signed by; null for those that the system trusts."""
    cert_file: str | None = None
    """Certificate (PEM) of this gateway, for a broker that asks for one; null for none."""
    key_file: str | None = None
    """Its key (PEM, without a passphrase); null where the certificate's file has it."""
    keep_alive_s: Annotated[int, msgspec.Meta(ge=5, le=3600)] = 30
    """A connection that is dead is noticed within twice this time, s."""
    retry_max_s: Annotated[float, msgspec.Meta(ge=1, le=3600)] = 60.0
    """Longest pause between two attempts to connect, s; pauses grow from 4 s and are drawn at random."""
    messages_per_s: Annotated[float, msgspec.Meta(ge=0.1, le=100_000)] | None = None
    """Most messages of streams that are sent in a second, so that a gateway that was away for long does not take the
    whole link when it is back; more than it makes. null for as many as broker and link take."""
    newest_first: bool = False
    """Whether what is new is sent before what waited while there was no connection; streams are not in order then."""
    spool_directory: Annotated[str, msgspec.Meta(min_length=1)] = "/var/lib/imud/mqtt"
    """Where the spool is; imud makes it where it is missing."""
    spool_mb: Annotated[float, msgspec.Meta(ge=1, le=1_000_000)] = 256.0
    """Room for the spool, MB (10⁶ bytes). Where it does not suffice the oldest whole samples become statistics of their
    batch, and when there are none left the oldest messages are dropped."""
    spool_hours: Annotated[float, msgspec.Meta(ge=0.01, le=8760)] = 168.0
    """What waited for longer is dropped, hours."""
    status_s: Annotated[float, msgspec.Meta(ge=1, le=3600)] = 60.0
    """How often the state of devices and of the gateway is sent, s."""
    commands: CommandOptions = CommandOptions()
    """The command channel."""
    home_assistant: bool = False
    """Whether devices whose `status` is sent are announced to Home Assistant, in retained messages below
    `homeassistant/device/`, which the broker must let this gateway write."""
    devices: dict[str, DeviceSending] = msgspec.field(default_factory=lambda: {EVERY: DeviceSending()})
    """What is sent, by the names of devices; `*` stands for all that are not named. The keys of each are under
    `mqtt.devices.NAME`."""

    def __post_init__(self) -> None:
        """Raise ValueError for what is no broker, and for a key without its certificate."""
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
        """What is sent of a device; None for nothing."""
        return self.devices.get(device, self.devices.get(EVERY))

    @property
    def spool_bytes(self) -> int:
        """`spool_mb` in bytes."""
        return round(self.spool_mb * MEGABYTE)

    @property
    def spool_age_ns(self) -> int:
        """`spool_hours` in nanoseconds."""
        return round(self.spool_hours * 3600 * NS_PER_S)
