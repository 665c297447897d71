"""Who may ask what: the header Host, the header Origin, the token, the cookie that a browser gets for it.

- **Host** keeps out pages of other names that resolve to this address (DNS rebinding): a page cannot be served under an
  IP address or `localhost` by another party, so these are good; other names have to be given.
- **Origin** keeps out requests that pages of other sites send from the same browser. Browsers send it with every POST
  and every WebSocket. A program that has the token may leave it out.
- **The token** is never in a URL, which logs keep. A browser exchanges it for a cookie that scripts cannot read and
  that no other site can send (HttpOnly, SameSite=Strict); a program sends it as `Authorization: Bearer`.
"""

import hashlib
import hmac
from collections.abc import Callable, Collection, Mapping
from ipaddress import ip_address
from pathlib import Path
from typing import Final, NamedTuple

from imud.model.errors import BadArgument, reason_of

TOKEN_CHARACTERS_MIN: Final = 20
"""Of letters and digits these are more than 100 bits: nobody guesses them, however fast they ask."""
TOKEN_BYTES_MAX: Final = 1024
COOKIE: Final = "imud-session"
SESSION_S: Final = 12 * 3600
"""A browser asks for the token again after a working day."""
BEARER: Final = "Bearer "


class WebRights(NamedTuple):
    """What one request may."""

    read: bool
    control: bool
    by_cookie: bool = False
    """Whether it is by the cookie, which a browser sends by itself."""


class WebGuard:
    """The rules of one server. `now_s` is the time since 1970-01-01 UTC."""

    def __init__(
        self, token: bytes, now_s: Callable[[], float], *, reading_needs_token: bool, names: Collection[str] = ()
    ) -> None:
        """`token` is empty where there is none: then nobody controls anything. `names`: further names of this host."""
        self._token = token
        self._now_s = now_s
        self._reading_needs_token = reading_needs_token
        self._names = {"localhost", *(name.lower() for name in names)}

    @property
    def has_token(self) -> bool:
        """Whether there is anything to log in with."""
        return bool(self._token)

    def host_problem(self, host: str | None) -> str:
        """Return why the header Host is not accepted; empty where it is."""
        if is_own_host(host or "", self._names):
            return ""
        return f"expected an IP address or one of {', '.join(sorted(self._names))} as the host; see imud web --host"

    def origin_problem(self, origin: str | None, host: str | None, *, with_token: bool) -> str:
        """Return why the header Origin of a POST or a WebSocket is not accepted; empty where it is."""
        if origin is None:
            return "" if with_token else "expected the header Origin, or the token in the header Authorization"
        scheme, _, place = origin.partition("://")
        if scheme in ("http", "https") and place and place.lower() == (host or "").lower():
            return ""
        return "expected a request of this server's own page, got one of another site"

    def rights(self, authorization: str | None, cookie: str | None) -> WebRights:
        """Return what a request with these headers may."""
        by_header = (authorization or "").startswith(BEARER) and self.is_token((authorization or "")[len(BEARER) :])
        by_cookie = not by_header and self.is_session(cookie or "")
        return WebRights(not self._reading_needs_token or by_header or by_cookie, by_header or by_cookie, by_cookie)

    def is_token(self, words: str) -> bool:
        """Compare with the token, in a time that does not depend on where they differ."""
        return bool(self._token) and hmac.compare_digest(
            _digest(words.encode("utf-8", "replace")), _digest(self._token)
        )

    def new_session(self) -> str:
        """Make the value of a cookie: its end and a signature. It stays good when the server is restarted."""
        end = str(int(self._now_s()) + SESSION_S)
        return f"{end}.{self._signature(end)}"

    def is_session(self, cookie: str) -> bool:
        """Decide whether a cookie is one that was given and has not ended."""
        end, _, signature = cookie.partition(".")
        if not self._token or not (end.isascii() and end.isdecimal() and len(end) <= 12):
            return False
        known = hmac.compare_digest(signature.encode("utf-8", "replace"), self._signature(end).encode())
        return known and self._now_s() < int(end)

    def _signature(self, end: str) -> str:
        return hmac.new(self._token, f"imud web session until {end}".encode(), hashlib.sha256).hexdigest()


def host_name(host: str) -> str:
    """Take the name out of a header Host: without its port, without the brackets of an IPv6 address."""
    host = host.lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    name, _, _port = host.partition(":")
    return name.removesuffix(".")


def is_own_host(host: str, names: Collection[str]) -> bool:
    """Decide whether a header Host is an IP address or a known name: no page of another site is served under it."""
    name = host_name(host)
    return name in names or is_address(name)


def is_address(name: str) -> bool:
    """Decide whether a name is an IP address."""
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def is_loopback(address: str) -> bool:
    """Decide whether only this machine reaches an address that is listened on."""
    return address == "localhost" or (is_address(address) and ip_address(address).is_loopback)


def read_token(path: str) -> bytes:
    """Read a token from a file: its first line. Raises BadArgument naming what is wrong with it."""
    try:
        with Path(path).open("rb") as file:
            token = file.read(TOKEN_BYTES_MAX).split(b"\n", 1)[0].strip()
    except OSError as error:
        raise BadArgument(f"--token-file {path}: {reason_of(error)}") from error
    if len(token) < TOKEN_CHARACTERS_MIN:
        raise BadArgument(
            f"--token-file {path}: expected a line of at least {TOKEN_CHARACTERS_MIN} characters, got {len(token)}; "
            "make one with: openssl rand -hex 20"
        )
    return token


def safety_headers() -> Mapping[str, str]:
    """Headers of every answer: the page runs its own scripts only, is in no frame, tells no other site of itself."""
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return {
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "X-Frame-Options": "DENY",
    }


def _digest(words: bytes) -> bytes:
    """Bytes of the same length for every text, so that not even the length can be measured."""
    return hashlib.sha256(words).digest()
