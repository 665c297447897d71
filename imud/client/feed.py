"""A thread that reads the daemon for a view: its status, samples and events, connected again after a restart.

    feed = Feed("/run/imud/imud.sock", on_news, Wish(rate_hz=4.0))
    feed.start()

`imud top` and `imud web` are two of them. What is wanted can be changed at any time, also to nothing: then there is no
connection to the daemon.
"""

from collections.abc import Callable
from threading import Condition, Thread
from time import monotonic, monotonic_ns, time_ns
from typing import Final, NamedTuple

import msgspec

from imud.client.connection import Client, EventStream, Hello, Watch, event_of, params_of
from imud.contracts.status import DeviceStatus
from imud.model.errors import ImudError
from imud.model.event import Event
from imud.model.sample import Sample

STATUS_S: Final = 1.0
"""Time between two looks at the status, for few devices."""
STATUS_DEVICES: Final = 50
"""With more devices the status is asked for less often: each costs the daemon some 50 µs."""
RETRY_S: Final = 1.0
SAME_CLOCK_NS: Final = 2_000_000_000
"""CLOCK_MONOTONIC begins with the start of a machine: clocks that are this near are taken for one, read at different
times, since an answer takes its time on a busy machine."""
SAMPLES_MAX: Final = 4096
"""Of one piece of news; what comes beyond waits in the socket, and the daemon counts what does not fit there."""


class Wish(NamedTuple):
    """What a view reads in addition to status and events."""

    devices: tuple[str, ...] | None = None
    """Devices whose samples are wanted, as far as the daemon has them; None for all."""
    rate_hz: float | None = None
    """At most so many samples a second of each; None for every sample."""
    news_s: float = 0.25
    """Time between two pieces of news."""
    newest: bool = False
    """Whether the newest sample of every device is wanted, whatever `devices` says."""
    newest_s: float = STATUS_S
    """Time between two looks at these."""


class News(NamedTuple):
    """What happened since the news before."""

    problem: str = ""
    """Why there is no daemon now; empty while there is one."""
    statuses: tuple[DeviceStatus, ...] | None = None
    """None where it was not asked for."""
    clients: int = 0
    """Of the daemon, with `statuses`."""
    now_ns: int = 0
    """CLOCK_MONOTONIC of the daemon's machine."""
    ahead_ns: int = 0
    """That clock minus the one of this machine; 0 where it is the same."""
    samples: tuple[Sample, ...] = ()
    events: tuple[Event, ...] = ()
    newest: tuple[Sample, ...] | None = None
    """The newest sample of each device that has one; None where it was not asked for."""
    newest_ns: int = 0
    """CLOCK_MONOTONIC when they were asked for."""
    hello: Hello | None = None
    """The greeting of the daemon, in the first news of a connection."""
    dropped: int = 0
    """Samples that the daemon dropped because this feed read too slowly."""


class Feed:
    """Reader of the daemon at `path`. Synchronization: `on_news` is called in the feed's thread."""

    def __init__(self, path: str, on_news: Callable[[News], None], wanted: Wish | None) -> None:
        self._path = path
        self._on_news = on_news
        self._wanted = wanted
        self._changed = Condition()
        self._stopped = False
        self._ahead_ns = 0
        self._thread = Thread(target=self._run, name="feed", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """End, within a second or so; may be called twice."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(2 * STATUS_S)

    def want(self, wanted: Wish | None) -> None:
        """Read this from now on; None to read nothing, without a connection to the daemon."""
        with self._changed:
            self._wanted = wanted
            self._changed.notify_all()

    def _run(self) -> None:
        while self._wait_for_a_view():
            try:
                with Client(self._path) as client:
                    self._read(client)
            except (ImudError, TimeoutError) as error:
                self._on_news(News(str(error), now_ns=monotonic_ns() + self._ahead_ns, ahead_ns=self._ahead_ns))
                with self._changed:
                    self._changed.wait_for(lambda: self._stopped, RETRY_S)

    def _wait_for_a_view(self) -> bool:
        """Wait until something is wanted; False at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._wanted is not None)
            return not self._stopped

    def _read(self, client: Client) -> None:
        """Read until the end, until nothing is wanted, or until the connection is lost, which raises."""
        client.events()
        reading = _Reading(client)
        hello: Hello | None = client.hello
        while not self._stopped and (wanted := self._wanted) is not None:
            news = reading.next(wanted)
            self._ahead_ns = news.ahead_ns
            self._on_news(news._replace(hello=hello))
            hello = None


def clock_ahead_ns(daemon_now_ns: int) -> int:
    """Return CLOCK_MONOTONIC of the daemon's machine, which an answer had just now, minus that of this machine.

    0 where both are one clock; they are not where SSH forwards the socket from another machine.
    """
    ahead_ns = daemon_now_ns - monotonic_ns()
    return ahead_ns if abs(ahead_ns) > SAME_CLOCK_NS else 0


def utc_offset_ns(ahead_ns: int) -> int:
    """Return what makes UTC of a time of the daemon, with the CLOCK_REALTIME of this machine."""
    return time_ns() - monotonic_ns() - ahead_ns


class _Reading:
    """One connection: when what is asked for next, and which devices are watched."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._status_due_s = self._newest_due_s = 0.0
        self._known: frozenset[str] = frozenset()
        self._watched: tuple[tuple[str, ...] | None, float | None, float] | None = None
        self._watch: Watch | None = None
        self._dropped = 0
        self._ahead_ns = 0
        self._first_event: Event | None = None
        """One that came while there were no samples to wait for."""

    def next(self, wanted: Wish) -> News:
        """Ask for what is due, and wait for samples and events for `wanted.news_s`."""
        news = self._asked(wanted)
        self._follow(wanted)
        samples = self._samples(wanted.news_s)
        events = self._events()
        dropped, self._dropped = self._dropped, 0
        now_ns = monotonic_ns() + self._ahead_ns
        return news._replace(samples=samples, events=events, dropped=dropped, now_ns=now_ns, ahead_ns=self._ahead_ns)

    def _asked(self, wanted: Wish) -> News:
        news = News()
        now_s = monotonic()
        if now_s >= self._status_due_s:
            answer = self._client.status()
            self._ahead_ns = clock_ahead_ns(answer["now_ns"])
            statuses = msgspec.convert(answer["devices"], tuple[DeviceStatus, ...])
            self._known = frozenset(status.name for status in statuses)
            self._status_due_s = now_s + _pause_s(STATUS_S, len(statuses))
            news = News(statuses=statuses, clients=len(answer["socket"]["clients"]))
        if wanted.newest and now_s >= self._newest_due_s:
            news = news._replace(newest=tuple(self._client.poll()), newest_ns=monotonic_ns() + self._ahead_ns)
            self._newest_due_s = now_s + _pause_s(wanted.newest_s, len(self._known))
        return news

    def _follow(self, wanted: Wish) -> None:
        """Watch what is wanted now, as far as it is in the configuration."""
        devices = None if wanted.devices is None else tuple(name for name in wanted.devices if name in self._known)
        chosen = (devices, wanted.rate_hz, wanted.news_s)
        if chosen == self._watched:
            return
        if devices == ():
            if self._watch is not None:
                self._client.unwatch()
                self._watch = None
        else:
            # Every sample may be as late as the news: the daemon sends several at once, which costs both less.
            latency_ms = None if wanted.rate_hz is not None else wanted.news_s * 1e3
            self._watch = self._client.watch(
                devices, rate_hz=wanted.rate_hz, timeout_s=wanted.news_s, latency_ms=latency_ms
            )
            self._watch.on_dropped = self._note_dropped
        self._watched = chosen

    def _note_dropped(self, _device: str, count: int) -> None:
        self._dropped += count

    def _samples(self, limit_s: float) -> tuple[Sample, ...]:
        """Take what comes in this time."""
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
        """Take the events that came meanwhile."""
        found: list[Event] = []
        if self._first_event is not None:
            found.append(self._first_event)
            self._first_event = None
        while isinstance(message := self._client.kept_message(EventStream.NAMES), dict):
            found.append(event_of(params_of(message)))
        return tuple(found)


def _pause_s(least_s: float, devices: int) -> float:
    return least_s * max(devices / STATUS_DEVICES, 1)
