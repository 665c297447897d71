"""The hub: what all browsers together look at, and each message of the daemon to those that look at its device.

It has one connection to the daemon (the feed), and none while nobody looks. Synchronization: `take` is called in the
feed's thread; everything else in the event loop.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from math import isfinite
from threading import BoundedSemaphore
from typing import Final, Protocol

import msgspec

from imud.client.feed import News, Wish
from imud.contracts.setting import SettingsState
from imud.contracts.status import LATENCY_BOUNDS_NS, DeviceState, DeviceStatus
from imud.model.event import Event, EventKind
from imud.model.ledger import LEDGER_FIELDS, bytes_open, frames_open, lost
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.web import messages
from imud.web.messages import VECTORS, Bucket, Look, Range, RawMessage

LATE_PERIODS: Final = 2
"""A bucket ends that long after its interval even where no later sample came."""


class Bucketing:
    """Buckets of one device at one rate. Their intervals begin at whole multiples of the period of CLOCK_MONOTONIC."""

    def __init__(self, rate_hz: int) -> None:
        self._period_ns = NS_PER_S // rate_hz
        self._open: list[Sample] = []
        self._number = -1
        """Of the interval of the open bucket, since the clock's zero."""

    def add(self, samples: Iterable[Sample], now_ns: int) -> list[Bucket]:
        """Take samples in order, and return the buckets that are complete."""
        done = []
        for sample in samples:
            number = sample.t_ns // self._period_ns
            if number != self._number:
                done += self._ended()
                self._number = number
            self._open.append(sample)
        if now_ns >= (self._number + 1 + LATE_PERIODS) * self._period_ns:
            done += self._ended()
        return done

    def _ended(self) -> list[Bucket]:
        samples, self._open = self._open, []
        return [bucket_of(samples)] if samples else []


def bucket_of(samples: Sequence[Sample]) -> Bucket:
    """Make the bucket of one sample or more of one device. Values that are not finite are left out."""
    first, last = samples[0], samples[-1]
    ranges = {name: _range([getattr(sample, name) for sample in samples]) for name in VECTORS}
    return Bucket(
        first_s=first.t_ns / NS_PER_S,
        last_s=last.t_ns / NS_PER_S,
        utc_s=last.utc_ns / NS_PER_S,
        count=len(samples),
        seq=last.seq,
        sync=str(last.sync),
        t_err_s=max(sample.t_err_ns for sample in samples) / NS_PER_S,
        latency_s=max(sample.t_rx_ns - sample.t_ns for sample in samples) / NS_PER_S,
        quat_wxyz=_last([sample.quat_wxyz for sample in samples]),
        temperature_c=next((one.temperature_c for one in reversed(samples) if one.temperature_c is not None), None),
        pressure_pa=next((one.pressure_pa for one in reversed(samples) if one.pressure_pa is not None), None),
        **ranges,
    )


def raw_of(device: str, member: str, samples: Iterable[Sample]) -> RawMessage | None:
    """Every value of a vector; None where no sample has it."""
    found = [
        (sample.seq, sample.t_ns / NS_PER_S, vector)
        for sample in samples
        if (vector := getattr(sample, member)) is not None and all(map(isfinite, vector))
    ]
    if not found:
        return None
    numbers, times, vectors = zip(*found, strict=True)
    return RawMessage(device, member, numbers, times, tuple(zip(*vectors, strict=True)))


def _range(vectors: Iterable[tuple[float, ...] | None]) -> Range | None:
    kept = [vector for vector in vectors if vector is not None and all(map(isfinite, vector))]
    if not kept:
        return None
    axes = list(zip(*kept, strict=True))
    return tuple(map(min, axes)), tuple(map(max, axes))


def _last(vectors: Sequence[tuple[float, ...] | None]) -> tuple[float, ...] | None:
    for vector in reversed(vectors):
        if vector is not None and all(map(isfinite, vector)):
            return vector
    return None


FRAMES_MAX: Final = 100
"""Messages of samples and events that wait: 2 s at 50 Hz. Of state and status only the newest waits, each once."""
WINDOW_MAX: Final = 100
"""Messages that were sent and are not acknowledged: 2 s at 50 Hz, while pages acknowledge four times a second."""


class Mailbox:
    """Messages for one browser. Synchronization: one event loop."""

    def __init__(self) -> None:
        self.dropped = 0
        """Messages left out."""
        self._newest: dict[str, str] = {}
        self._frames: deque[str] = deque()
        self._on_the_way = 0
        self._changed = asyncio.Event()

    def put(self, message: str) -> None:
        """Add a message behind those that wait; the oldest goes where there are too many."""
        if len(self._frames) >= FRAMES_MAX:
            self._frames.popleft()
            self.dropped += 1
        self._frames.append(message)
        self._changed.set()

    def put_newest(self, subject: str, message: str) -> None:
        """Add a message of which only the newest on its subject is of use; one that waits is replaced."""
        self._newest[subject] = message
        self._changed.set()

    def acknowledge(self, messages: int) -> None:
        """Note that the page has dealt with so many; more than were sent is all of them."""
        self._on_the_way = max(0, self._on_the_way - max(0, messages))
        self._changed.set()

    def forget(self) -> None:
        """Throw away what waits: the page shows something else now."""
        self._frames.clear()
        self._newest.clear()

    @property
    def waiting(self) -> int:
        """Messages that wait."""
        return len(self._newest) + len(self._frames)

    async def take(self) -> str:
        """Wait for the next message to send, and for room on the way."""
        while not self.waiting or self._on_the_way >= WINDOW_MAX:
            self._changed.clear()
            await self._changed.wait()
        self._on_the_way += 1
        if self._newest:
            return self._newest.pop(next(iter(self._newest)))
        return self._frames.popleft()


EVENTS_KEPT: Final = 200
NEWEST_S: Final = 0.5
"""Time between two pictures of the overview."""
OVERVIEW_NEWS_S: Final = 0.25
WAITING_MAX: Final = 8
"""Pieces of news that the loop has not taken yet; beyond, the feed waits, and the daemon counts what it cannot send."""
WAIT_S: Final = 1.0
"""How long the feed waits for a loop that does not run; then the news are left out."""
DEVICES_MAX: Final = 32
"""Devices whose every sample is read at a time; at 1 kHz each costs about 1 % of a core."""


class DaemonFeed(Protocol):
    """What reads the daemon."""

    def want(self, wanted: Wish | None) -> None:
        """Read this from now on."""
        ...


class Browser:
    """One page that is open."""

    def __init__(self) -> None:
        self.look = Look()
        self.mailbox = Mailbox()
        self.left_out = (0, 0)
        """What the page was informed of: messages left out, and samples."""


class BrowserHub:
    """All browsers."""

    def __init__(self, call_soon: Callable[[Callable[[News], None], News], object]) -> None:
        """`call_soon` calls a function in the event loop, from any thread."""
        self.browsers: set[Browser] = set()
        self.dropped_samples = 0
        """By the daemon, since start."""
        self._call_soon = call_soon
        self._room = BoundedSemaphore(WAITING_MAX)
        self._feed: DaemonFeed | None = None
        self._state = messages.StateMessage("connecting to the daemon", "", "")
        self._statuses: dict[str, DeviceStatus] = {}
        self._clients = 0
        self._events: deque[messages.NewEvent] = deque(maxlen=EVENTS_KEPT)
        self._buckets: dict[tuple[str, int], Bucketing] = {}
        self._newest: dict[str, Sample] = {}
        self._watched: tuple[str, ...] = ()
        """Devices whose samples are wanted."""

    def attach(self, feed: DaemonFeed) -> None:
        """Use this feed."""
        self._feed = feed

    # --- browsers ---------------------------------------------------------------------------------------------------

    def add(self, browser: Browser) -> None:
        """Take a page that was opened."""
        self.browsers.add(browser)

    def remove(self, browser: Browser) -> None:
        """Forget a page that was closed; no-op if it is."""
        self.browsers.discard(browser)
        self._want()

    def look(self, browser: Browser, look: Look) -> None:
        """Show a page something else."""
        browser.mailbox.acknowledge(look.acknowledged)
        wanted = msgspec.structs.replace(look, acknowledged=0)
        if wanted == browser.look:
            return
        is_elsewhere = (wanted.look, wanted.device) != (browser.look.look, browser.look.device)
        browser.look = wanted
        if is_elsewhere:
            browser.mailbox.forget()
        self._want()
        if is_elsewhere and wanted.look != "nothing":
            self._show_at_once(browser)
        if wanted.look == "device" and wanted.device not in self._watched:
            words = f"{DEVICES_MAX} other devices are looked at, which is the most; close some of their pages"
            browser.mailbox.put(_text(messages.ProblemMessage(words)))

    def _show_at_once(self, browser: Browser) -> None:
        """Send what is known, so that the page is not empty until the next status."""
        browser.mailbox.put_newest("state", _text(self._state))
        if self._events:
            browser.mailbox.put(_text(messages.EventsMessage(tuple(self._events))))

    def _want(self) -> None:
        """Let the feed read what all pages together need."""
        looks = [one.look for one in self.browsers if one.look.look != "nothing"]
        named = {look.device for look in looks if look.look == "device"}
        stay = [name for name in self._watched if name in named]
        devices = self._watched = tuple([*stay, *sorted(named.difference(stay))][:DEVICES_MAX])
        rates = [look.rate_hz for look in looks if look.look == "device"]
        used = {(look.device, look.rate_hz) for look in looks if look.look == "device"}
        self._buckets = {key: self._buckets.get(key) or Bucketing(key[1]) for key in used}
        if not looks:
            self._newest.clear()
        if self._feed is not None:
            news_s = 1 / max(rates) if rates else OVERVIEW_NEWS_S
            has_overview = any(look.look == "overview" for look in looks)
            wanted = Wish(devices, news_s=news_s, newest=has_overview, newest_s=NEWEST_S)
            self._feed.want(wanted if looks else None)

    # --- news -------------------------------------------------------------------------------------------------------

    def take(self, news: News) -> None:
        """Hand news to the event loop; called in the feed's thread, which waits while the loop is behind."""
        if self._room.acquire(timeout=WAIT_S):
            self._call_soon(self._take_in_loop, news)

    def _take_in_loop(self, news: News) -> None:
        try:
            self.spread(news)
        finally:
            self._room.release()

    def spread(self, news: News) -> None:
        """Send news to the browsers that they are for."""
        self._spread_state(news)
        if news.statuses is not None:
            self._statuses = {status.name: status for status in news.statuses}
            self._clients = news.clients
            self._spread_statuses(news.now_ns)
        if news.newest is not None:
            self._newest = {sample.device: sample for sample in news.newest}
            self._spread_overview(news.newest_ns)
        if news.events:
            self._spread_events(news.events)
        if news.dropped:
            self.dropped_samples += news.dropped
        self._spread_samples(news)

    def _spread_state(self, news: News) -> None:
        before = self._state
        if news.problem:
            self._state = messages.StateMessage(news.problem, before.version, before.epoch)
        elif news.hello is not None:
            self._state = messages.StateMessage("", news.hello.version, str(news.hello.epoch))
        if self._state != before:
            self._to(lambda look: look.look != "nothing", self._state, "state")

    def _spread_statuses(self, now_ns: int) -> None:
        for name in {one.look.device for one in self.browsers if one.look.look == "device"}:
            message = status_message(name, self._statuses.get(name), now_ns)
            self._to(lambda look, name=name: look.device == name, message, "status")  # type: ignore[misc]  # bound now

    def _spread_overview(self, now_ns: int) -> None:
        rows = tuple(row_of(one, self._newest.get(name), now_ns) for name, one in self._statuses.items())
        self._to(lambda look: look.look == "overview", messages.OverviewMessage(self._clients, rows), "overview")

    def _spread_events(self, events: Iterable[Event]) -> None:
        fresh = tuple(
            messages.NewEvent(one.t_ns / NS_PER_S, one.device, str(one.kind), one.message, dict(one.detail))
            for one in events
        )
        self._events.extend(one for one in fresh if not _is_progress(one))
        self._to(lambda look: look.look != "nothing", messages.EventsMessage(fresh))

    def _spread_samples(self, news: News) -> None:
        by_device: dict[str, list[Sample]] = {}
        for sample in news.samples:
            by_device.setdefault(sample.device, []).append(sample)
        for (name, rate_hz), bucketing in self._buckets.items():
            if buckets := bucketing.add(by_device.get(name, ()), news.now_ns):
                self._to(
                    lambda look, key=(name, rate_hz): (look.device, look.rate_hz) == key,  # type: ignore[misc]
                    messages.SamplesMessage(name, rate_hz, tuple(buckets)),
                )
        for name, member in {(one.look.device, one.look.spectrum) for one in self.browsers if one.look.spectrum}:
            if name in by_device and (raw := raw_of(name, member, by_device[name])):
                self._to(
                    lambda look, key=(name, member): (look.device, look.spectrum) == key,  # type: ignore[misc]
                    raw,
                )

    def _to(self, is_for: Callable[[Look], bool], message: messages.ToPage, subject: str = "") -> None:
        """Encode a message once, and give it to the browsers that it is for."""
        found = [one for one in self.browsers if is_for(one.look)]
        if not found:
            return
        text = _text(message)
        for browser in found:
            if subject:
                browser.mailbox.put_newest(subject, text)
            else:
                browser.mailbox.put(text)
            left_out = (browser.mailbox.dropped, self.dropped_samples)
            if left_out != browser.left_out:
                browser.left_out = left_out
                browser.mailbox.put_newest("dropped", _text(messages.DroppedMessage(*left_out)))


def hub_of(loop: asyncio.AbstractEventLoop) -> BrowserHub:
    """Make the hub of a running loop."""
    return BrowserHub(loop.call_soon_threadsafe)


def status_message(name: str, status: DeviceStatus | None, now_ns: int) -> messages.StatusMessage:
    """Make the message of a device's whole status; of one that is not in the configuration too."""
    bounds_s = tuple(bound / NS_PER_S for bound in LATENCY_BOUNDS_NS)
    if status is None:
        return messages.StatusMessage(name, now_ns / NS_PER_S, None, 0, 0, 0, bounds_s)
    ledger, whole = _counts(status), msgspec.to_builtins(status)
    opens = bytes_open(ledger), frames_open(ledger)
    return messages.StatusMessage(name, now_ns / NS_PER_S, whole, lost(ledger), *opens, bounds_s)


def row_of(status: DeviceStatus, newest: Sample | None, now_ns: int) -> messages.DeviceRow:
    """Make the row of a device in the overview."""
    ledger = _counts(status)
    return messages.DeviceRow(
        name=status.name,
        state=str(status.state),
        problem=status.problem,
        is_well=status.state in (DeviceState.RUNNING, DeviceState.FINISHED),
        driver=status.driver,
        link=status.link,
        identity=status.identity,
        rate_hz=status.rate_hz,
        expected_rate_hz=status.expected_rate_hz,
        lost=lost(ledger),
        closes=bytes_open(ledger) == 0 and frames_open(ledger) == 0,
        differs=status.declared is not None and status.declared.state is SettingsState.DIFFER,
        alarm=status.lines is not None and status.lines.alarm is True,
        temperature_c=status.temperature_c,
        age_s=None if newest is None else max(now_ns - newest.t_ns, 0) / NS_PER_S,
        t_err_s=None if newest is None else newest.t_err_ns / NS_PER_S,
        sync="" if newest is None else str(newest.sync),
        euler_rad=None if newest is None else newest.euler_rad,
        accel_m_s2=None if newest is None else newest.accel_m_s2,
        gyro_rad_s=None if newest is None else newest.gyro_rad_s,
    )


def _is_progress(event: messages.NewEvent) -> bool:
    """Decide whether an event is one of many within a calibration, of which a page that opens needs the next only."""
    return event.event == EventKind.CALIBRATION and event.detail.get("phase") not in ("begin", "end")


def _counts(status: DeviceStatus) -> dict[str, int]:
    """The ledger, with zero for what a daemon of another version does not count."""
    return dict.fromkeys(LEDGER_FIELDS, 0) | status.ledger


def _text(message: messages.ToPage) -> str:
    return messages.encode(message).decode()
