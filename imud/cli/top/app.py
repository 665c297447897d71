"""The screens and keys of `imud top`."""

from collections import deque
from collections.abc import Callable
from typing import ClassVar, Final, Protocol

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.message import Message
from textual.screen import Screen
from textual.widgets import Footer, Input, Label, OptionList, RichLog, Sparkline, Static
from textual.widgets.option_list import Option

from imud.cli.live.events import as_text, printed
from imud.cli.status import WELL, block
from imud.cli.top.history import CURVES, DeviceHistories, DeviceHistory
from imud.cli.top.rows import SORTS, TEXT_MAX, VIEWS, chosen, head, row
from imud.client.feed import News, utc_offset_ns
from imud.event import Event
from imud.log import printable

EVENTS_KEPT: Final = 200


def event_line(event: Event, utc_offset_ns: int) -> str:
    """Format an event as `imud events` does, in one line; `utc_offset_ns` is CLOCK_REALTIME minus CLOCK_MONOTONIC."""
    return as_text(printed(event, utc_offset_ns))[:TEXT_MAX]


class NewsSource(Protocol):
    """What reads the daemon."""

    def start(self) -> None:
        """Begin to read."""
        ...

    def look_at(self, device: str | None) -> None:
        """Read samples of this device only, and more of them; None for all devices."""
        ...

    def close(self) -> None:
        """End."""
        ...


class NewsCame(Message):
    """News of the feed; a few a second."""

    def __init__(self, news: News) -> None:
        super().__init__()
        self.news = news


class TopApp(App[None]):
    """The program. It takes `NewsCame`, from any thread."""

    TITLE = "imud top"
    CSS = """
    #state, #head { height: 1; text-style: bold; }
    #rows { height: 1fr; border: none; padding: 0; scrollbar-size-vertical: 1; }
    #rows > .option-list--option { padding: 0; }
    #filter { height: 1; border: none; padding: 0; display: none; }
    .curve { height: 1; }
    .curve Label { width: 44; }
    .curve Sparkline { width: 1fr; }
    #block { height: auto; margin: 1 0 0 0; }
    #events { height: 6; border-top: solid $secondary; }
    HelpPanel { split: bottom; width: 100%; max-width: 100%; height: 50%; }
    HelpPanel { border-left: none; border-top: solid $secondary; }
    """
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "quit", "Quit"),
        Binding("p,space", "pause", "Pause", key_display="p"),
        Binding("question_mark", "toggle_help", "Help", key_display="?"),
    ]

    def __init__(self, make_feed: Callable[[Callable[[News], None]], NewsSource]) -> None:
        """`make_feed` gets what takes news; from any thread."""
        super().__init__()
        self.fleet = DeviceHistories()
        self.problem = "connecting"
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        self.paused = False
        self.ahead_ns = 0
        """CLOCK_MONOTONIC of the daemon's machine minus that of this one."""
        self._feed = make_feed(self._post)

    def on_mount(self) -> None:
        """Show the table, and start the feed."""
        self.push_screen(Overview())
        self._feed.start()

    def on_unmount(self) -> None:
        """End the feed."""
        self._feed.close()

    def look_at(self, device: str | None) -> None:
        """Show more of this device, less of the others."""
        self._feed.look_at(device)

    def on_news_came(self, message: NewsCame) -> None:
        """Take news and redraw; in a pause the picture stays, and what came meanwhile is in the next one."""
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
        """Draw the screen that is shown."""
        if isinstance(self.screen, TopScreen):
            self.screen.redraw()

    def action_pause(self) -> None:
        """Stop drawing, or go on."""
        self.paused = not self.paused
        self.redraw()

    def action_toggle_help(self) -> None:
        """Show the keys, or hide them."""
        if self.screen.query("HelpPanel"):
            self.action_hide_help_panel()
        else:
            self.action_show_help_panel()

    def state_line(self) -> str:
        """Format how the daemon is."""
        if self.problem:
            return printable(self.problem, TEXT_MAX)
        devices = self.fleet.devices.values()
        well = sum(device.status.state in WELL for device in devices)
        words = f"imud: {well} of {len(devices)} devices well, {self.fleet.clients} client"
        words += "" if self.fleet.clients == 1 else "s"
        return words + ("  PAUSED" if self.paused else "")

    def _post(self, news: News) -> None:
        self.post_message(NewsCame(news))


class TopScreen(Screen[None]):
    """A screen of the program, which is drawn once all its parts are there."""

    is_ready = False

    @property
    def top(self) -> TopApp:
        """The program."""
        assert isinstance(self.app, TopApp)
        return self.app

    def redraw(self) -> None:
        """Draw what the program knows now."""
        if self.is_ready:
            self.draw()

    def begin(self) -> None:
        """Draw for the first time."""
        self.is_ready = True
        self.draw()

    def draw(self) -> None:
        """Draw everything; all parts are there."""
        raise NotImplementedError


class Overview(TopScreen):
    """The table of all devices."""

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
        """State, titles, rows, the words of the filter, keys."""
        yield Static(id="state", markup=False)
        yield Static(id="head", markup=False)
        yield OptionList(id="rows", markup=False)
        yield Input(placeholder="words of name, state, driver, link, problem", id="filter")
        yield Footer()

    def on_mount(self) -> None:
        """Give the keys to the rows."""
        self.query_one("#rows").focus()
        self.begin()

    def draw(self) -> None:
        """Draw what changed; the row that was marked stays so."""
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
        if names == list(lines):
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
        """Draw again after a device's page."""
        self.top.look_at(None)
        self.redraw()

    def on_input_changed(self, event: Input.Changed) -> None:
        """Filter while the words are written."""
        self.words = event.value
        self.redraw()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Keep the filter, and give the keys back to the rows."""
        self.query_one("#rows").focus()
        event.input.display = bool(self.words)

    def action_view(self) -> None:
        """Show the next set of columns."""
        names = list(VIEWS)
        self.view = names[(names.index(self.view) + 1) % len(names)]
        self.redraw()

    def action_sort(self) -> None:
        """Sort by the next column."""
        self.sort = SORTS[(SORTS.index(self.sort) + 1) % len(SORTS)]
        self.redraw()

    def action_reverse(self) -> None:
        """Reverse the order."""
        self.backwards = not self.backwards
        self.redraw()

    def action_filter(self) -> None:
        """Ask for words."""
        words = self.query_one("#filter", Input)
        words.display = True
        words.focus()

    def action_no_filter(self) -> None:
        """Show all devices again."""
        words = self.query_one("#filter", Input)
        words.value = ""
        words.display = False
        self.query_one("#rows").focus()


class DevicePage(TopScreen):
    """One device: its values over the last minute, its whole status, and events as they come."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,backspace", "app.pop_screen", "Back", key_display="esc")]

    def __init__(self, name: str) -> None:
        super().__init__()
        self._device = name
        self._shown: Event | None = None
        """The newest event in the list."""

    def compose(self) -> ComposeResult:
        """State, curves, status, events, keys."""
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
        """Ask for more samples of the device."""
        self.top.look_at(self._device)
        self.call_after_refresh(self.begin)

    def draw(self) -> None:
        """Draw everything."""
        self.query_one("#state", Static).update(self.top.state_line())
        device = self.top.fleet.devices.get(self._device)
        self.query_one("#block", Static).update(
            block(device.status) if device else f"{self._device} is not in the configuration any more"
        )
        self._draw_curves(device)
        self._list_events()

    def _draw_curves(self, device: DeviceHistory | None) -> None:
        series = device.series() if device else []
        for index, _ in enumerate(CURVES):
            line = self.query_one(f"#curve{index}")
            values = series[index].values if series else []
            line.display = bool(values)
            if values:
                curve = series[index].curve
                spread = f"{min(values):.2f} to {max(values):.2f}"
                line.query_one(Label).update(f"{curve.name:<8}{values[-1]:9.2f} {curve.unit:<5}{spread}")
                line.query_one(Sparkline).data = values

    def _list_events(self) -> None:
        events = self.query_one("#events", RichLog)
        fresh = []
        for event in reversed(self.top.events):
            if event is self._shown:
                break
            fresh.append(event)
        for event in reversed(fresh):
            if event.device == self._device:
                events.write(event_line(event, utc_offset_ns(self.top.ahead_ns)))
        self._shown = self.top.events[-1] if self.top.events else None
