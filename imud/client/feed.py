"""Thread that reads status, samples and events of the daemon for a view. It connects again after a restart.

    feed = Feed("/run/imud/imud.sock", Wish(rate_hz=4.0))
    feed.start(on_news)

`imud top` and `imud web` use it. `Feed.want` changes the wish at any time. With the wish None, the feed disconnects.
"""

from collections.abc import Callable
from threading import Condition, Thread
from time import monotonic, monotonic_ns, time_ns
from typing import Final, NamedTuple

from imud.client.connection import Client, EventStream, Hello, Watch, decoded, event_of, params_of
from imud.contracts.status import DeviceStatus
from imud.model.errors import ImudError
from imud.model.event import Event
from imud.model.sample import Sample

STATUS_S: Final = 1.0
"""Time between two status requests, s, for up to STATUS_DEVICES devices."""
STATUS_DEVICES: Final = 50
"""With more devices, the time between two requests grows: each device costs the daemon 50 µs."""
RETRY_S: Final = 1.0
SAME_CLOCK_NS: Final = 2_000_000_000
"""Maximum difference of one clock that the daemon and the feed read at different times, ns. CLOCK_MONOTONIC of another
host differs by the time between the boots."""
SAMPLES_MAX: Final = 4096
"""Maximum number of samples in one `News`. More samples stay in the socket, until the daemon drops samples."""


class Wish(NamedTuple):
    """The data that a view reads in addition to status and events."""

    devices: tuple[str, ...] | None = None
    """Devices to watch; None for all. The feed ignores devices that the daemon does not know."""
    rate_hz: float | None = None  # maximum number of samples per second and device; None for every sample
    news_s: float = 0.25  # time between two `News`, s
    newest: bool = False  # whether to read the newest sample of every device, for any `devices`
    newest_s: float = STATUS_S  # time between two reads of the newest samples, s
    convention: str | None = None  # convention of the watched samples; None for the convention of the configuration


class News(NamedTuple):
    """Data received since the previous `News`."""

    problem: str = ""  # reason for the missing connection; empty if the feed is connected
    statuses: tuple[DeviceStatus, ...] | None = None
    """State of each device; None if the feed did not request it this time."""
    clients: int = 0  # number of clients of the daemon, if `statuses` is not None
    now_ns: int = 0  # CLOCK_MONOTONIC of the daemon's host
    ahead_ns: int = 0  # CLOCK_MONOTONIC of the daemon's host minus that clock of this host; 0 on the same host
    samples: tuple[Sample, ...] = ()
    events: tuple[Event, ...] = ()
    newest: tuple[Sample, ...] | None = None
    """Newest sample of each device; None if the feed did not request it this time."""
    newest_ns: int = 0  # time of the request for `newest`, CLOCK_MONOTONIC of the daemon's host
    hello: Hello | None = None  # greeting of the daemon, in the first `News` of a connection
    dropped: int = 0  # number of samples that the daemon dropped because this feed read too slowly


class Feed:
    """Reader of the daemon at `path`. Any thread may call its methods."""

    def __init__(self, path: str, wanted: Wish | None) -> None:
        self._path = path
        self._on_news: Callable[[News], None] = _ignore
        self._wanted = wanted
        self._changed = Condition()
        self._stopped = False
        self._ahead_ns = 0
        self._thread = Thread(target=self._run, name="feed", daemon=True)

    def start(self, on_news: Callable[[News], None]) -> None:
        """Start the thread, which calls `on_news`."""
        self._on_news = on_news
        self._thread.start()

    def close(self) -> None:
        """Stop the thread; wait up to 2 s. A second call does nothing."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(2 * STATUS_S)

    def want(self, wanted: Wish | None) -> None:
        """Change the wish; None to disconnect."""
        with self._changed:
            self._wanted = wanted
            self._changed.notify_all()

    def _run(self) -> None:
        while self._wait_for_wish():
            try:
                with Client(self._path) as client:
                    self._read(client)
            except (ImudError, TimeoutError) as error:
                self._on_news(News(str(error), now_ns=monotonic_ns() + self._ahead_ns, ahead_ns=self._ahead_ns))
                with self._changed:
                    self._changed.wait_for(lambda: self._stopped, RETRY_S)

    def _wait_for_wish(self) -> bool:
        """Wait until the wish is not None. Return False after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._wanted is not None)
            return not self._stopped

    def _read(self, client: Client) -> None:
        """Read until `close`, or until the wish is None. Raises ImudError if the connection is lost."""
        client.events()
        reading = _Reading(client)
        hello: Hello | None = client.hello
        while not self._stopped and (wanted := self._wanted) is not None:
            news = reading.next(wanted)
            self._ahead_ns = news.ahead_ns
            self._on_news(news._replace(hello=hello))
            hello = None


def _ignore(_news: News) -> None:
    """Ignore the news: `start` sets the receiver."""


def clock_ahead_ns(daemon_now_ns: int) -> int:
    """Return CLOCK_MONOTONIC of the daemon's host, from a reply just received, minus that clock of this host.

    Return 0 on the same host. The hosts differ if SSH forwards the socket.
    """
    ahead_ns = daemon_now_ns - monotonic_ns()
    return ahead_ns if abs(ahead_ns) > SAME_CLOCK_NS else 0


def utc_offset_ns(ahead_ns: int) -> int:
    """Return UTC minus CLOCK_MONOTONIC of the daemon, with CLOCK_REALTIME of this host, ns."""
    return time_ns() - monotonic_ns() - ahead_ns


class _Reading:
    """One connection: times of the next requests, and the watched devices."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._status_due_s = self._newest_due_s = 0.0
        self._known: frozenset[str] = frozenset()
        self._watched: tuple[tuple[str, ...] | None, float | None, float, str | None] | None = None
        self._watch: Watch | None = None
        self._dropped = 0
        self._ahead_ns = 0
        self._first_event: Event | None = None  # event that arrived while the feed watched no device

    def next(self, wanted: Wish) -> News:
        """Send due requests, then collect samples and events for `wanted.news_s`."""
        news = self._requested(wanted)
        self._follow(wanted)
        samples = self._samples(wanted.news_s)
        events = self._events()
        dropped, self._dropped = self._dropped, 0
        now_ns = monotonic_ns() + self._ahead_ns
        return news._replace(samples=samples, events=events, dropped=dropped, now_ns=now_ns, ahead_ns=self._ahead_ns)

    def _requested(self, wanted: Wish) -> News:
        news = News()
        now_s = monotonic()
        if now_s >= self._status_due_s:
            reply = self._client.status()
            self._ahead_ns = clock_ahead_ns(reply["now_ns"])
            statuses = decoded(reply["devices"], tuple[DeviceStatus, ...])
            self._known = frozenset(status.name for status in statuses)
            self._status_due_s = now_s + _pause_s(STATUS_S, len(statuses))
            news = News(statuses=statuses, clients=len(reply["socket"]["clients"]))
        if wanted.newest and now_s >= self._newest_due_s:
            news = news._replace(newest=tuple(self._client.poll()), newest_ns=monotonic_ns() + self._ahead_ns)
            self._newest_due_s = now_s + _pause_s(wanted.newest_s, len(self._known))
        return news

    def _follow(self, wanted: Wish) -> None:
        """Watch the known devices of the wish."""
        devices = None if wanted.devices is None else tuple(name for name in wanted.devices if name in self._known)
        chosen = (devices, wanted.rate_hz, wanted.news_s, wanted.convention)
        if chosen == self._watched:
            return
        if devices == ():
            if self._watch is not None:
                self._client.unwatch()
                self._watch = None
        else:
            # without a rate, a hold of `news_s` saves CPU time on both sides: the daemon sends several samples together
            latency_ms = None if wanted.rate_hz is not None else wanted.news_s * 1e3
            self._watch = self._client.watch(
                devices, rate_hz=wanted.rate_hz, timeout_s=wanted.news_s, latency_ms=latency_ms,
                convention=wanted.convention,
            )  # fmt: skip
            self._watch.on_dropped = self._note_dropped
        self._watched = chosen

    def _note_dropped(self, _device: str, count: int) -> None:
        self._dropped += count

    def _samples(self, limit_s: float) -> tuple[Sample, ...]:
        """Return the samples that arrive in this time."""
        found: list[Sample] = []
        end_s = monotonic() + limit_s
        try:
            if self._watch is None:
                message = self._client.next_message(EventStream.NAMES, limit_s)
                self._first_event = event_of(params_of(message)) if isinstance(message, dict) else None
            else:
                while monotonic() < end_s and len(found) < SAMPLES_MAX:
                    found.append(next(self._watch))
        except TimeoutError:
            pass
        return tuple(found)

    def _events(self) -> tuple[Event, ...]:
        """Return the events that arrived in the meantime."""
        found: list[Event] = []
        if self._first_event is not None:
            found.append(self._first_event)
            self._first_event = None
        while isinstance(message := self._client.kept_message(EventStream.NAMES), dict):
            found.append(event_of(params_of(message)))
        return tuple(found)


def _pause_s(least_s: float, devices: int) -> float:
    return least_s * max(devices / STATUS_DEVICES, 1)
