"""Options of the output `influx`."""

import os
from collections.abc import Mapping
from contextlib import suppress
from typing import Annotated, Final
from urllib.parse import urlsplit

import msgspec

from imud.contracts.driver import Driver
from imud.contracts.publisher import PublisherType, make_later
from imud.host.http_post import post_url
from imud.model.host_object import CaFile, OutputUrl, SecretFile
from imud.model.options import Options, is_ip_address, shown

MEGABYTE: Final = 1_000_000
DESTINATIONS_MAX: Final = 8  # each destination has a thread and a queue
LINES_MAX: Final = 5000  # maximum number of lines in a request, as InfluxDB recommends
_TAG_WORDS: Final = "up to 64 letters, digits, '_', '.' or '-'"
Tag = Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9_.-]{0,64}$", extra={"words": _TAG_WORDS})]


def socket_address(url: str, scheme: str) -> tuple[str, int] | None:
    """Return IP address and port of `udp://127.0.0.1:8089`; None if the URL is invalid."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    if parts.scheme != scheme or not host or not port or "@" in parts.netloc or not is_ip_address(host):
        return None
    return None if parts.path or parts.query or parts.fragment else (host, port)


def file_path(url: str) -> str | None:
    """Return the path of `file:///var/lib/imud/influx.lp`; None if the URL is invalid."""
    path = url.removeprefix("file://")
    return path if path != url and path.startswith("/") and not path.endswith("/") and path.isprintable() else None


def _is_destination(url: str) -> bool:
    return bool(file_path(url) or socket_address(url, "udp") or socket_address(url, "tcp") or post_url(url))


class DestinationOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of one destination."""

    token_file: SecretFile | None = None
    """HTTP: file with an InfluxDB token, or with a value of the header Authorization such as `Bearer TOKEN`, in its
    first line; null: none."""
    ca_file: CaFile | None = None
    """HTTPS: CA certificates (PEM) of the server; null: the certificates that the system trusts."""
    gzip: bool = False
    """HTTP: compress requests. VictoriaMetrics, InfluxDB and Telegraf accept it."""
    file_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 100.0
    """File: maximum size, MB (10⁶ bytes). Then imud renames the file to `NAME.1`."""
    files: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 10
    """File: maximum number of files. imud removes the oldest."""


class InfluxOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the output `influx`."""

    enabled: bool = False
    """Send line protocol."""
    to: dict[OutputUrl, DestinationOptions] = msgspec.field(default_factory=dict)
    """Destinations by URL: `file:///PATH`, `udp://ADDRESS:PORT`, `tcp://ADDRESS:PORT`, or the write URL of a server
    (`http`, `https`)."""
    devices: list[str] | None = None
    """Names of the devices; null: all devices."""
    rate_hz: Annotated[float, msgspec.Meta(ge=0.001, le=10_000)] | None = 10.0
    """Samples per second of each device; null: each sample."""
    site: Tag = ""
    """Tag `site` of all lines; empty: no tag."""
    gateway: Tag = ""
    """Tag `gateway` of all lines; empty: the host name up to the first dot."""
    batch_s: Annotated[float, msgspec.Meta(ge=0.1, le=3600)] = 1.0
    """Maximum time that a line waits for further lines of its request, s."""
    ledger_s: Annotated[float, msgspec.Meta(ge=1, le=3600)] = 10.0
    """Interval of the lines with the ledger of each device, s."""
    queue_mb: Annotated[float, msgspec.Meta(ge=1, le=10_000)] = 16.0
    """Maximum size of the lines in memory for each destination, MB (10⁶ bytes). imud drops the oldest lines
    above it."""

    def __post_init__(self) -> None:
        """Raise ValueError if a URL or a combination of keys is invalid."""
        if self.enabled and not self.to:
            raise ValueError("expected at least one destination in the key to, such as udp://127.0.0.1:8089, got none")
        if len(self.to) > DESTINATIONS_MAX:
            raise ValueError(f"to: expected at most {DESTINATIONS_MAX} destinations, got {len(self.to)}")
        for url, one in self.to.items():
            if not _is_destination(url):
                raise ValueError(
                    "to: expected a URL such as file:///var/lib/imud/influx.lp, udp://127.0.0.1:8089, "
                    "tcp://127.0.0.1:8094 or http://127.0.0.1:8086/write?db=imud (an IP address for udp and tcp; no "
                    f"user, password or token), got {shown(url)}"
                )
            if "precision=" in url and not url.endswith("precision=ns") and "precision=ns&" not in url:
                raise ValueError(f"to: expected precision=ns, got {shown(url)}")
            if (one.token_file or one.ca_file or one.gzip) and post_url(url) is None:
                raise ValueError(
                    f"to: expected an http or https URL for token_file, ca_file and gzip, got {shown(url)}"
                )


def check_files(options: InfluxOptions, _drivers: Mapping[str, Driver]) -> Mapping[tuple[str, ...], str]:
    """Return the error if two destinations would write to the same file, by the path of the key."""
    urls: dict[tuple[object, ...], str] = {}  # first URL of each file
    for url, destination in options.to.items():
        path = file_path(url)
        if path is None:
            continue
        rotated = [f"{path}.{number}" for number in range(1, destination.files)]
        identities = {identity for name in (path, *rotated) for identity in _identities_of(name)}
        other_url = next((urls[identity] for identity in identities if identity in urls), None)
        if other_url is not None:
            problem = f"expected a file of its own for each destination, got {shown(other_url)} and {shown(url)}"
            return {("to",): f"{problem}, which write to the same file"}
        urls |= dict.fromkeys(identities, url)
    return {}


def _identities_of(path: str) -> list[tuple[object, ...]]:
    """Return the keys that are equal for two names of one file: through links, `.` and `..`, and hard links."""
    identities: list[tuple[object, ...]] = [("path", os.path.realpath(path))]
    with suppress(OSError):
        status = os.stat(path)
        identities.append(("inode", status.st_dev, status.st_ino))
    return identities


PUBLISHER = PublisherType(
    "influx",
    InfluxOptions,
    make_later("imud.publishers.influx.publisher:InfluxOutput"),
    required=False,
    check=check_files,
)
