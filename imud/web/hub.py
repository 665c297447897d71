"""Hub of the browsers: requests the data that all pages need, and sends each message to the pages that show it.

The hub uses one connection to the daemon (the feed), and none while no page is visible. A comparison uses a second
feed, whose samples have one convention. Synchronization: the threads of the feeds call `take` and `take_compared`. The
event loop calls all other methods.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import isfinite
from threading import BoundedSemaphore
from typing import Final

import msgspec

from imud.attitude.conventions import Convention
from imud.bridges.status import rows
from imud.client.feed import Feed, News, Wish
from imud.contracts.status import LATENCY_BOUNDS_NS, DeviceState, DeviceStatus, RecentStatus
from imud.model.bucket import VECTORS, Bucket, Range
from imud.model.event import Event
from imud.model.ledger import LEDGER_FIELDS, bytes_open, frames_open, lost
from imud.model.sample import Sample
from imud.model.staleness import is_stale
from imud.model.units import NS_PER_S
from imud.web import messages
from imud.web.messages import Look, RawMessage

LATE_PERIODS: Final = 2
"""Number of periods after its interval at which a bucket ends if no later sample arrives."""


class Bucketing:
    """Buckets of one device at one rate. Intervals begin at multiples of the period of CLOCK_MONOTONIC."""

    # a bucket has the minimum and the maximum of each axis: a plot with few points per second shows every peak

    def __init__(self, rate_hz: int) -> None:
        self._period_ns = NS_PER_S // rate_hz
        self.lost = self.gaps = 0  # counted losses that no bucket contains yet
        self._open: list[Sample] = []
        self._number = -1  # number of the interval of the open bucket

    def add(self, samples: Iterable[Sample], now_ns: int) -> list[Bucket]:
        """Add samples in order. Return the complete buckets."""
        done = []
        for sample in samples:
            number = sample.t_ns // self._period_ns
            if number != self._number:
                done += self._end()
                self._number = number
            self._open.append(sample)
        if now_ns >= (self._number + 1 + LATE_PERIODS) * self._period_ns:
            done += self._end()
        return done

    def _end(self) -> list[Bucket]:
        samples, self._open = self._open, []
        if not samples:
            return []
        lost_now, gaps, self.lost, self.gaps = self.lost, self.gaps, 0, 0
        return [bucket_of(samples, lost_now, gaps)]


def bucket_of(samples: Sequence[Sample], lost_samples: int = 0, gaps: int = 0) -> Bucket:
    """Return the bucket of samples of one device, at least one. Ignore values that are not finite."""
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
        lost=lost_samples,
        gaps=gaps,
        **ranges,
    )


def raw_of(device: str, member: str, samples: Iterable[Sample]) -> RawMessage | None:
    """Return every value of a vector; None if no sample contains it."""
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
"""Maximum number of queued messages with samples and events: 2 s at 50 Hz. Other messages replace each other."""
WINDOW_MAX: Final = 100
"""Maximum number of unacknowledged messages: 2 s at 50 Hz. A page acknowledges four times per second."""


class Mailbox:
    """Queue of messages for one browser. Synchronization: one event loop."""

    # Without WINDOW_MAX, a slow connection (tunnel, phone) would keep megabytes of old samples in the buffers of the
    # kernels.

    def __init__(self) -> None:
        self.dropped = 0  # number of dropped messages
        self._newest: dict[str, str] = {}
        self._frames: deque[str] = deque()
        self._unacknowledged = 0
        self._changed = asyncio.Event()

    def put(self, message: str) -> None:
        """Append a message. Drop the oldest message if the queue is full."""
        if len(self._frames) >= FRAMES_MAX:
            self._frames.popleft()
            self.dropped += 1
        self._frames.append(message)
        self._changed.set()

    def put_newest(self, subject: str, message: str) -> None:
        """Queue a message, in place of a queued message with the same subject."""
        self._newest[subject] = message
        self._changed.set()

    def acknowledge(self, messages: int) -> None:
        """Count messages that the page has processed."""
        self._unacknowledged = max(0, self._unacknowledged - max(0, messages))
        self._changed.set()

    def forget(self) -> None:
        """Discard the queue, because the page shows something else."""
        self._frames.clear()
        self._newest.clear()

    @property
    def waiting(self) -> int:
        return len(self._newest) + len(self._frames)

    async def take(self) -> str:
        """Wait until there is a message and fewer than WINDOW_MAX are unacknowledged. Return the message."""
        while not self.waiting or self._unacknowledged >= WINDOW_MAX:
            self._changed.clear()
            await self._changed.wait()
        self._unacknowledged += 1
        if self._newest:
            return self._newest.pop(next(iter(self._newest)))
        return self._frames.popleft()


NEWEST_S: Final = 0.5
"""Time between two updates of the overview, s."""
OVERVIEW_NEWS_S: Final = 0.25
WAITING_MAX: Final = 8
"""Maximum number of `News` that the event loop has not processed. Then the feed waits, and the daemon drops samples."""
WAIT_S: Final = 1.0
"""Maximum wait of the feed for the event loop, s. Then the hub drops the `News`."""
DEVICES_MAX: Final = 32
"""Maximum number of devices with all samples. At 1 kHz, each costs about 1 % of a core."""

COMPARED: Final = Convention.ENU_FLU
"""Convention of the samples of a comparison, so that the curves of two vendors have the same axes."""


class Browser:
    """One open page."""

    def __init__(self) -> None:
        self.look = Look()
        self.mailbox = Mailbox()
        self.reported = (0, 0)  # numbers of dropped messages and samples that the page knows


class BrowserHub:
    """The open pages, and the newest data of the daemon."""

    def __init__(self, call_soon: Callable[[Callable[[News], None], News], object]) -> None:
        """`call_soon` calls a function in the event loop, from any thread."""
        self.browsers: set[Browser] = set()
        self.dropped_samples = 0  # number of samples that the daemon dropped since start
        self._call_soon = call_soon
        self._room = BoundedSemaphore(WAITING_MAX)
        self._feed: Feed | None = None
        self._compared: Feed | None = None  # feed of the samples of comparisons
        self._state = messages.StateMessage("connecting to the daemon", "", "")
        self._statuses: dict[str, DeviceStatus] = {}
        self._clients = 0
        self._buckets: dict[tuple[bool, str, int], Bucketing] = {}  # by comparison or not, device and rate
        self._newest: dict[str, Sample] = {}
        self._arrival_ns: dict[str, int] = {}  # arrival of the newest sample of each device that a page shows
        # devices with samples for a page; for False without a comparison, for True in a comparison
        self._watched: dict[bool, tuple[str, ...]] = {False: (), True: ()}

    def attach(self, feed: Feed, compared: Feed) -> None:
        self._feed, self._compared = feed, compared

    # --- browsers ---------------------------------------------------------------------------------------------------

    def add(self, browser: Browser) -> None:
        self.browsers.add(browser)

    def remove(self, browser: Browser) -> None:
        """Remove a closed page. A second call does nothing."""
        self.browsers.discard(browser)
        self._want()

    def look(self, browser: Browser, look: Look) -> None:
        """Process a message of a page: its acknowledgements, and the view that it shows."""
        browser.mailbox.acknowledge(look.acknowledged)
        wanted = msgspec.structs.replace(look, acknowledged=0)
        if wanted == browser.look:
            return
        is_other_view = (wanted.look, wanted.devices) != (browser.look.look, browser.look.devices)
        browser.look = wanted
        if is_other_view:
            browser.mailbox.forget()
        self._want()
        if is_other_view and wanted.look != "nothing":
            browser.mailbox.put_newest("state", _text(self._state))
        watched = self._watched[wanted.is_comparison]
        if any(name not in watched and self._exists(name) for name in wanted.devices):
            words = f"pages of {DEVICES_MAX} other devices are open, the maximum; close one of them"
            browser.mailbox.put(_text(messages.ProblemMessage(words)))

    def _exists(self, device: str) -> bool:
        """Return whether a device exists, or its existence is unknown before the first status."""
        return not self._statuses or device in self._statuses

    def _want(self) -> None:
        """Request the data that all pages need from the feeds."""
        looks = [one.look for one in self.browsers if one.look.look != "nothing"]
        devices, compared = (self._watch(looks, is_comparison) for is_comparison in (False, True))
        rates = [look.rate_hz for look in looks if look.look == "device"]
        used = {(look.is_comparison, name, look.rate_hz) for look in looks for name in look.devices}
        self._buckets = {key: self._buckets.get(key) or Bucketing(key[2]) for key in used}
        if not looks:
            self._newest.clear()
        if self._feed is None or self._compared is None:
            return
        news_s = 1 / max(rates) if rates else OVERVIEW_NEWS_S
        has_overview = any(look.look == "overview" for look in looks)
        self._feed.want(Wish(devices, news_s=news_s, newest=has_overview, newest_s=NEWEST_S) if looks else None)
        self._compared.want(Wish(compared, news_s=news_s, convention=COMPARED) if compared else None)

    def _watch(self, looks: Iterable[Look], is_comparison: bool) -> tuple[str, ...]:
        """Choose the devices with samples for these pages, and return them."""
        named = {
            name for one in looks if one.is_comparison is is_comparison for name in one.devices if self._exists(name)
        }
        stay = [name for name in self._watched[is_comparison] if name in named]
        chosen = tuple([*stay, *sorted(named.difference(stay))][:DEVICES_MAX])
        self._watched[is_comparison] = chosen
        return chosen

    # --- news -------------------------------------------------------------------------------------------------------

    def take(self, news: News) -> None:
        """Pass `news` to the event loop. The feed's thread calls this method, and waits if the loop is late."""
        if self._room.acquire(timeout=WAIT_S):
            self._call_soon(self._take_in_loop, news)

    def take_compared(self, news: News) -> None:
        """Pass samples of comparisons to the event loop, as `take`. The other feed supplies all other data."""
        if (news.samples or news.dropped) and self._room.acquire(timeout=WAIT_S):
            self._call_soon(self._take_compared_in_loop, news)

    def _take_in_loop(self, news: News) -> None:
        try:
            self.spread(news)
        finally:
            self._room.release()

    def _take_compared_in_loop(self, news: News) -> None:
        try:
            self.dropped_samples += news.dropped
            self._spread_samples(news, is_comparison=True)
        finally:
            self._room.release()

    def spread(self, news: News) -> None:
        """Send the data in `news` to the pages that show it."""
        self._spread_state(news)
        if news.statuses is not None:
            before, self._statuses = self._statuses, {status.name: status for status in news.statuses}
            if news.hello is None:  # the first status of a connection can follow the previous status after hours
                self._count_losses(before)
            self._arrival_ns = {name: t_ns for name, t_ns in self._arrival_ns.items() if name in self._statuses}
            if before.keys() != self._statuses.keys():
                self._want()  # a page can show a device that did not exist
            self._clients = news.clients
            self._spread_statuses(news.now_ns)
        if news.newest is not None:
            self._newest = {sample.device: sample for sample in news.newest}
            self._arrival_ns |= {sample.device: sample.t_rx_ns for sample in news.newest}
        if news.statuses is not None or news.newest is not None:
            self._spread_overview(news.now_ns if news.newest is None else news.newest_ns)
        if news.events:
            self._spread_events(news.events)
        if news.dropped:
            self.dropped_samples += news.dropped
        self._spread_samples(news)

    def _count_losses(self, before: Mapping[str, DeviceStatus]) -> None:
        """Add the losses since the previous status to the next bucket of each device."""
        for (_, name, _), bucketing in self._buckets.items():
            if name in before and name in self._statuses:
                then, now = _counts(before[name]), _counts(self._statuses[name])
                bucketing.lost += max(lost(now) - lost(then), 0)
                bucketing.gaps += max(now["lost_unknown"] - then["lost_unknown"], 0)

    def _spread_state(self, news: News) -> None:
        before = self._state
        if news.problem:
            self._state = messages.StateMessage(news.problem, before.version, before.epoch)
        elif news.hello is not None:
            self._state = messages.StateMessage("", news.hello.version, str(news.hello.epoch))
        if self._state != before:
            self._to(lambda look: look.look != "nothing", self._state, "state")

    def _spread_statuses(self, now_ns: int) -> None:
        for name in {name for one in self.browsers for name in one.look.devices}:
            message = status_message(name, self._statuses.get(name), now_ns, self._arrival_ns.get(name))
            self._to(lambda look, name=name: name in look.devices, message, f"status {name}")  # type: ignore[misc]  # bound now

    def _spread_overview(self, now_ns: int) -> None:
        rows = tuple(row_of(one, self._newest.get(name), now_ns) for name, one in self._statuses.items())
        message = messages.OverviewMessage(self._clients, now_ns / NS_PER_S, rows)
        self._to(lambda look: look.look != "nothing", message, "overview")

    def _spread_events(self, events: Iterable[Event]) -> None:
        fresh = tuple(
            messages.NewEvent(one.t_ns / NS_PER_S, one.device, str(one.kind), one.message, dict(one.detail))
            for one in events
        )
        self._to(lambda look: look.look != "nothing", messages.EventsMessage(fresh))

    def _spread_samples(self, news: News, *, is_comparison: bool = False) -> None:
        by_device: dict[str, list[Sample]] = {}
        for sample in news.samples:
            by_device.setdefault(sample.device, []).append(sample)
            self._arrival_ns[sample.device] = sample.t_rx_ns
        for (kind, name, rate_hz), bucketing in self._buckets.items():
            if kind is not is_comparison:
                continue
            if buckets := bucketing.add(by_device.get(name, ()), news.now_ns):
                self._to(
                    lambda look, key=(is_comparison, rate_hz, name): (  # type: ignore[misc]
                        (look.is_comparison, look.rate_hz) == key[:2] and key[2] in look.devices
                    ),
                    messages.SamplesMessage(name, rate_hz, tuple(buckets), COMPARED if is_comparison else ""),
                )
        for name, member in {(one.look.device, one.look.spectrum) for one in self.browsers if one.look.spectrum}:
            if name in by_device and (raw := raw_of(name, member, by_device[name])):
                self._to(
                    lambda look, key=(name, member): (look.device, look.spectrum) == key,  # type: ignore[misc]
                    raw,
                )

    def _to(self, is_for: Callable[[Look], bool], message: messages.ToPage, subject: str = "") -> None:
        """Encode a message once, and queue it for each page for which `is_for` is true."""
        found = [one for one in self.browsers if is_for(one.look)]
        if not found:
            return
        text = _text(message)
        for browser in found:
            if subject:
                browser.mailbox.put_newest(subject, text)
            else:
                browser.mailbox.put(text)
            dropped = (browser.mailbox.dropped, self.dropped_samples)
            if dropped != browser.reported:
                browser.reported = dropped
                browser.mailbox.put_newest("dropped", _text(messages.DroppedMessage(*dropped)))


def has_stale_values(status: DeviceStatus, arrival_ns: int | None, now_ns: int) -> bool:
    """Return whether the values of a device are not current. `arrival_ns` is the arrival of its newest sample."""
    if arrival_ns is None:
        return status.state is not DeviceState.RUNNING
    rate_hz = status.expected_rate_hz or status.rate_hz
    return is_stale(arrival_ns, now_ns, round(NS_PER_S / rate_hz) if rate_hz > 0 else 0)


def status_message(
    name: str, status: DeviceStatus | None, now_ns: int, arrival_ns: int | None = None
) -> messages.StatusMessage:
    """Return the message with the complete status of a device; with null if the device is not configured.

    `arrival_ns` is the arrival of the newest sample; None if it is not known.
    """
    bounds_s = tuple(bound / NS_PER_S for bound in LATENCY_BOUNDS_NS)
    if status is None:
        return messages.StatusMessage(name, now_ns / NS_PER_S, None, 0, 0, 0, bounds_s, ())
    ledger, whole = _counts(status), msgspec.to_builtins(status)
    opens = bytes_open(ledger), frames_open(ledger)
    return messages.StatusMessage(
        name, now_ns / NS_PER_S, whole, lost(ledger), *opens, bounds_s, tuple(rows(status)),
        has_stale_values(status, arrival_ns, now_ns),
    )  # fmt: skip


def row_of(status: DeviceStatus, newest: Sample | None, now_ns: int) -> messages.DeviceRow:
    condition, work, frame = status.condition, status.work, status.frame
    is_stale_row = has_stale_values(status, None if newest is None else newest.t_rx_ns, now_ns)
    current = None if is_stale_row else newest
    return messages.DeviceRow(
        name=status.name,
        state=status.word,
        is_well=not status.has_problem,
        since_s=None if condition is None else condition.since_ns / NS_PER_S,
        reasons=status.reasons,
        history=status.history,
        work="" if work is None else work.words(now_ns),
        driver=status.driver,
        link=status.link,
        identity=status.identity,
        heading="" if frame is None else str(frame.heading),
        rate_hz=status.rate_hz,
        expected_rate_hz=status.expected_rate_hz,
        lost=lost(_counts(status)),
        lost_percent=_lost_percent(status.recent),
        temperature_c=None if is_stale_row else status.temperature_c,
        age_s=None if newest is None else max(now_ns - newest.t_ns, 0) / NS_PER_S,
        t_err_s=None if current is None else current.t_err_ns / NS_PER_S,
        sync="" if current is None else str(current.sync),
        euler_rad=None if current is None else current.euler_rad,
    )


def _lost_percent(recent: RecentStatus | None) -> float | None:
    """Return the share of lost samples in the last minute; None without samples."""
    lost_samples = 0 if recent is None else sum(recent.lost.values())
    measured = 0 if recent is None else recent.samples + lost_samples
    return 100 * lost_samples / measured if measured else None


def _counts(status: DeviceStatus) -> dict[str, int]:
    """Return the ledger, with 0 for counters that a daemon of another version does not have."""
    return dict.fromkeys(LEDGER_FIELDS, 0) | status.ledger


def _text(message: messages.ToPage) -> str:
    return messages.encode(message).decode()
