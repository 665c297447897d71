"""HTTP client for a thread: sends bodies to one URL with POST over a connection that stays open."""

import gzip
from collections.abc import Callable
from pathlib import PurePath
from typing import Final, NamedTuple
from urllib.parse import parse_qsl, urlsplit

from imud.host.files import read_regular_file
from imud.host.http_reply import HttpReply, IncompleteReply, InvalidReply
from imud.host.network import tls_context
from imud.host.timed_connection import TimedConnection
from imud.model.errors import reason_of

# Maximum time of a request, from the name resolution to the complete reply, s: 1 MB at 0.5 Mbit/s take 16 s
REQUEST_S: Final = 20.0
# Maximum length of the content of a reply that imud reads, bytes. The content is only for the message of an error.
CONTENT_BYTES: Final = 4096
REASON_CHARACTERS: Final = 200  # maximum length of a server's message in logs and status
TOKEN_BYTES: Final = 4096  # maximum size of a token file, bytes
TOO_LARGE: Final = 413  # status code "Content Too Large" (RFC 9110, section 15.5.14)
# Status codes that the values in a body cause. A person can repair the causes of all other codes: access rights (401,
# 403), a missing database (404), load (429). A later attempt with the same body can then succeed.
OF_VALUES: Final = frozenset((400, 422))
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
    """The server rejected the values in a body: the same body will fail again."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(f"the server replied {status}" + f": {reason}" * bool(reason))
        self.status = status


class RequestTooLarge(RequestRejected):
    """The server rejected the size of a body: a smaller body can succeed."""


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
    """Connection to a URL. Synchronization: one thread at a time; any thread may call `stop`. `post` blocks."""

    def __init__(self, url: PostUrl, access: PostAccess, now_ns: Callable[[], int], *, compress: bool = False) -> None:
        """`now_ns` returns CLOCK_MONOTONIC, ns."""
        self._url, self._access, self._compress = url, access, compress
        self._connection = TimedConnection(now_ns)

    def post(self, body: bytes) -> None:
        """Send a body. Return after a reply with the status 2xx. Raises RequestTooLarge or RequestRejected for the size
        and the values of the body, and OSError if a later attempt can succeed: without a complete reply within
        REQUEST_S, or with another status."""
        if self._compress:
            body = gzip.compress(body, 1)
        request = self._head(len(body)) + body
        try:
            reply = self._exchange(request)
        except (OSError, InvalidReply) as error:
            self.close()
            raise OSError(_cause(error)) from error
        if not reply.keeps_connection:
            self.close()

        status, reason = reply.status, _sentence(bytes(reply.content))
        if 200 <= status < 300:
            return
        if status == TOO_LARGE:
            raise RequestTooLarge(status, reason)
        if status in OF_VALUES:
            raise RequestRejected(status, reason)
        raise OSError(f"the server replied {status}" + f": {reason}" * bool(reason))

    def stop(self) -> None:
        """End the present request and all later requests with OSError. From any thread."""
        self._connection.stop()

    def close(self) -> None:
        """Close the connection. The next `post` opens a new one."""
        self._connection.close()

    def _exchange(self, request: bytes) -> HttpReply:
        connection = self._connection
        reply = HttpReply(CONTENT_BYTES, truncates_content=True)
        connection.start(REQUEST_S)
        # input before a request: the server closed the connection, or sent bytes that imud did not request
        if connection.is_open and connection.has_input():
            connection.close()
        if not connection.is_open:
            self._open()

        rest = memoryview(request)
        while not reply.is_complete:
            if rest and not reply.status:
                rest = rest[connection.send(rest) :]
            data = connection.receive()
            if data:
                reply.feed(data)
            else:
                reply.end()
        reply.keeps_connection = reply.keeps_connection and not rest
        return reply

    def _open(self) -> None:
        host, port, tls, _ = self._url
        if not tls:
            self._connection.open(host, port)
            return
        self._connection.open(host, port, tls_context(self._access.ca_file))

    def _head(self, body_bytes: int) -> bytes:
        """Return request line and headers."""
        host, port, tls, target = self._url
        host_header = f"[{host}]" if ":" in host else host
        if port != (443 if tls else 80):
            host_header += f":{port}"
        lines = [
            f"POST {target} HTTP/1.1",
            f"Host: {host_header}",
            "User-Agent: imud",
            "Accept-Encoding: identity",
            "Content-Type: text/plain; charset=utf-8",
            f"Content-Length: {body_bytes}",
        ]
        if self._compress:
            lines.append("Content-Encoding: gzip")
        lines += [f"{name}: {value}" for name, value in self._authorization().items()]
        return "\r\n".join([*lines, "\r\n"]).encode("ascii")

    def _authorization(self) -> dict[str, str]:
        """Return the header Authorization. Reads the file for each request, so that a new token needs no restart."""
        path = self._access.token_file
        if path is None:
            return {}
        try:
            text = read_regular_file(path, TOKEN_BYTES).partition(b"\n")[0].strip().decode("ascii")
        except OSError as error:
            raise OSError(f"cannot read token_file {path}: {reason_of(error)}") from error
        except UnicodeDecodeError:
            text = ""
        if not text or not text.isprintable():
            raise OSError(f"token_file {PurePath(path)}: expected a token in printable ASCII, got other bytes")
        return {"Authorization": text if " " in text else f"Token {text}"}


def _cause(error: Exception) -> str:
    """Return the reason of a failed request."""
    if isinstance(error, IncompleteReply):
        return str(error)
    if isinstance(error, InvalidReply):
        return f"invalid HTTP reply: {error}"
    # the number of a TLS error is not the number of a system error
    return str(getattr(error, "verify_message", "") or getattr(error, "reason", "") or reason_of(error))


def _sentence(content: bytes) -> str:
    """Return the message of a reply as one printable line."""
    text = "".join(c if c.isprintable() else " " for c in content.decode(errors="replace"))
    return " ".join(text.split())[:REASON_CHARACTERS]


def halves_of(lines: bytes) -> tuple[bytes, bytes]:
    """Return two parts of complete lines with about the same size. The second part is empty for a single line."""
    middle = lines.find(b"\n", len(lines) // 2) + 1
    if not 0 < middle < len(lines):
        middle = lines.rfind(b"\n", 0, len(lines) // 2) + 1
    if not middle:
        return lines, b""
    return lines[:middle], lines[middle:]
