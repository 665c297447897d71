"""Options of the output `signalk`."""

from typing import Annotated, Final, NamedTuple
from urllib.parse import urlsplit

import msgspec

from imud.contracts.publisher import PublisherType, make_later
from imud.model.host_object import CaFile
from imud.model.options import Options, is_host, shown

WHO: Final = "signalk"  # name of this output
PORTS: Final = {"http": 80, "https": 443}  # supported URL schemes and their default ports
RateHz = Annotated[float, msgspec.Meta(ge=0.01, le=100)]


class ServerAddress(NamedTuple):
    """Address of a Signal K server from its URL."""

    scheme: str
    host: str
    port: int

    @property
    def url(self) -> str:
        """Return the URL without a path."""
        return f"{self.scheme}://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"


def address_of(url: str) -> ServerAddress | None:
    """Return the address of a URL; None if the URL is invalid, or contains a user, a password or a path."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return None
    host = parts.hostname or ""
    has_more = parts.path not in ("", "/") or parts.query or parts.fragment or "@" in parts.netloc
    if parts.scheme not in PORTS or not is_host(host) or has_more or port == 0:
        return None
    return ServerAddress(parts.scheme, host, port or PORTS[parts.scheme])


class SignalKOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the output `signalk`."""

    enabled: bool = False
    """Send to a Signal K server."""
    device: str | None = None
    """Name of the device; null: the only device of the configuration."""
    url: str = "http://127.0.0.1:3000"
    """Server: `http://HOST:PORT`, or `https://HOST:PORT` (TLS)."""
    ca_file: CaFile | None = None
    """CA certificates (PEM) for `https`, or a copy of the server's own certificate; null: the certificates that the
    system trusts."""
    rate_hz: RateHz = 10.0
    """Deltas per second. Variation, temperature and pressure follow at most once per second."""

    def __post_init__(self) -> None:
        """Raise ValueError if the URL is invalid."""
        if address_of(self.url) is None:
            raise ValueError(
                f"url: expected a URL such as http://192.168.1.5:3000 (http or https; no user, no password, no path), "
                f"got {shown(self.url)}"
            )
        if self.ca_file is not None and not self.url.startswith("https:"):
            raise ValueError(f"ca_file: expected a url with https, got {shown(self.url)}")


PUBLISHER = PublisherType(WHO, SignalKOptions, make_later("imud.publishers.signalk.publisher:SignalK"), required=False)
