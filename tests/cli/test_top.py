"""Screens of `imud top` in a terminal of 80 columns without output, controlled by keys.
The feed of `imud top`, and the errors of the command.
Stored samples of each device in `imud top`.
Table of `imud top`: width, order, filter."""

import asyncio
import math
import re
import sys
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic
from typing import ClassVar
from unittest.mock import Mock, call, patch

import msgspec
import pytest
from textual.pilot import Pilot

from imud.cli import top
from imud.client.feed import News, Wish
from imud.contracts.status import DeviceState
from imud.model.event import Event, EventKind
from imud.model.sample import Sync
from imud.model.units import NS_PER_S
from tests.cli.conftest import Cli
from tests.client.news import Listener
from tests.support.metrics import device
from tests.support.socket_rig import batch, daemon, sample

SIZE = (80, 24)
LOOK_S, LOOKS = 0.01, 6000
OFFSET_NS = 1_790_000_000_000_000_000  # 2026-09-21 14:13:20 UTC
NEWS = News(
    statuses=(
        device("bow", 0), device("stern", 1, state=DeviceState.MISSING, problem="/dev/ttyUSB1 is not there"),
        device("mast", 2),
    ),
    clients=2,
    now_ns=sample().t_ns + 250_000_000,
    samples=(msgspec.structs.replace(sample("bow"), euler_rad=(0.5, -0.25, 3.0)), sample("mast")),
)  # fmt: skip

Steps = Callable[[Pilot[None], top.TopApp], Awaitable[None]]


def lines(app: top.TopApp) -> list[str]:
    strips = app.screen._compositor.render_strips()
    return ["".join(segment.text for segment in strip).rstrip() for strip in strips]


class SilentFeed(top.TopFeed):
    looked_at: ClassVar[list[str | None]] = []
    closes = 0

    def __init__(self) -> None:
        super().__init__("")
        self.start = Mock()  # type: ignore[method-assign]

    def look_at(self, device: str | None) -> None:
        self.looked_at.append(device)

    def close(self) -> None:
        self.closes += 1


def played(steps: Steps, feed: top.TopFeed | None = None) -> Callable[[], None]:
    def test() -> None:
        async def run() -> None:
            silent = SilentFeed()
            app = top.TopApp(feed or silent)
            async with app.run_test(size=SIZE) as pilot:
                await pilot.pause()
                await steps(pilot, app)
            assert feed or silent.closes == 1

        asyncio.run(run())

    return test


async def give(pilot: Pilot[None], app: top.TopApp, news: News = NEWS) -> list[str]:
    app.post_message(top.NewsCame(news))
    return await settled(pilot, app)


async def press(pilot: Pilot[None], app: top.TopApp, *keys: str) -> list[str]:
    for key in keys:
        await pilot.press(key)
    return await settled(pilot, app)


async def settled(pilot: Pilot[None], app: top.TopApp) -> list[str]:
    before: list[str] = []
    for _ in range(LOOKS):
        await pilot.pause(LOOK_S)
        if before == (now := lines(app)):
            return now
        before = now
    pytest.fail("the screen does not come to rest")


def devices_in(text: list[str]) -> list[str]:
    return [line.split()[0] for line in text if line.startswith(("bow", "stern", "mast"))]


@played
async def test_the_table_has_every_device_and_fits_80_columns(pilot: Pilot[None], app: top.TopApp) -> None:
    text = await give(pilot, app)
    assert text[0] == "1 of 3 devices has a problem: stern (missing). 2 clients  by DEVICE"
    assert devices_in(text) == ["bow", "mast", "stern"]
    assert next(line for line in text if line.startswith("bow")).split()[:7] == [
        "bow", "ok", "999.5", "0.25s", "4066", "12", "28.6",
    ]  # fmt: skip
    assert max(map(len, text)) <= SIZE[0]
    gone = tuple(device(f"left-outrigger-{one}", state=DeviceState.MISSING, problem="x") for one in range(10))
    text = await give(pilot, app, News(statuses=gone, clients=1))
    assert " ".join(text[:4]).startswith(
        "10 of 10 devices have a problem: left-outrigger-0 (missing), left-outrigger-1"
    )
    assert "left-outrigger-4 (missing) and 5 more. 1 client  by DEVICE" in " ".join(text[:4])
    assert (sum(line.startswith("left-…er-") for line in text), max(map(len, text))) == (10, 78)


@played
async def test_keys_sort_reverse_and_filter(pilot: Pilot[None], app: top.TopApp) -> None:
    await give(pilot, app)
    text = await press(pilot, app, "s")
    assert (text[0].rpartition("by ")[2], devices_in(text)) == ("CONDITION", ["stern", "bow", "mast"])
    text = await press(pilot, app, "s", "r")
    assert (text[0].rpartition("by ")[2], devices_in(text)) == ("HZ backwards", ["bow", "stern", "mast"])
    text = await press(pilot, app, "v")
    assert text[1].split()[1:4] == ["HZ", "EXPECT", "LOST"]
    assert devices_in(await press(pilot, app, "slash", *"usb2")) == ["mast"]
    text = await press(pilot, app, "enter", "r")
    assert (text[0].rpartition("by ")[2], devices_in(text)) == ("HZ  filter: usb2", ["mast"])
    assert sorted(devices_in(await press(pilot, app, "escape"))) == ["bow", "mast", "stern"]


@played
async def test_the_page_of_a_device_has_curves_status_and_its_events(pilot: Pilot[None], app: top.TopApp) -> None:
    await give(pilot, app)
    text = "\n".join(await press(pilot, app, "enter"))
    assert isinstance(app.screen, top.DevicePage)
    assert [words for words in ("roll        28.65 °", "accel z      9.75 m/s²") if words not in text] == []
    assert "mag x" not in text, "what it does not send takes no line"
    events = (Event(5, "bow", EventKind.UP, "is there"), Event(6, "mast", EventKind.UP, "too"))
    text = "\n".join(await give(pilot, app, NEWS._replace(events=events)))
    written = re.search(r"^(\S+) info    bow: up: is there$", text, re.MULTILINE)
    assert written is not None, "as `imud events` prints it"
    since_start = datetime.now().astimezone() - datetime.fromisoformat(written[1])
    assert since_start.total_seconds() == pytest.approx(monotonic(), abs=60), "5 ns after the host's start"
    assert "mast" not in text
    await press(pilot, app, "escape")
    assert isinstance(app.screen, top.Overview)
    assert SilentFeed.looked_at[-2:] == ["bow", None], "more samples of the device while its page is shown"
    app.push_screen(page := top.DevicePage("bow"))
    await pilot.pause()
    await app.pop_screen()
    page.begin()  # Textual calls it after a refresh, which can be after the user closed the page
    await press(pilot, app, "enter")
    lines_of_page = await give(pilot, app, News(statuses=(device("mast", 2),)))
    assert any("bow is no longer in the configuration" in line for line in lines_of_page)


@played
async def test_a_pause_leaves_the_picture_and_a_lost_daemon_is_named(pilot: Pilot[None], app: top.TopApp) -> None:
    await give(pilot, app)
    assert "PAUSED" in (await press(pilot, app, "p"))[0]
    assert devices_in(await give(pilot, app, News(statuses=()))) == ["bow", "mast", "stern"]
    assert devices_in(await press(pilot, app, "p")) == []
    assert (await give(pilot, app, News("no daemon at [u]")))[0] == "no daemon at [u]"
    text = await give(pilot, app, News(statuses=(device("[u]bow", 0, problem="no [u]"),)))
    assert any(line.startswith("[u]bow ") for line in text)
    assert any("no [u]" in line for line in await press(pilot, app, "enter"))


@played
async def test_help_shows_the_keys_and_leaves_the_rows_as_they_are(pilot: Pilot[None], app: top.TopApp) -> None:
    before = await give(pilot, app)
    shown = await press(pilot, app, "question_mark")
    assert shown[:3] == before[:3], "head and row are as wide as without"
    await press(pilot, app, "question_mark")
    assert any("Reverse" in line for line in (await press(pilot, app, "question_mark"))[:-1])
    assert not any("Reverse" in line for line in (await press(pilot, app, "question_mark"))[:-1])


@pytest.mark.live
def test_without_a_daemon_it_says_so(tmp_path: Path) -> None:
    async def steps(pilot: Pilot[None], app: top.TopApp) -> None:
        while not lines(app)[0].startswith("no daemon at"):
            await pilot.pause(LOOK_S)
        assert f"{tmp_path}/nobody" in "".join(lines(app)[:3])

    played(steps, top.TopFeed(str(tmp_path / "nobody")))()


def test_what_a_device_sends_cannot_write_to_the_terminal() -> None:
    line = top.event_line(Event(5_250_000_000, "bow", EventKind.UP, "\x1b[2J\nred"), OFFSET_NS)
    time, _, rest = line.partition(" ")
    assert datetime.fromisoformat(time) == datetime(2026, 9, 21, 14, 13, 25, 250_000, UTC)
    assert rest == r"info    bow: up: \x1b[2J\nred"
    assert len(top.event_line(Event(0, "bow", EventKind.UP, 1000 * "x"), OFFSET_NS)) == 256


@pytest.mark.live
def test_status_samples_and_events_come_also_after_a_restart_of_the_daemon(tmp_path: Path) -> None:
    heard = Listener()
    with daemon(tmp_path) as served:
        feed = top.TopFeed(str(served.path))
        feed.look_at("imu1")
        feed.start(heard.on_news)
        first = heard.wait_for(lambda news: news.statuses)
        assert first.statuses is not None
        assert [status.name for status in first.statuses] == ["imu0", "imu1"]
        assert (first.clients, first.problem) == (1, "")
        served.do(lambda server: server.publish(batch("imu0", 1)))
        served.do(lambda server: server.publish(batch("imu1", 2)))
        assert {one.device for one in heard.wait_for(lambda news: news.samples).samples} == {"imu1"}
        feed.look_at(None)
        heard.wait_for(lambda news: news.now_ns)
        heard.wait_for(lambda news: news.now_ns)
        served.do(lambda server: server.publish(batch("imu0", 7)))
        assert heard.wait_for(lambda news: news.samples).samples[-1].seq == 7
        served.do(lambda server: server.event(Event(5, "imu1", EventKind.UP, "is there")))
        assert heard.wait_for(lambda news: news.events).events[0].message == "is there"
    assert str(served.path) in heard.wait_for(lambda news: news.problem).problem
    with daemon(tmp_path):
        assert not heard.wait_for(lambda news: news.statuses).problem
        feed.close()
        feed.close()


def test_without_a_terminal_or_the_library_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    words = "imud top needs a terminal; for files and pipes, use `imud status` or `imud watch`"
    assert cli("top", status=2).err == f"imud top: {words}\n"
    for stream in (sys.stdin, sys.stdout):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setitem(sys.modules, "textual.app", None)
    monkeypatch.delitem(sys.modules, "imud.cli.top", raising=False)
    cli.refuses(" install 'imud[top]'", "top")


def test_curves_of_the_last_minute_of_one_start_and_devices_come_and_go_and_vectors_have_a_length() -> None:
    history = top.DeviceHistory(device("imu0"))
    history.add(msgspec.structs.replace(sample(), euler_rad=(math.pi, 0.0, -math.pi / 2), mag_t=(2e-5, 0.0, -4e-5)))
    shown = {series.curve.name: (series.values, series.curve.unit) for series in history.series()}
    assert (list(shown), shown["roll"]) == ([curve.name for curve in top.CURVES], ([180.0], "°"))
    assert (shown["yaw"], shown["accel z"]) == (([-90.0], "°"), ([9.75], "m/s²"))
    assert shown["gyro x"][0] + shown["mag z"][0] == pytest.approx([14.3239449, -40.0])
    history = top.DeviceHistory(device("imu0"))
    history.add(msgspec.structs.replace(sample(), accel_m_s2=(math.nan, 0.0, math.inf), gyro_rad_s=None))
    values = {series.curve.name: series.values for series in history.series()}
    assert values["accel x"] == values["accel z"] == values["gyro x"] == values["mag x"] == []
    assert values["accel y"] == [0.0]
    history = top.DeviceHistory(device("imu0"))
    for seq in range(1, 1300):
        history.add(sample(seq=seq))
    assert len(history.series()[3].values) == 1200
    newest = history.newest
    assert newest is not None
    history.add(msgspec.structs.replace(newest, t_ns=newest.t_ns + 60 * NS_PER_S + 1))
    assert len(history.series()[3].values) == 1
    history = top.DeviceHistory(device("imu0"))
    history.add(sample(seq=50))
    history.add(sample(seq=1))
    assert (len(history.series()[3].values), history.newest) == (1, sample(seq=1))
    feed = top.TopFeed("")
    with patch.object(feed, "want") as want:
        feed.look_at("bow")
        feed.look_at(None)
    assert want.call_args_list == [call(Wish(("bow",), 20.0)), call(Wish(rate_hz=4.0))]
    fleet = top.DeviceHistories()
    fleet.add(sample("bow"))  # device without a status
    fleet.update([device("stern"), device("bow")], 3)
    assert list(fleet.devices) == ["stern", "bow"]
    assert fleet.devices["bow"].newest is None
    fleet.add(sample("bow"))
    fleet.update([device("bow", 1, rate_hz=5.0)], 2)
    assert list(fleet.devices) == ["bow"]
    assert fleet.devices["bow"].newest == sample("bow")
    assert (fleet.devices["bow"].status.rate_hz, fleet.clients) == (5.0, 2)
    for vector, length in [((3.0, 0.0, 4.0), 5.0), (None, None), ((math.nan, 1.0, 1.0), None)]:
        assert top.norm(vector) == length


NOW_NS = sample().t_ns + NS_PER_S // 4


def history(name: str = "imu0", number: int = 0, **changes: object) -> top.DeviceHistory:
    one = top.DeviceHistory(device(name, number, **changes))
    one.add(msgspec.structs.replace(sample(name), euler_rad=(0.5, -0.25, 3.0)))
    return one


def test_a_row_has_its_values_below_their_titles() -> None:
    columns = top.VIEWS["motion"]
    assert top.head(columns) == "DEVICE     CONDITION     HZ   AGE  LOST   ±µs  ROLL° PITCH°   YAW°   |a|  |ω|°"
    assert top.row(history(), columns, NOW_NS) == (
        "imu0       ok         999.5 0.25s  4066    12   28.6  -14.3  171.9  9.76  53.6"
    )
    values = "999.5 1000.2  4066   1015  1016  1017  1018 1022  1010     3  36.5"
    assert top.row(history(), top.VIEWS["losses"], NOW_NS) == f"imu0        {values}"
    values = "-40.00    30.0    5.0  500.0      2      0      0"
    assert top.row(history(), top.VIEWS["clock"], NOW_NS) == f"imu0       regre    12   {values}"
    assert (
        top.row(top.DeviceHistory(device("imu0")), top.VIEWS["clock"], NOW_NS) == f"imu0       -         -   {values}"
    )
    words = top.row(top.DeviceHistory(device("imu0", state=DeviceState.MISSING)), top.VIEWS["motion"], NOW_NS).split()
    assert words == ["imu0", "missing", "999.5", "-", "4066", "-", "-", "-", "-", "-", "-"]


@pytest.mark.parametrize("value", [1e-9, 12.3456, 9_999_999.0, 1e15])
def test_every_row_is_as_wide_as_its_titles_and_fits_80_columns(value: float) -> None:
    ledger = dict.fromkeys(device("x").ledger, int(value))
    one = history(
        "a-name-that-is-much-longer-than-the-column", ledger=ledger, rate_hz=value, temperature_c=-value,
        expected_rate_hz=value, connects=int(value), state=DeviceState.SEARCHING,
    )  # fmt: skip
    changed = msgspec.structs.replace(
        sample(seq=2), euler_rad=(-value,) * 3, accel_m_s2=(value,) * 3, gyro_rad_s=(value,) * 3,
        t_err_ns=int(value * 1000), sync=Sync.REGRESSION,
    )  # fmt: skip
    one.add(changed)
    for columns in top.VIEWS.values():
        text = top.row(one, columns, NOW_NS + int(value) * NS_PER_S)
        assert len(text) <= len(top.head(columns)) <= 78
        assert len(text.split()) == len(columns)


def names(devices: list[top.DeviceHistory]) -> list[str]:
    return [one.status.name for one in devices]


def test_ages_order_and_filter() -> None:
    seconds = (0.0, 9.994, 10.0, 999.9, 1000.0, 59_900.0, 60_000.0, 360_000.0, 8.64e7)
    ages = [top.duration(one) for one in seconds]
    assert ages == ["0.00s", "9.99s", "10s", "1000s", "17m", "998m", "17h", "4d", "1000d"]
    devices = [history("b", 1), history("c", 0, state=DeviceState.FAILED), history("a", 2)]
    for order, backwards, expected in [
        (top.NAME, False, "abc"), (top.NAME, True, "cba"), (top.RATE, False, "abc"), (top.LOST, True, "cba"),
        (top.CONDITION, False, "cab"),
    ]:  # fmt: skip
        assert names(top.chosen(devices, order, NOW_NS, backwards=backwards)) == list(expected), order
    devices = [history("a"), top.DeviceHistory(device("b"))]
    assert names(top.chosen(devices, top.AGE, NOW_NS)) == ["b", "a"], "a device without samples is the oldest"
    devices = [history("bow", 0), history("stern", 1, problem="has no power")]
    for words, found in {
        "": ["bow", "stern"], "BOW": ["bow"], "ttyusb1": ["stern"], "hi13 ok": ["bow"], "bow stern": [],
        "hi13 /dev": ["bow", "stern"], "power": ["stern"],
    }.items():  # fmt: skip
        assert names(top.chosen(devices, top.NAME, NOW_NS, words=words)) == found, words


def test_old_values_are_not_shown() -> None:
    history = top.DeviceHistory(device("bow"))
    history.add(msgspec.structs.replace(sample("bow"), euler_rad=(0.5, -0.25, 3.0)))
    arrival_ns = sample("bow").t_rx_ns
    values = {}
    for now_ns in (arrival_ns, arrival_ns + NS_PER_S, arrival_ns + NS_PER_S + 1):
        texts = {column.title: column.text(history, now_ns).strip() for columns in top.VIEWS.values()
                 for column in columns}  # fmt: skip
        values[now_ns] = [texts[title] for title in ("ROLL°", "PITCH°", "YAW°", "|a|", "|ω|°", "±µs", "°C", "STAMP")]
        assert texts["AGE"] != top.NONE
    current, limit, old = values.values()
    assert current == limit
    assert top.NONE not in current
    assert set(old) == {top.NONE}
