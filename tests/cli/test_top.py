"""Screens of `imud top` in a terminal of 80 columns without output, controlled by keys."""

import asyncio
import re
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic
from typing import ClassVar

import msgspec
import pytest
from textual.pilot import Pilot

from imud.cli.top import TEXT_MAX, DevicePage, NewsCame, Overview, TopApp, TopFeed, event_line
from imud.client.feed import News
from imud.contracts.status import DeviceState
from imud.model.event import Event, EventKind
from tests.support.metrics import device
from tests.support.socket_rig import sample

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

Steps = Callable[[Pilot[None], TopApp], Awaitable[None]]


def lines(app: TopApp) -> list[str]:
    strips = app.screen._compositor.render_strips()
    return ["".join(segment.text for segment in strip).rstrip() for strip in strips]


class SilentFeed(TopFeed):
    looked_at: ClassVar[list[str | None]] = []

    def __init__(self) -> None:
        super().__init__("")

    def start(self, on_news: Callable[[News], None]) -> None:
        pass

    def look_at(self, device: str | None) -> None:
        self.looked_at.append(device)

    def close(self) -> None:
        pass


def played(steps: Steps, feed: TopFeed | None = None) -> Callable[[], None]:
    def test() -> None:
        async def run() -> None:
            app = TopApp(feed or SilentFeed())
            async with app.run_test(size=SIZE) as pilot:
                await pilot.pause()
                await steps(pilot, app)

        asyncio.run(run())

    return test


async def give(pilot: Pilot[None], app: TopApp, news: News = NEWS) -> list[str]:
    app.post_message(NewsCame(news))
    return await settled(pilot, app)


async def press(pilot: Pilot[None], app: TopApp, *keys: str) -> list[str]:
    for key in keys:
        await pilot.press(key)
    return await settled(pilot, app)


async def settled(pilot: Pilot[None], app: TopApp) -> list[str]:
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
async def test_the_table_has_every_device_and_fits_80_columns(pilot: Pilot[None], app: TopApp) -> None:
    text = await give(pilot, app)
    assert text[0] == "1 of 3 devices has a problem: stern (missing). 2 clients  by DEVICE"
    assert devices_in(text) == ["bow", "mast", "stern"]
    assert next(line for line in text if line.startswith("bow")).split()[:7] == [
        "bow", "ok", "999.5", "0.25s", "4066", "12", "28.6",
    ]  # fmt: skip
    assert max(map(len, text)) <= SIZE[0]


@played
async def test_keys_sort_reverse_and_filter(pilot: Pilot[None], app: TopApp) -> None:
    await give(pilot, app)
    text = await press(pilot, app, "s")
    assert (text[0].rpartition("by ")[2], devices_in(text)) == ("CONDITION", ["stern", "bow", "mast"])
    text = await press(pilot, app, "s", "r")
    assert (text[0].rpartition("by ")[2], devices_in(text)) == ("HZ backwards", ["bow", "stern", "mast"])
    text = await press(pilot, app, "v")
    assert text[1].split()[1:4] == ["HZ", "EXPECT", "LOST"]
    assert devices_in(await press(pilot, app, "slash", *"usb2")) == ["mast"]
    assert devices_in(await press(pilot, app, "enter")) == ["mast"]
    assert sorted(devices_in(await press(pilot, app, "escape"))) == ["bow", "mast", "stern"]


@played
async def test_the_page_of_a_device_has_curves_status_and_its_events(pilot: Pilot[None], app: TopApp) -> None:
    await give(pilot, app)
    text = "\n".join(await press(pilot, app, "enter"))
    assert isinstance(app.screen, DevicePage)
    assert "roll        28.65 °" in text
    assert "accel z      9.75 m/s²" in text
    assert "mag x" not in text, "what it does not send takes no line"
    events = (Event(5, "bow", EventKind.UP, "is there"), Event(6, "mast", EventKind.UP, "too"))
    text = "\n".join(await give(pilot, app, NEWS._replace(events=events)))
    written = re.search(r"^(\S+) info    bow: up: is there$", text, re.MULTILINE)
    assert written is not None, "as `imud events` prints it"
    since_start = datetime.now().astimezone() - datetime.fromisoformat(written[1])
    assert since_start.total_seconds() == pytest.approx(monotonic(), abs=60), "5 ns after the host's start"
    assert "mast" not in text
    await press(pilot, app, "escape")
    assert isinstance(app.screen, Overview)
    assert SilentFeed.looked_at[-2:] == ["bow", None], "more samples of the device while its page is shown"
    await press(pilot, app, "enter")
    lines_of_page = await give(pilot, app, News(statuses=(device("mast", 2),)))
    assert any("bow is no longer in the configuration" in line for line in lines_of_page)


@played
async def test_a_pause_leaves_the_picture_and_a_lost_daemon_is_named(pilot: Pilot[None], app: TopApp) -> None:
    await give(pilot, app)
    assert "PAUSED" in (await press(pilot, app, "p"))[0]
    assert devices_in(await give(pilot, app, News(statuses=()))) == ["bow", "mast", "stern"]
    assert devices_in(await press(pilot, app, "p")) == []
    assert (await give(pilot, app, News("no daemon at /x")))[0] == "no daemon at /x"


@played
async def test_help_shows_the_keys_and_leaves_the_rows_as_they_are(pilot: Pilot[None], app: TopApp) -> None:
    before = await give(pilot, app)
    shown = await press(pilot, app, "question_mark")
    assert shown[:3] == before[:3], "head and row are as wide as without"
    await press(pilot, app, "question_mark")
    assert any("Reverse" in line for line in (await press(pilot, app, "question_mark"))[:-1])
    assert not any("Reverse" in line for line in (await press(pilot, app, "question_mark"))[:-1])


@pytest.mark.live
def test_without_a_daemon_it_says_so_and_tries_again(tmp_path: Path) -> None:
    async def steps(pilot: Pilot[None], app: TopApp) -> None:
        while "no daemon at" not in lines(app)[0]:
            await pilot.pause(LOOK_S)

    played(steps, TopFeed(str(tmp_path / "nobody")))()


def test_what_a_device_sends_cannot_write_to_the_terminal() -> None:
    line = event_line(Event(5_250_000_000, "bow", EventKind.UP, "\x1b[2J\nred"), OFFSET_NS)
    time, _, rest = line.partition(" ")
    assert datetime.fromisoformat(time) == datetime(2026, 9, 21, 14, 13, 25, 250_000, UTC)
    assert rest == r"info    bow: up: \x1b[2J\nred"
    assert len(event_line(Event(0, "bow", EventKind.UP, 1000 * "x"), OFFSET_NS)) == TEXT_MAX
