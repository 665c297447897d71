"""`imud top`: full-screen view of all devices. The module needs the extra `top`."""

import argparse
import math
import sys
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from math import inf
from typing import ClassVar, Final, NamedTuple

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.message import Message
from textual.screen import Screen
from textual.widgets import Footer, Input, Label, OptionList, RichLog, Sparkline, Static
from textual.widgets.option_list import Option

from imud.cli.arguments import CliCommand, add_socket
from imud.cli.events import as_text, printed
from imud.cli.output import fitted, shortened
from imud.cli.status import block
from imud.client.feed import Feed, News, Wish, utc_offset_ns
from imud.contracts.condition import Condition, summary
from imud.contracts.status import DeviceStatus
from imud.host.log import printable
from imud.model.errors import BadArgument
from imud.model.event import Event
from imud.model.ledger import lost
from imud.model.sample import Sample, Vector3
from imud.model.staleness import is_stale
from imud.model.units import NS_PER_S, NS_PER_US, RAD_PER_DEG, T_PER_UT

POINTS_MAX: Final = 1200  # maximum number of stored samples of a device: one minute at 20 Hz
SPAN_NS: Final = 60 * NS_PER_S  # maximum age of shown samples, ns


class Curve(NamedTuple):
    """Curve of one value on the page of a device."""

    name: str
    unit: str
    # Returns the value of a sample in `unit`; None if the sample does not contain it
    value: Callable[[Sample], float | None]


def _part(member: str, index: int, unit: float) -> Callable[[Sample], float | None]:
    def value(sample: Sample) -> float | None:
        vector: Sequence[float] | None = getattr(sample, member)
        return None if vector is None or not math.isfinite(vector[index]) else vector[index] / unit

    return value


# Curves on the page of a device, from top to bottom
CURVES: Final = (
    *(Curve(name, "°", _part("euler_rad", index, RAD_PER_DEG)) for index, name in enumerate(("roll", "pitch", "yaw"))),
    *(Curve(f"accel {axis}", "m/s²", _part("accel_m_s2", index, 1.0)) for index, axis in enumerate("xyz")),
    *(Curve(f"gyro {axis}", "°/s", _part("gyro_rad_s", index, RAD_PER_DEG)) for index, axis in enumerate("xyz")),
    *(Curve(f"mag {axis}", "µT", _part("mag_t", index, T_PER_UT)) for index, axis in enumerate("xyz")),
)


class Series(NamedTuple):
    """Values of a curve."""

    curve: Curve
    values: list[float]  # values, oldest first; empty if the device does not send the value


class DeviceHistory:
    """Status and newest samples of one device."""

    def __init__(self, status: DeviceStatus) -> None:
        self.status = status
        self._samples: deque[Sample] = deque(maxlen=POINTS_MAX)

    @property
    def condition(self) -> Condition:
        """Condition of the device."""
        known = self.status.condition
        return known.condition if known is not None else Condition.OK

    @property
    def newest(self) -> Sample | None:
        """Newest sample; None before the first sample."""
        return self._samples[-1] if self._samples else None

    def current(self, now_ns: int) -> Sample | None:
        """Return the newest sample; None if its values are not current, because no new sample arrives."""
        newest = self.newest
        rate_hz = self.status.expected_rate_hz or self.status.rate_hz
        period_ns = round(NS_PER_S / rate_hz) if rate_hz > 0 else 0
        return None if newest is None or is_stale(newest.t_rx_ns, now_ns, period_ns) else newest

    def add(self, sample: Sample) -> None:
        """Add a sample. Remove samples that are too old."""
        samples = self._samples
        if samples and sample.t_ns < samples[-1].t_ns:  # the daemon, or its host, restarted
            samples.clear()
        samples.append(sample)
        while samples[0].t_ns < sample.t_ns - SPAN_NS:
            samples.popleft()

    def series(self) -> list[Series]:
        """Return the values of all curves, in the order of CURVES."""
        found = []
        for curve in CURVES:
            values = (curve.value(sample) for sample in self._samples)
            found.append(Series(curve, [value for value in values if value is not None]))
        return found


class DeviceHistories:
    """Histories of all devices by name, in the order of the configuration."""

    def __init__(self) -> None:
        self.devices: dict[str, DeviceHistory] = {}
        self.now_ns = 0  # CLOCK_MONOTONIC of the newest update, ns
        self.clients = 0  # number of clients of the daemon, including this program

    def update(self, statuses: Iterable[DeviceStatus], clients: int) -> None:
        """Store the status of all devices. Remove devices without a status."""
        before, self.devices = self.devices, {}
        for status in statuses:
            device = before.get(status.name)
            if device is None:
                device = DeviceHistory(status)
            device.status = status
            self.devices[status.name] = device
        self.clients = clients

    def add(self, sample: Sample) -> None:
        """Add a sample. Ignore samples of unknown devices."""
        device = self.devices.get(sample.device)
        if device is not None:
            device.add(sample)


def norm(vector: Vector3 | None) -> float | None:
    """Return the length of a vector; None if the vector is missing or not finite."""
    if vector is None:
        return None
    length = math.hypot(*vector)
    return length if math.isfinite(length) else None


WIDTH: Final = 78  # maximum width of a row, characters: a terminal of 80 columns without the scroll bar
NONE: Final = "-"
NAME_WIDTH: Final = 10
TEXT_MAX: Final = 256
AGE_OLD_S: Final = 999.9  # maximum age that is shown in seconds, s

Number = float | int | None


class OverviewColumn(NamedTuple):
    """Column of the overview."""

    title: str
    width: int
    text: Callable[[DeviceHistory, int], str]  # formats the value of a device at a time (CLOCK_MONOTONIC, ns)
    key: Callable[[DeviceHistory, int], float | str]  # returns the sort key of a device
    is_number: bool = True  # whether the column contains numbers: right-aligned, the largest number first


def _number(
    title: str, width: int, value: Callable[[DeviceHistory, int], Number], show: Callable[[float], str]
) -> OverviewColumn:
    def text(device: DeviceHistory, now_ns: int) -> str:
        found = value(device, now_ns)
        return NONE if found is None else fitted(found, width, show)

    def key(device: DeviceHistory, now_ns: int) -> float:
        found = value(device, now_ns)
        return -inf if found is None else found

    return OverviewColumn(title, width, text, key)


def age_s(device: DeviceHistory, now_ns: int) -> float | None:
    """Return the age of the newest sample, s; None before the first sample."""
    newest = device.newest
    return None if newest is None else max(now_ns - newest.t_ns, 0) / NS_PER_S


def duration(seconds: float) -> str:
    """Format a duration in at most five characters."""
    if seconds < 10:
        return f"{seconds:.2f}s"
    if seconds <= AGE_OLD_S:
        return f"{seconds:.0f}s"
    if seconds < 100 * 3600:
        return f"{seconds / 60:.0f}m" if seconds < 999 * 60 else f"{seconds / 3600:.0f}h"
    return f"{seconds / 86400:.0f}d"


def _angle(index: int) -> Callable[[DeviceHistory, int], Number]:
    def value(device: DeviceHistory, now_ns: int) -> Number:
        newest = device.current(now_ns)
        return None if newest is None or newest.euler_rad is None else newest.euler_rad[index] / RAD_PER_DEG

    return value


def _accel(device: DeviceHistory, now_ns: int) -> Number:
    current = device.current(now_ns)
    return None if current is None else norm(current.accel_m_s2)


def _turn_rate(device: DeviceHistory, now_ns: int) -> Number:
    current = device.current(now_ns)
    found = None if current is None else norm(current.gyro_rad_s)
    return None if found is None else found / RAD_PER_DEG


def _error_us(device: DeviceHistory, now_ns: int) -> Number:
    current = device.current(now_ns)
    return None if current is None else current.t_err_ns / NS_PER_US


def _temperature_c(device: DeviceHistory, now_ns: int) -> Number:
    return None if device.current(now_ns) is None else device.status.temperature_c


def _sync(device: DeviceHistory, now_ns: int) -> str:
    current = device.current(now_ns)
    return "" if current is None else str(current.sync)


def _counted(name: str) -> Callable[[DeviceHistory, int], Number]:
    return lambda device, now_ns: device.status.ledger.get(name, 0)


def _whole(value: float) -> str:
    return f"{value:.0f}"


def _tenths(value: float) -> str:
    return f"{value:.1f}"


def _hundredths(value: float) -> str:
    return f"{value:.2f}"


NAME: Final = OverviewColumn(
    "DEVICE",
    NAME_WIDTH,
    lambda device, now_ns: shortened(printable(device.status.name, TEXT_MAX), NAME_WIDTH),
    lambda device, now_ns: device.status.name,
    is_number=False,
)
CONDITION: Final = OverviewColumn(
    "CONDITION",
    9,
    lambda device, now_ns: device.status.word,
    lambda device, now_ns: f"{list(Condition).index(device.condition)}",
    is_number=False,
)
RATE: Final = _number("HZ", 6, lambda device, now_ns: device.status.rate_hz, _tenths)
AGE: Final = OverviewColumn(
    "AGE",
    5,
    lambda device, now_ns: NONE if (age := age_s(device, now_ns)) is None else duration(age),
    lambda device, now_ns: inf if (age := age_s(device, now_ns)) is None else age,
)
LOST: Final = _number("LOST", 5, lambda device, now_ns: lost(device.status.ledger), _whole)
ERROR: Final = _number("±µs", 5, _error_us, _whole)
SYNC: Final = OverviewColumn(
    "STAMP",
    5,
    lambda device, now_ns: _sync(device, now_ns)[:5] or NONE,
    _sync,
    is_number=False,
)

# Sets of columns by name. Each set has at most WIDTH characters, with one space between two columns.
VIEWS: Final[dict[str, tuple[OverviewColumn, ...]]] = {
    "motion": (
        NAME, CONDITION, RATE, AGE, LOST, ERROR,
        _number("ROLL°", 6, _angle(0), _tenths),
        _number("PITCH°", 6, _angle(1), _tenths),
        _number("YAW°", 6, _angle(2), _tenths),
        _number("|a|", 5, _accel, _hundredths),
        _number("|ω|°", 5, _turn_rate, _tenths),
    ),
    "losses": (
        NAME, RATE,
        _number("EXPECT", 6, lambda device, now_ns: device.status.expected_rate_hz or None, _tenths),
        LOST,
        _number("DEVICE", 6, _counted("lost_gap_device"), _whole),
        _number("DAMAG", 5, _counted("lost_crc"), _whole),
        _number("OVERR", 5, _counted("lost_overrun"), _whole),
        _number("QUEUE", 5, _counted("lost_queue"), _whole),
        _number("UNKN", 4, _counted("lost_unknown"), _whole),
        _number("CRC", 5, _counted("frames_bad_crc"), _whole),
        _number("OPENS", 5, lambda device, now_ns: device.status.connects, _whole),
        _number("°C", 5, _temperature_c, _tenths),
    ),
    "clock": (
        NAME, SYNC, ERROR,
        _number("SKEWppm", 8, lambda device, now_ns: device.status.clock.skew_ppm, _hundredths),
        _number("RESIDµs", 7, lambda device, now_ns: device.status.clock.residual_ns / NS_PER_US, _tenths),
        _number("HOLDms", 6, lambda device, now_ns: device.status.hold_ns / 1e6, _tenths),
        _number("STEER", 6, lambda device, now_ns: device.status.clock.steering_ppm, _tenths),
        _number("RESETS", 6, lambda device, now_ns: device.status.clock.resets, _whole),
        _number("PULSES", 6, lambda device, now_ns: device.status.clock.edges, _whole),
        _number("UNPAIR", 6, lambda device, now_ns: device.status.clock.edges_unpaired, _whole),
    ),
}  # fmt: skip

SORTS: Final = (NAME, CONDITION, RATE, AGE, LOST, ERROR)  # Sort columns. The key `s` selects the next one.


def head(columns: Iterable[OverviewColumn]) -> str:
    """Format the titles of the columns."""
    return _line((column.title, column) for column in columns)


def row(device: DeviceHistory, columns: Iterable[OverviewColumn], now_ns: int) -> str:
    """Format the row of one device."""
    return _line((column.text(device, now_ns), column) for column in columns)


def _line(cells: Iterable[tuple[str, OverviewColumn]]) -> str:
    parts = [
        text[: column.width].rjust(column.width) if column.is_number else text[: column.width].ljust(column.width)
        for text, column in cells
    ]
    return " ".join(parts)


def chosen(
    devices: Iterable[DeviceHistory], sort: OverviewColumn, now_ns: int, *, backwards: bool = False, words: str = ""
) -> list[DeviceHistory]:
    """Return the devices that contain all `words`, sorted; the largest number first.

    The search uses name, condition, reasons, driver, link and identity, and ignores the case.
    """
    wanted = words.casefold().split()
    found = [device for device in devices if all(word in _searched(device) for word in wanted)]
    found.sort(key=lambda device: device.status.name)  # the second sort is stable: equal keys stay sorted by name
    found.sort(key=lambda device: sort.key(device, now_ns), reverse=sort.is_number != backwards)
    return found


def _searched(device: DeviceHistory) -> str:
    status = device.status
    parts = (status.name, str(status.condition), status.driver, status.link, *status.identity.values())
    return " ".join(parts).casefold()


EVENTS_KEPT: Final = 200


def event_line(event: Event, utc_offset_ns: int) -> str:
    """Format an event like `imud events`. `utc_offset_ns` is CLOCK_REALTIME minus CLOCK_MONOTONIC."""
    return as_text(printed(event, utc_offset_ns))[:TEXT_MAX]


OVERVIEW_HZ: Final = 4.0
DEVICE_HZ: Final = 20.0


class TopFeed(Feed):
    """Feed of the screens: all devices at OVERVIEW_HZ, or one device at DEVICE_HZ."""

    def __init__(self, path: str) -> None:
        super().__init__(path, Wish(rate_hz=OVERVIEW_HZ))

    def look_at(self, device: str | None) -> None:
        self.want(Wish(rate_hz=OVERVIEW_HZ) if device is None else Wish((device,), DEVICE_HZ))


class NewsCame(Message):
    """Textual message with news of the feed, a few per second."""

    def __init__(self, news: News) -> None:
        super().__init__()
        self.news = news


class TopApp(App[None]):
    """Textual application. Any thread can post `NewsCame` to it."""

    TITLE = "imud top"
    CSS = """
    #state { height: auto; max-height: 50%; text-style: bold; }
    #head { height: 1; text-style: bold; }
    #rows { height: 1fr; border: none; padding: 0; scrollbar-size-vertical: 1; }
    #rows > .option-list--option { padding: 0; }
    #filter { height: 1; border: none; padding: 0; display: none; }
    .curve { height: 1; }
    .curve Label { width: 44; }
    .curve Sparkline { width: 1fr; }
    #block { height: auto; margin: 1 0 0 0; }
    #events { height: 6; border-top: solid $secondary; }
    HelpPanel { split: bottom; width: 100%; max-width: 100%; height: 50%; border: none; border-top: solid $secondary; }
    """
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "quit", "Quit"),
        Binding("p,space", "pause", "Pause", key_display="p"),
        Binding("question_mark", "toggle_help", "Help", key_display="?"),
    ]

    def __init__(self, feed: TopFeed) -> None:
        super().__init__()
        self.fleet = DeviceHistories()
        self.problem = "connecting"
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        self.paused = False
        self.ahead_ns = 0  # CLOCK_MONOTONIC of the daemon's host minus CLOCK_MONOTONIC of this host, ns
        self._feed = feed

    def on_mount(self) -> None:
        self.push_screen(Overview())
        self._feed.start(self._post)

    def on_unmount(self) -> None:
        self._feed.close()

    def look_at(self, device: str | None) -> None:
        """Read one device at a higher rate, or all devices at the lower rate."""
        self._feed.look_at(device)

    def on_news_came(self, message: NewsCame) -> None:
        """Store news. Redraw the screen, except during a pause."""
        news = message.news
        self.problem = news.problem
        if news.statuses is not None:
            self.fleet.update(news.statuses, news.clients)
        self.fleet.now_ns, self.ahead_ns = news.now_ns, news.ahead_ns
        for sample in news.samples:
            self.fleet.add(sample)
        self.events.extend(news.events)
        if not self.paused:
            self.redraw()

    def redraw(self) -> None:
        if isinstance(self.screen, TopScreen):
            self.screen.redraw()

    def action_pause(self) -> None:
        """Start or end a pause."""
        self.paused = not self.paused
        self.redraw()

    def action_toggle_help(self) -> None:
        """Show or hide the list of keys."""
        if self.screen.query("HelpPanel"):
            self.action_hide_help_panel()
        else:
            self.action_show_help_panel()

    def state_line(self) -> str:
        """Format the problem of the connection, or the state of the daemon."""
        if self.problem:
            return printable(self.problem, TEXT_MAX)
        words = summary({name: device.condition for name, device in self.fleet.devices.items()})
        words += f" {self.fleet.clients} client" + "s" * (self.fleet.clients != 1)
        return words + ("  PAUSED" if self.paused else "")

    def _post(self, news: News) -> None:
        self.post_message(NewsCame(news))


class TopScreen(Screen[None]):
    """Base class of the screens."""

    is_ready = False  # whether all widgets exist

    @property
    def top(self) -> TopApp:
        """Application of the screen."""
        assert isinstance(self.app, TopApp)
        return self.app

    def redraw(self) -> None:
        """Draw the screen if its widgets exist. Textual removes the widgets of a closed screen."""
        if self.is_ready and self.is_current:
            self.draw()

    def begin(self) -> None:
        """Draw the screen for the first time."""
        self.is_ready = True
        self.redraw()

    def draw(self) -> None:
        """Draw the complete screen."""
        raise NotImplementedError


class Overview(TopScreen):
    """Screen with the table of all devices."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("v", "view", "Columns"),
        Binding("s", "sort", "Sort"),
        Binding("r", "reverse", "Reverse"),
        Binding("slash", "filter", "Filter", key_display="/"),
        Binding("escape", "no_filter", "No filter", show=False),
    ]

    def __init__(self) -> None:
        super().__init__()
        self.view = next(iter(VIEWS))
        self.sort = SORTS[0]
        self.backwards = False
        self.words = ""

    def compose(self) -> ComposeResult:
        yield Static(id="state", markup=False)
        yield Static(id="head", markup=False)
        yield OptionList(id="rows", markup=False)
        yield Input(placeholder="words in name, condition, driver, link", id="filter")
        yield Footer()

    def on_mount(self) -> None:
        self.query_one("#rows").focus()
        self.begin()

    def draw(self) -> None:
        """Draw the changes. The marked row stays marked."""
        top, columns = self.top, VIEWS[self.view]
        shown = chosen(
            top.fleet.devices.values(), self.sort, top.fleet.now_ns, backwards=self.backwards, words=self.words
        )
        order = f"  by {self.sort.title}{' backwards' if self.backwards else ''}"
        words = f"  filter: {self.words}" if self.words else ""
        self.query_one("#state", Static).update(top.state_line() + ("" if top.problem else order + words))
        self.query_one("#head", Static).update(head(columns))
        rows = self.query_one("#rows", OptionList)
        lines = {device.status.name: row(device, columns, top.fleet.now_ns) for device in shown}
        names = [str(option.id) for option in rows.options]
        if names == list(lines):  # same order: replacing the texts keeps the scroll position
            for name, line in lines.items():
                rows.replace_option_prompt(name, line)
            return
        marked = rows.highlighted_option.id if rows.highlighted_option is not None else None
        rows.set_options([Option(line, id=name) for name, line in lines.items()])
        if lines:
            rows.highlighted = list(lines).index(marked) if marked in lines else 0

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Open the page of a device."""
        self.app.push_screen(DevicePage(str(event.option.id)))

    def on_screen_resume(self) -> None:
        """Draw again after the page of a device."""
        self.top.look_at(None)
        self.redraw()

    def on_input_changed(self, event: Input.Changed) -> None:
        """Filter the rows while the user types."""
        self.words = event.value
        self.redraw()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Keep the filter and return the focus to the rows."""
        self.query_one("#rows").focus()
        event.input.display = bool(self.words)

    def action_view(self) -> None:
        names = list(VIEWS)
        self.view = names[(names.index(self.view) + 1) % len(names)]
        self.redraw()

    def action_sort(self) -> None:
        self.sort = SORTS[(SORTS.index(self.sort) + 1) % len(SORTS)]
        self.redraw()

    def action_reverse(self) -> None:
        self.backwards = not self.backwards
        self.redraw()

    def action_filter(self) -> None:
        words = self.query_one("#filter", Input)
        words.display = True
        words.focus()

    def action_no_filter(self) -> None:
        words = self.query_one("#filter", Input)
        words.value = ""
        words.display = False
        self.query_one("#rows").focus()


class DevicePage(TopScreen):
    """Screen of one device: values of the last minute, status, and new events."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,backspace", "app.pop_screen", "Back", key_display="esc")]

    def __init__(self, name: str) -> None:
        super().__init__()
        self._device = name
        self._shown: Event | None = None  # newest event in the list

    def compose(self) -> ComposeResult:
        yield Static(id="state", markup=False)
        with VerticalScroll():
            for index, _ in enumerate(CURVES):
                with Horizontal(classes="curve", id=f"curve{index}"):
                    yield Label(markup=False)
                    yield Sparkline()
            yield Static(id="block", markup=False)
        yield RichLog(id="events", max_lines=EVENTS_KEPT, wrap=True)
        yield Footer()

    def on_mount(self) -> None:
        self.top.look_at(self._device)
        self.call_after_refresh(self.begin)

    def draw(self) -> None:
        self.query_one("#state", Static).update(self.top.state_line())
        device = self.top.fleet.devices.get(self._device)
        self.query_one("#block", Static).update(
            block(device.status) if device else f"{self._device} is no longer in the configuration"
        )
        self._draw_curves(device)
        self._list_events()

    def _draw_curves(self, device: DeviceHistory | None) -> None:
        series = device.series() if device else []
        has_value = device is not None and device.current(self.top.fleet.now_ns) is not None
        for index, _ in enumerate(CURVES):
            line = self.query_one(f"#curve{index}")
            values = series[index].values if series else []
            line.display = bool(values)
            if values:
                curve = series[index].curve
                spread = f"{min(values):.2f} to {max(values):.2f}"
                newest = f"{values[-1]:.2f}" if has_value else NONE
                line.query_one(Label).update(f"{curve.name:<8}{newest:>9} {curve.unit:<5}{spread}")
                line.query_one(Sparkline).data = values

    def _list_events(self) -> None:
        events = self.query_one("#events", RichLog)
        # events after the newest shown event, newest first
        fresh = []
        for event in reversed(self.top.events):
            if event is self._shown:
                break
            fresh.append(event)
        for event in reversed(fresh):
            if event.device == self._device:
                events.write(event_line(event, utc_offset_ns(self.top.ahead_ns)))
        self._shown = self.top.events[-1] if self.top.events else None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)


def run(args: argparse.Namespace) -> int:
    """Show the devices until the user presses `q`. Raises BadArgument if imud does not run in a terminal."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise BadArgument("imud top needs a terminal; for files and pipes, use `imud status` or `imud watch`")
    TopApp(TopFeed(args.socket)).run()
    return 0


TOP = CliCommand(add_arguments, run)
