"""HTTP client for a thread: sends bodies to one URL with POST over a connection that stays open."""

import gzip
from pathlib import PurePath
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import parse_qsl, urlsplit

from imud.host.files import read_regular
from imud.host.network import tls_context
from imud.model.errors import reason_of

if TYPE_CHECKING:
    from http.client import HTTPConnection

TIMEOUT_S: Final = 10.0  # maximum wait for a connection, and for each part of a reply, s
REPLY_BYTES: Final = 4096  # maximum size of the part of a reply that imud reads, bytes
REASON_CHARACTERS: Final = 200  # maximum length of a server's message in logs and status
TOKEN_BYTES: Final = 4096  # maximum size of a token file, bytes
# Status codes that a later attempt can change, although they are codes of client errors (RFC 9110; RFC 6585)
LATER: Final = frozenset((408, 425, 429))
SECRETS: Final = frozenset(("u", "p", "token", "password"))  # query parameters that contain secrets


class PostUrl(NamedTuple):
    host: str
    port: int
    tls: bool
    target: str  # path and query


class PostAccess(NamedTuple):
    """Credentials for a URL."""

    token_file: str | None = None  # file with the value of the header Authorization, or an InfluxDB token
    ca_file: str | None = None  # CA certificates (PEM); None: the certificates that the system trusts


class RequestRejected(Exception):
    """The server rejected a body: the same body will fail again."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(f"the server replied {status}" + f": {reason}" * bool(reason))
        self.status = status


def post_url(text: str) -> PostUrl | None:
    """Return the parts of an `http` or `https` URL; None if it is invalid or contains a user, password or token."""
    try:
        parts = urlsplit(text)
        port, keys = parts.port, {key for key, _ in parse_qsl(parts.query, keep_blank_values=True)}
    except ValueError:
        return None
    is_printable = text.isascii() and text.isprintable() and " " not in text
    if parts.scheme not in ("http", "https") or not parts.hostname or port == 0 or not is_printable:
        return None
    if "@" in parts.netloc or parts.fragment or keys & SECRETS or len(parts.path) < 2:
        return None
    tls = parts.scheme == "https"
    target = parts.path + f"?{parts.query}" * bool(parts.query)
    return PostUrl(parts.hostname, port or (443 if tls else 80), tls, target)


class HttpPost:
    """Connection to a URL. Synchronization: one thread at a time. `post` blocks."""

    def __init__(self, url: PostUrl, access: PostAccess, *, compress: bool = False) -> None:
        self._url, self._access, self._compress = url, access, compress
        self._connection: HTTPConnection | None = None

    def post(self, body: bytes) -> None:
        """Send a body. Return after a reply with the status 2xx. Raises RequestRejected for 4xx, and OSError if a later
        attempt can succeed: without a reply, or with another status."""
        from http.client import HTTPException

        headers = {"Content-Type": "text/plain; charset=utf-8", "User-Agent": "imud"} | self._authorization()
        if self._compress:
            body, headers["Content-Encoding"] = gzip.compress(body, 1), "gzip"
        try:
            connection = self._connection or self._connect()
            self._connection = connection
            connection.request("POST", self._url.target, body, headers)
            reply = connection.getresponse()
            content = reply.read(REPLY_BYTES)
            if not reply.isclosed():  # the rest of a long reply would precede the next reply
                self.close()
        except (OSError, HTTPException) as error:
            self.close()
            raise OSError(_cause(error)) from error
        if 200 <= reply.status < 300:
            return
        reason = _sentence(content)
        if 400 <= reply.status < 500 and reply.status not in LATER:
            raise RequestRejected(reply.status, reason)
        raise OSError(f"the server replied {reply.status}" + f": {reason}" * bool(reason))

    def close(self) -> None:
        """Close the connection. The next `post` opens a new one."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _connect(self) -> "HTTPConnection":
        from http.client import HTTPConnection, HTTPSConnection

        host, port, tls, _ = self._url
        if not tls:
            return HTTPConnection(host, port, timeout=TIMEOUT_S)
        return HTTPSConnection(host, port, timeout=TIMEOUT_S, context=tls_context(self._access.ca_file))

    def _authorization(self) -> dict[str, str]:
        """Return the header Authorization. Reads the file for each request, so that a new token needs no restart."""
        path = self._access.token_file
        if path is None:
            return {}
        try:
            text = read_regular(path, TOKEN_BYTES).partition(b"\n")[0].strip().decode("ascii")
        except OSError as error:
            raise OSError(f"cannot read token_file {path}: {reason_of(error)}") from error
        except UnicodeDecodeError:
            text = ""
        if not text or not text.isprintable():
            raise OSError(f"token_file {PurePath(path)}: expected a token in printable ASCII, got other bytes")
        return {"Authorization": text if " " in text else f"Token {text}"}


def _cause(error: Exception) -> str:
    """Return the reason of a failed request."""
    if not isinstance(error, OSError):
        return f"invalid HTTP reply: {type(error).__name__}"
    # the number of a TLS error is not the number of a system error
    return str(getattr(error, "verify_message", "") or getattr(error, "reason", "") or reason_of(error))


def _sentence(content: bytes) -> str:
    """Return the message of a reply as one printable line."""
    text = "".join(c if c.isprintable() else " " for c in content.decode(errors="replace"))
    return " ".join(text.split())[:REASON_CHARACTERS]
