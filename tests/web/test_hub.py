"""Messages to the pages with their queue and buckets, and the requests to the daemon."""

import asyncio
import json
from collections.abc import Callable
from math import inf, nan
from typing import Any

import msgspec

from imud.client.connection import Hello
from imud.client.feed import Feed, News, Wish
from imud.contracts.status import DeviceState
from imud.model.event import Event, EventKind
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.web.hub import Browser, BrowserHub, Bucketing, Mailbox, bucket_of, raw_of, row_of, status_message
from imud.web.messages import Look
from tests.support.metrics import device
from tests.support.socket_rig import sample

DEVICES_MAX, FRAMES_MAX, WAITING_MAX, WINDOW_MAX = 32, 100, 8, 100
HELLO = Hello(1, "0.1.0", 2**62 + 1, ("read",))


class FakeFeed(Feed):
    """A feed without a thread. It keeps the wishes."""

    def __init__(self) -> None:
        super().__init__("", None)
        self.wanted: list[Wish | None] = []

    def want(self, wanted: Wish | None) -> None:
        self.wanted.append(wanted)


def make() -> tuple[BrowserHub, FakeFeed]:
    hub, feed = BrowserHub(lambda function, news: function(news)), FakeFeed()
    hub.attach(feed, FakeFeed())
    return hub, feed


def opened(hub: BrowserHub, **look: Any) -> Browser:
    browser = Browser()
    hub.add(browser)
    hub.look(browser, Look(**look))
    return browser


async def heard(browser: Browser, kind: str = "") -> list[dict[str, Any]]:
    found = []
    while browser.mailbox.waiting:
        found.append(json.loads(await browser.mailbox.take()))
        browser.mailbox.acknowledge(1)
    return [message for message in found if not kind or message["kind"] == kind]


def news(first: int = 1, count: int = 1, **more: Any) -> News:
    samples = tuple(sample("bow", seq) for seq in range(first, first + count))
    return News(samples=samples, now_ns=samples[-1].t_ns + 1, **more)


def test_the_feed_reads_the_data_that_all_pages_need() -> None:
    hub, feed = make()
    one = opened(hub, look="overview")
    assert feed.wanted[-1] == Wish((), news_s=0.25, newest=True, newest_s=0.5)
    two = opened(hub, look="device", device="bow", rate_hz=10)
    opened(hub, look="device", device="stern", rate_hz=50)
    wanted = feed.wanted[-1]
    assert wanted is not None
    assert (wanted.devices, wanted.rate_hz, wanted.news_s, wanted.newest) == (("bow", "stern"), None, 0.02, True)
    hub.look(one, Look("nothing"))
    assert feed.wanted[-1] == Wish(("bow", "stern"), news_s=0.02, newest=False, newest_s=0.5)
    for browser in list(hub.browsers):
        hub.remove(browser)
        hub.remove(two)
    assert feed.wanted[-1] is None, "no page is shown: nothing is read"
    hub, feed = make()
    browser = opened(hub, look="device", device="bow")
    hub.look(browser, Look("nothing", "bow"))
    assert feed.wanted[-1] is None
    hub, feed = make()
    browser = opened(hub, look="overview")
    asked = len(feed.wanted)
    hub.look(browser, Look("overview", acknowledged=3))
    assert len(feed.wanted) == asked


async def test_buckets_and_raw_samples_go_to_the_pages_that_want_them() -> None:
    hub, _ = make()
    slow = opened(hub, look="device", device="bow", rate_hz=10)
    fast = opened(hub, look="device", device="bow", rate_hz=50)
    other = opened(hub, look="device", device="stern", rate_hz=10)
    hub.spread(news(1, 201))
    messages = {id(one): await heard(one, "samples") for one in (slow, fast, other)}
    assert messages[id(other)] == []
    (at_10,), (at_50,) = messages[id(slow)], messages[id(fast)]
    assert (at_10["rate_hz"], [one["count"] for one in at_10["buckets"]]) == (10, [99, 100])
    assert (at_50["rate_hz"], [one["count"] for one in at_50["buckets"]]) == (50, [19, *[20] * 9])
    assert at_10["buckets"][0]["accel_m_s2"] == [[0.125, -0.5, 9.75]] * 2
    hub, _ = make()
    plain = opened(hub, look="device", device="bow")
    wanting = opened(hub, look="device", device="bow", spectrum="gyro_rad_s")
    hub.spread(news(5, 30))
    assert await heard(plain, "raw") == []
    (raw,) = await heard(wanting, "raw")
    assert (raw["seq"], raw["axes"][2]) == ([*range(5, 35)], [-0.75] * 30)


async def test_a_message_is_encoded_once_for_all_browsers() -> None:
    hub, _ = make()
    browsers = [opened(hub, look="device", device="bow") for _ in range(20)]
    hub.spread(news(1, 120))
    texts = []
    for browser in browsers:
        while browser.mailbox.waiting:
            text = await browser.mailbox.take()
            if '"samples"' in text:
                texts.append(text)
    assert (len(texts), len({id(text) for text in texts})) == (20, 1)


async def test_overview_page_and_state() -> None:
    hub, _ = make()
    overview = opened(hub, look="overview")
    page = opened(hub, look="device", device="bow")
    gone = opened(hub, look="device", device="gone")
    statuses = (device("bow"), device("stern", 1, state=DeviceState.MISSING, problem="it is not there"))
    asked_ns = sample("bow").t_ns + 500_000_000
    hub.spread(News(statuses=statuses, clients=3, newest=(sample("bow"),), newest_ns=asked_ns, now_ns=asked_ns + 7))
    (message,) = await heard(overview, "overview")
    bow, stern = message["devices"]
    assert (message["clients"], bow["name"], bow["is_well"], bow["age_s"]) == (3, "bow", True, 0.5)
    assert (stern["state"], stern["age_s"], stern["lost_percent"]) == ("missing", None, None)
    (status,) = await heard(page, "status")
    assert status["status"]["ledger"] == statuses[0].ledger
    assert (status["bytes_open"], status["frames_open"], status["lost"]) == (0, 0, bow["lost"])
    assert (await heard(gone, "status"))[0]["status"] is None
    hub, _ = make()
    browser = opened(hub, look="overview")
    assert [one["problem"] for one in await heard(browser)] == ["connecting to the daemon"]
    hub.spread(News(hello=HELLO))
    (state,) = await heard(browser, "state")
    assert (state["problem"], state["version"], state["epoch"]) == ("", "0.1.0", str(2**62 + 1))
    hub.spread(News())
    assert await heard(browser, "state") == []
    hub.spread(News("the connection is lost"))
    assert [one["problem"] for one in await heard(browser, "state")] == ["the connection is lost"]
    assert (await heard(opened(hub, look="overview"), "state"))[0]["problem"] == "the connection is lost"
    counted = msgspec.structs.replace(device("bow"), ledger={"bytes_in": 5, "bytes_pending": 5})
    assert (status_message("bow", counted, 0).lost, row_of(counted, None, 0).lost) == (0, 0)


async def test_pages_get_new_events_and_the_samples_of_both_compared_devices() -> None:
    hub, feed = make()
    hub.attach(feed, compared := FakeFeed())
    browser = opened(hub, look="overview")
    hub.spread(News(events=(Event(2 * 10**9, "bow", EventKind.UP, "is there", {"n": 1}),)))
    (last,) = (await heard(browser, "events"))[-1]["events"]
    assert last == {"t_s": 2.0, "device": "bow", "event": "up", "message": "is there", "detail": {"n": 1}}
    late = opened(hub, look="device", device="bow", other="stern")
    assert await heard(late, "events") == [], "a page reads the stored events with the method `events`"
    assert compared.wanted[-1] == Wish(("bow", "stern"), news_s=0.05, convention="enu-flu")
    hub.spread(News(statuses=(device("bow"), device("stern", 1), device("keel", 2))))
    assert {one["device"] for one in await heard(late, "status")} == {"bow", "stern"}
    single = opened(hub, look="device", device="bow")
    assert (wanted := feed.wanted[-1]) is not None
    assert wanted.devices == ("bow",)
    ledger = device("bow").ledger
    for hello, times in ((HELLO, 1), (None, 2)):  # imud web ignores the change to the first status
        counts = (("lost_crc", 3 * times), ("lost_queue", 4 * times), ("lost_unknown", times))
        more = {name: ledger[name] + count for name, count in counts}
        hub.spread(News(statuses=(device("bow", ledger=ledger | more), device("stern", 1)), hello=hello))
    hub.take_compared(news(1, 110))
    (message,) = await heard(late, "samples")
    assert [(one.get("lost"), one.get("gaps")) for one in message["buckets"]] == [(7, 1), (None, None)]
    assert not await heard(single, "samples"), "other axes"


async def test_dropped_messages_and_samples_are_reported() -> None:
    hub, _ = make()
    slow = opened(hub, look="device", device="bow", rate_hz=50)
    quick = opened(hub, look="device", device="bow", rate_hz=50)
    seen = 0
    for number in range(300):
        hub.spread(news(1 + 20 * number, 20))
        seen += len(await heard(quick, "samples"))
        quick.mailbox.acknowledge(10)
    assert (seen, quick.mailbox.dropped) == (300, 0)
    assert slow.mailbox.waiting < 110
    assert slow.mailbox.dropped > 150
    assert {"kind": "dropped", "messages": slow.mailbox.dropped, "samples": 0} in await heard(slow)
    hub, _ = make()
    browser = opened(hub, look="device", device="bow")
    hub.spread(news(1, 60, dropped=12))
    assert {"kind": "dropped", "messages": 0, "samples": 12} in await heard(browser)


def test_the_feed_waits_for_a_late_event_loop() -> None:
    waiting: list[Callable[[], None]] = []
    hub = BrowserHub(lambda function, news: waiting.append(lambda: function(news)))
    for _ in range(WAITING_MAX):
        hub.take(News())
    assert len(waiting) == WAITING_MAX
    waiting.pop(0)()
    hub.take(News())
    assert len(waiting) == WAITING_MAX


async def test_unknown_devices_take_no_places_and_the_maximum_is_reported() -> None:
    hub, feed = make()
    opened(hub, look="device", device="later")
    hub.spread(News(statuses=(device("bow"),), now_ns=1))
    for number in range(DEVICES_MAX):
        opened(hub, look="device", device=f"x{number}")
    opened(hub, look="device", device="bow")
    assert [one.devices for one in feed.wanted if one] == [("later",), *[()] * (DEVICES_MAX + 1), ("bow",)]
    hub.spread(News(statuses=(device("bow"), device("later")), now_ns=2))
    assert feed.wanted[-1] is not None
    assert feed.wanted[-1].devices == ("bow", "later")
    hub, feed = make()
    for number in range(DEVICES_MAX):
        opened(hub, look="device", device=f"imu{number}")
    late = opened(hub, look="device", device="a")
    assert any("maximum" in one["message"] for one in await heard(late, "problem"))
    assert (wanted := feed.wanted[-1]) is not None
    assert wanted.devices is not None
    assert len(wanted.devices) == DEVICES_MAX
    assert "a" not in wanted.devices


MS = 1_000_000


def at(ms: float, seq: int = 1, z: float = 9.75) -> Sample:
    made = sample("bow", seq)
    t_ns = 80_000_000_000_000 + round(ms * MS)
    return msgspec.structs.replace(made, t_ns=t_ns, t_rx_ns=t_ns + 300_000, accel_m_s2=(0.5, -0.5, z))


def test_buckets_and_raw_values() -> None:
    bucketing = Bucketing(20)
    early = [at(ms, seq) for seq, ms in enumerate((0, 10, 49.999), start=1)]
    assert bucketing.add(early, early[-1].t_ns) == []
    (bucket,) = bucketing.add([at(50, 4)], at(50).t_ns)
    assert (bucket.count, bucket.seq, bucket.first_s, bucket.last_s) == (3, 3, 80000.0, 80000.049999)
    (second,) = bucketing.add([], at(200).t_ns)
    assert (second.count, second.seq) == (1, 4), "it ends two periods after its interval without another sample"
    assert bucketing.add([], at(500).t_ns) == []
    samples = [at(ms, ms + 1) for ms in range(1000)]
    bucketing = Bucketing(50)
    buckets = bucketing.add(samples, samples[-1].t_ns) + bucketing.add([], samples[-1].t_ns + 60 * MS)
    assert [bucket.count for bucket in buckets] == [20] * 50
    assert [bucket.seq for bucket in buckets] == [*range(20, 1001, 20)]
    samples = [at(0, 1, 9.0), at(1, 2, 60.0), at(2, 3, -40.0), at(3, 4, 9.5)]
    bucket = bucket_of(samples)
    assert bucket.accel_m_s2 == ((0.5, -0.5, -40.0), (0.5, -0.5, 60.0))
    assert (bucket.t_err_s, bucket.latency_s) == (12e-6, 300e-6)
    bucket = bucket_of([at(0, 1, nan), at(1, 2, 9.0), at(2, 3, inf)])
    assert bucket.accel_m_s2 == ((0.5, -0.5, 9.0), (0.5, -0.5, 9.0))
    assert bucket_of([at(0, 1, nan)]).accel_m_s2 is None
    assert bucket.mag_t is None
    assert bucket.quat_wxyz is None
    assert "mag_t" not in msgspec.to_builtins(bucket)
    good = msgspec.structs.replace(at(0), quat_wxyz=(0.5, 0.5, 0.5, 0.5))
    bad = msgspec.structs.replace(at(1, 2), quat_wxyz=(nan, 0.0, 0.0, 0.0))
    assert bucket_of([good, bad, at(2, 3)]).quat_wxyz == (0.5, 0.5, 0.5, 0.5)
    raw = raw_of("bow", "accel_m_s2", [at(0, 1, 1.0), at(1, 2, nan), at(2, 5, 3.0)])
    assert raw is not None
    assert (raw.seq, raw.t_s, raw.axes) == ((1, 5), (80000.0, 80000.002), ((0.5, 0.5), (-0.5, -0.5), (1.0, 3.0)))
    assert raw_of("bow", "mag_t", [at(0)]) is None


async def taken(mailbox: Mailbox, count: int) -> list[str]:
    return [await mailbox.take() for _ in range(count)]


async def test_messages_wait_in_order_and_are_dropped_or_forgotten() -> None:
    mailbox = Mailbox()
    mailbox.put("a")
    mailbox.put_newest("status", "old")
    mailbox.put_newest("status", "new")
    mailbox.put("b")
    assert await taken(mailbox, 3) == ["new", "a", "b"]
    assert mailbox.waiting == 0
    mailbox = Mailbox()
    for number in range(FRAMES_MAX + 7):
        mailbox.put(str(number))
    assert mailbox.dropped == 7
    assert await taken(mailbox, 2) == ["7", "8"]
    mailbox = Mailbox()
    mailbox.put("a")
    mailbox.put_newest("status", "b")
    mailbox.forget()
    assert mailbox.waiting == 0
    assert mailbox.dropped == 0, "nobody misses it"
    mailbox = Mailbox()
    for _ in range(2):
        for number in range(WINDOW_MAX // 2):
            mailbox.put(str(number))
        await taken(mailbox, WINDOW_MAX // 2)
    mailbox.put("one more")
    waiting = asyncio.ensure_future(mailbox.take())
    for _ in range(5):
        await asyncio.sleep(0)
    assert not waiting.done()
    mailbox.acknowledge(1)
    assert await waiting == "one more"
    mailbox.acknowledge(10**9)  # more messages than sent
    mailbox.acknowledge(-5)
    mailbox.put("and one")
    assert await mailbox.take() == "and one"


def test_values_without_new_samples_are_not_current() -> None:
    """Three periods of 1 Hz are 3 s. The minimum is 1 s, also for 1 kHz."""
    slow, fast = device("bow", expected_rate_hz=1.0), device("bow", expected_rate_hz=1000.0)
    newest = msgspec.structs.replace(sample("bow"), euler_rad=(0.5, 0.0, 0.0))
    for status, limit_ns in ((slow, 3 * NS_PER_S), (fast, NS_PER_S)):
        current = row_of(status, newest, newest.t_rx_ns + limit_ns)
        assert (current.euler_rad, current.temperature_c) == ((0.5, 0.0, 0.0), status.temperature_c)
        stale = row_of(status, newest, newest.t_rx_ns + limit_ns + 1)
        assert (stale.euler_rad, stale.temperature_c, stale.t_err_s, stale.sync) == (None, None, None, "")
        assert stale.age_s is not None
        for late_ns, is_stale in ((0, False), (1, True)):
            now_ns = newest.t_rx_ns + limit_ns + late_ns
            assert status_message("bow", status, now_ns, newest.t_rx_ns).is_stale is is_stale
    assert status_message("bow", device("bow", state=DeviceState.SILENT), 0).is_stale
    assert not status_message("bow", device("bow"), 0).is_stale, "no page has requested samples yet"


async def test_page_gets_the_arrival_of_its_samples() -> None:
    hub, _ = make()
    browser = opened(hub, look="device", device="bow", rate_hz=50)
    hub.spread(news(statuses=(device("bow"),)))
    assert [one["is_stale"] for one in await heard(browser, "status")] == [False]
    later_ns = sample("bow").t_rx_ns + 2 * NS_PER_S
    hub.spread(News(statuses=(device("bow"),), now_ns=later_ns))
    assert [one["is_stale"] for one in await heard(browser, "status")] == [True]
