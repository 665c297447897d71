"""Access control of the web servers: headers Host and Origin, the token, and the cookie of a browser.

- **Host** refuses pages with another name for this address (DNS rebinding). IP addresses and `localhost` are accepted,
  because no other party can serve a page under them. The user configures other names.
- **Origin** refuses requests of other sites in the same browser. Browsers send this header with every POST and
  WebSocket. A program with the token may omit it.
- **The token** is never part of a URL, because logs contain URLs. A browser exchanges it for a cookie that scripts
  cannot read and other sites cannot send (HttpOnly, SameSite=Strict). A program sends it as `Authorization: Bearer`.
"""

import hashlib
import hmac
from collections.abc import Callable, Collection, Mapping
from ipaddress import ip_address
from typing import Final, NamedTuple

from imud.host.files import read_regular_file
from imud.model.errors import BadArgument, reason_of

TOKEN_CHARACTERS_MIN: Final = 20
"""Minimum length of the token: 20 letters and digits are more than 100 bits, too many to guess."""
TOKEN_BYTES_MAX: Final = 1024
COOKIE: Final = "imud-session"
SESSION_S: Final = 12 * 3600
"""Lifetime of a cookie, s: one working day."""
BEARER: Final = "Bearer "


class WebRights(NamedTuple):
    """Permissions of one request."""

    read: bool
    control: bool
    by_cookie: bool = False  # whether the permission is from the cookie, which a browser sends automatically


class WebGuard:
    """Access rules of one server. `now_s` is the time since 1970-01-01 UTC."""

    def __init__(
        self, token: bytes, now_s: Callable[[], float], *, reading_needs_token: bool, names: Collection[str] = ()
    ) -> None:
        """No request may control if `token` is empty. `names` are additional names of this host."""
        self._token = token
        self._now_s = now_s
        self._reading_needs_token = reading_needs_token
        self._names = {"localhost", *(name.lower() for name in names)}

    @property
    def has_token(self) -> bool:
        """Whether a login is possible."""
        return bool(self._token)

    def host_problem(self, host: str | None) -> str:
        """Return the reason to refuse the header Host; empty to accept it."""
        if is_own_host(host or "", self._names):
            return ""
        return f"expected an IP address or one of {', '.join(sorted(self._names))} as the host; see imud web --host"

    def origin_problem(self, origin: str | None, host: str | None, *, with_token: bool) -> str:
        """Return the reason to refuse the header Origin of a POST or WebSocket; empty to accept it."""
        if origin is None:
            return "" if with_token else "expected the header Origin, or the token in the header Authorization"
        scheme, _, place = origin.partition("://")
        if scheme in ("http", "https") and place and place.lower() == (host or "").lower():
            return ""
        return "expected a request of a page of this server, got a request of another site"

    def rights(self, authorization: str | None, cookie: str | None) -> WebRights:
        token = self.bearer(authorization)
        by_header = token is not None and self.is_token(token)
        by_cookie = not by_header and self.is_session(cookie or "")
        return WebRights(not self._reading_needs_token or by_header or by_cookie, by_header or by_cookie, by_cookie)

    def bearer(self, authorization: str | None) -> str | None:
        """Return the token in the header Authorization; None if it contains no token, or the server has no token."""
        if not self._token or authorization is None or not authorization.startswith(BEARER):
            return None
        return authorization[len(BEARER) :]

    def is_token(self, words: str) -> bool:
        """Return whether `words` is the token, in constant time."""
        return bool(self._token) and hmac.compare_digest(
            _digest(words.encode("utf-8", "replace")), _digest(self._token)
        )

    def new_session(self) -> str:
        """Return a new cookie: its end and a signature. It stays valid after a restart of the server."""
        end = str(int(self._now_s()) + SESSION_S)
        return f"{end}.{self._signature(end)}"

    def is_session(self, cookie: str) -> bool:
        """Return whether a cookie is valid and has not expired."""
        return self._has_not_expired(cookie) and self._is_signed(cookie)

    def is_forged(self, cookie: str) -> bool:
        """Return whether a cookie has a wrong signature and has not expired: a guess, or a cookie for another token."""
        return self._has_not_expired(cookie) and not self._is_signed(cookie)

    def _has_not_expired(self, cookie: str) -> bool:
        end = cookie.partition(".")[0]
        return bool(self._token) and end.isascii() and end.isdecimal() and len(end) <= 12 and self._now_s() < int(end)

    def _is_signed(self, cookie: str) -> bool:
        end, _, signature = cookie.partition(".")
        return hmac.compare_digest(signature.encode("utf-8", "replace"), self._signature(end).encode())

    def _signature(self, end: str) -> str:
        return hmac.new(self._token, f"imud web session until {end}".encode(), hashlib.sha256).hexdigest()


def host_name(host: str) -> str:
    """Return the name in a header Host, without the port and the brackets of an IPv6 address."""
    host = host.lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    name, _, _port = host.partition(":")
    return name.removesuffix(".")


def is_own_host(host: str, names: Collection[str]) -> bool:
    """Return whether a header Host is an IP address or a name in `names`."""
    name = host_name(host)
    return name in names or is_address(name)


def is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def is_loopback(address: str) -> bool:
    """Return whether only this host can connect to an address."""
    return address == "localhost" or (is_address(address) and ip_address(address).is_loopback)


def read_token(path: str) -> bytes:
    """Return the token in the first line of a file. Raises BadArgument if it is not readable or too short."""
    try:
        token = read_regular_file(path, TOKEN_BYTES_MAX).split(b"\n", 1)[0].strip()
    except OSError as error:
        raise BadArgument(f"--token-file {path}: {reason_of(error)}") from error
    if len(token) < TOKEN_CHARACTERS_MIN:
        raise BadArgument(
            f"--token-file {path}: expected a line of at least {TOKEN_CHARACTERS_MIN} characters, got {len(token)}; "
            "make one with: openssl rand -hex 20"
        )
    return token


def safety_headers() -> Mapping[str, str]:
    """Return the headers of every reply: only scripts of this server, no embedding in a frame, no Referer header."""
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
    # equal lengths: the time of the comparison must not depend on the length of the token
    return hashlib.sha256(words).digest()
