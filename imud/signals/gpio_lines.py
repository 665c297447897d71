"""Inputs and outputs of GPIO chips.

gpiod requests a line. Edges are then read from the descriptor of the request as the kernel's own structs, for less than
half of what gpiod's objects cost. Nothing is debounced: a debounced edge is stamped when it was believed, not when it
was. Where both edges are asked for, the kernel reads the level only when its interrupt thread runs, and a short pulse
may become one edge; of a line that tells by its rising edges, only those are asked for.
"""

import asyncio
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from imud.contracts.lines import InputSettings, LineSettings, OnEdges, OnLineEnd, OutputSettings
from imud.errors import LinkError, LinkMissing
from imud.signals.driving import drive_line
from imud.signals.gpio_chips import DEVICES, GONE, Place, find_line, load_gpiod, refusal
from imud.signals.line_events import EVENT, LineEvents

KERNEL_EVENTS: Final = 1024
"""Edges the kernel keeps for a line until they are read, its most: a second of SOUT at 1 kHz."""
READ_EVENTS: Final = 64
CONSUMER_CHARACTERS: Final = 31
"""Longest name of a user of a line that the kernel keeps (GPIO_MAX_NAME_SIZE - 1)."""


class _Line:
    """A line that can be requested and released."""

    def __init__(self, settings: LineSettings, purpose: str, devices: Path) -> None:
        """`purpose` is what other programs are told that imud needs the line for."""
        self._settings = settings
        self._purpose = purpose
        self._devices = devices
        self._request: Any = None
        self._place = Place(settings.chip, -1, "")
        self._fd = -1
        self.title = f"{settings.chip} line {settings.line}".lstrip()

    def _open(self, config: Callable[[Any], Any], events: int | None) -> None:
        """Find and request the line. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        gpiod = load_gpiod()
        place = find_line(gpiod, self._settings, self._devices)
        consumer = f"imud {self._purpose}".strip()[:CONSUMER_CHARACTERS]
        try:
            self._request = gpiod.request_lines(
                place.path, {place.offset: config(gpiod)}, consumer, event_buffer_size=events
            )
        except OSError as error:
            raise refusal(gpiod, error, place) from error
        self._place, self._fd = place, self._request.fd
        self.title = str(place)

    def _release(self) -> None:
        request, self._request, self._fd = self._request, None, -1
        if request is not None:
            request.release()

    def _trouble(self, error: OSError) -> LinkError:
        """The LinkError for a request that does not do what it did."""
        if error.errno in GONE:
            return LinkMissing(f"{self.title} is gone ({os.strerror(error.errno or 0)}): was an adapter pulled out?")
        return LinkError(f"{self.title} cannot be used: {os.strerror(error.errno or 0)}")


class GpioInput(_Line):
    """An `InputLine` of a GPIO chip."""

    def __init__(
        self, settings: InputSettings, purpose: str = "", rising_only: bool = False, *, devices: Path = DEVICES
    ) -> None:
        super().__init__(settings, purpose, devices)
        self._edges = "RISING" if rising_only else "BOTH"
        self._bias = settings.bias.replace("-", "_").upper()
        self._events = LineEvents()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_edges: OnEdges | None = None
        self._on_end: OnLineEnd | None = None

    @property
    def edges_lost(self) -> int:
        """Edges that the kernel dropped because they were not read in time."""
        return self._events.lost

    def open(self) -> None:
        """Request the line; edges count from now on. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        self._open(self._config, KERNEL_EVENTS)
        os.set_blocking(self._fd, False)
        self._events.restart()

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        """Deliver edges from now on, and those since `open`; without `watch` only when `drain` is called."""
        self._on_edges, self._on_end = on_edges, on_end
        self._loop = asyncio.get_running_loop()
        if watch:
            self._loop.add_reader(self._fd, self.drain)

    def drain(self) -> None:
        """Deliver what the kernel has. Costs one system call where it has nothing."""
        if self._on_edges is None:
            return
        for _ in range(KERNEL_EVENTS // READ_EVENTS):  # and no more: a wire that floats must not hold up the rest
            try:
                data = os.read(self._fd, READ_EVENTS * EVENT.size)
            except BlockingIOError:
                return
            except OSError as error:
                self._end(self._trouble(error))
                return
            self._on_edges(self._events.edges(data))
            if len(data) < READ_EVENTS * EVENT.size or self._on_edges is None:
                return

    def level(self) -> bool:
        """Whether the line is active now. Raises LinkMissing, LinkError."""
        if self._request is None:
            raise LinkError(f"{self.title} is not open")
        try:
            return bool(self._request.get_value(self._place.offset))
        except OSError as error:
            raise self._trouble(error) from error

    def close(self) -> None:
        """Release the line; may be called twice."""
        if self._loop is not None:
            self._loop.remove_reader(self._fd)
        self._loop = self._on_edges = self._on_end = None
        self._release()

    def _end(self, error: LinkError) -> None:
        on_end = self._on_end
        self.close()
        if on_end is not None:
            on_end(error)

    def _config(self, gpiod: Any) -> Any:
        line = gpiod.line
        return gpiod.LineSettings(
            direction=line.Direction.INPUT,
            edge_detection=getattr(line.Edge, self._edges),
            event_clock=line.Clock.MONOTONIC,
            bias=getattr(line.Bias, self._bias),
            active_low=self._settings.active_low,
        )


class GpioOutput(_Line):
    """An `OutputLine` of a GPIO chip. Between `open` and `close` any one thread may drive it."""

    def __init__(
        self,
        settings: OutputSettings,
        purpose: str = "",
        *,
        devices: Path = DEVICES,
        drive: Callable[[int, bool], None] | None = None,
    ) -> None:
        """`drive` sets the level of the line of a request's descriptor; without one it is the kernel's."""
        super().__init__(settings, purpose, devices)
        self._open_drain = settings.open_drain
        self._drive = drive or drive_line

    def open(self) -> None:
        """Request the line as an output, inactive from its first moment. Raises as `GpioInput.open`."""
        self._open(self._config, None)

    def set(self, active: bool) -> None:
        """Drive it. Raises LinkMissing, LinkError."""
        if self._request is None:
            raise LinkError(f"{self.title} is not open")
        try:
            self._drive(self._fd, active)
        except OSError as error:
            raise self._trouble(error) from error

    def close(self) -> None:
        """Make it inactive and release it; may be called twice."""
        with suppress(OSError):  # the chip is gone, and the line with it
            if self._request is not None:
                self._drive(self._fd, False)
        self._release()

    def _config(self, gpiod: Any) -> Any:
        line = gpiod.line
        return gpiod.LineSettings(
            direction=line.Direction.OUTPUT,
            output_value=line.Value.INACTIVE,
            drive=line.Drive.OPEN_DRAIN if self._open_drain else line.Drive.PUSH_PULL,
            active_low=self._settings.active_low,
        )
