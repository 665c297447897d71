"""Whose pages may read from `imud foxglove`: the headers Host and Origin of a request for a WebSocket.

- **Host** has to be an IP address, `localhost`, or a name that was given: no page of another site is served under
  these, so a name that is pointed here (DNS rebinding) is of no use.
- **Origin** is what a browser sends with every WebSocket: the site of the page that opens it. A program sends none; it
  needs no browser to read. Viewers that are programs made of web pages (Electron) send `file://`. `null`, which a
  browser sends for sandboxed pages of any site, is refused.
"""

from collections.abc import Collection, Iterable
from typing import Final
from urllib.parse import urlsplit

from imud.errors import BadArgument
from imud.web.guard import is_loopback, is_own_host

VIEWERS: Final = ("file://", "https://app.foxglove.dev")
"""Foxglove and Lichtblick as programs, and Foxglove in the browser."""
SCHEMES: Final = ("http", "https")


class ViewerOrigins:
    """The rule of one server."""

    def __init__(self, *, names: Iterable[str] = (), origins: Iterable[str] = ()) -> None:
        """`names` are further names of this host, `origins` further sites. Raises BadArgument for what is no origin."""
        self._names: Collection[str] = {"localhost", *(name.lower() for name in names)}
        self._origins = {*VIEWERS, *(_checked(origin) for origin in origins)}

    def problem(self, host: str, origin: str) -> str:
        """Return why a request is refused; empty where it may pass. `origin` is empty where there is none."""
        if not is_own_host(host, self._names):
            return (
                f"expected an IP address or one of {', '.join(sorted(self._names))} as the host, got {host[:80]!r}; "
                "another name of this host is given with --host NAME"
            )
        if not origin or origin.lower() in self._origins or _is_of_this_machine(origin):
            return ""
        return f"pages of {origin[:80]!r} may not read; they may with --allow-origin {origin[:80]}"


def _is_of_this_machine(origin: str) -> bool:
    """Decide whether a page is served by this machine: who serves it could read without a browser."""
    parts = _parts(origin)
    return parts is not None and is_loopback(parts[1])


def _checked(origin: str) -> str:
    if _parts(origin) is None:
        raise BadArgument(f"--allow-origin: expected a site as https://viewer.example:8080, got {origin!r}")
    return origin.lower()


def _parts(origin: str) -> tuple[str, str] | None:
    """Split an origin into scheme and host name; None for what is none."""
    origin = origin.lower()
    try:
        parts = urlsplit(origin)
        place = f"{parts.scheme}://{parts.netloc}"
        _ = parts.port
    except ValueError:
        return None
    is_origin = parts.scheme in SCHEMES and bool(parts.hostname) and "@" not in parts.netloc
    return (parts.scheme, parts.hostname or "") if is_origin and place == origin else None
