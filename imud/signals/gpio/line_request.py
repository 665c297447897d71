"""Line requests: inputs and outputs of GPIO chips.

gpiod requests a line. Edge events are then read from the request's file descriptor as the kernel's own structs, for
less than half of what gpiod's objects cost. Nothing is debounced: a debounced edge has the time of its acceptance, not
its own. With detection of both edges the kernel reads the level only when its interrupt thread runs, and a short pulse
may become one edge; where only rising edges carry information, only those are requested.
"""

import asyncio
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from imud.contracts.lines import InputSettings, LineSettings, OnEdges, OnLineEnd, OutputSettings
from imud.errors import LinkError, LinkMissing
from imud.signals.gpio.chips import DEVICES, GONE, LineLocation, find_line, load_gpiod, request_error
from imud.signals.gpio.kernel_interface import EVENT, LineEventDecoder, set_line

KERNEL_EVENTS: Final = 1024
"""Capacity of the kernel's event buffer of a line, its maximum: one second of SOUT at 1 kHz."""
READ_EVENTS: Final = 64
"""Events per read."""
CONSUMER_CHARACTERS: Final = 31
"""Longest consumer name that the kernel keeps (GPIO_MAX_NAME_SIZE - 1)."""


class _Line:
    """Request and release of a line."""

    def __init__(self, settings: LineSettings, purpose: str, devices: Path) -> None:
        """`purpose` follows `imud` in the consumer name that other programs see."""
        self._settings = settings
        self._purpose = purpose
        self._devices = devices
        self._request: Any = None
        self._location = LineLocation(settings.chip, -1, "")
        self._fd = -1
        self.title = f"{settings.chip} line {settings.line}".lstrip()

    def _open(self, config: Callable[[Any], Any], events: int | None) -> None:
        """Find and request the line. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        gpiod = load_gpiod()
        location = find_line(gpiod, self._settings, self._devices)
        consumer = f"imud {self._purpose}".strip()[:CONSUMER_CHARACTERS]
        try:
            self._request = gpiod.request_lines(
                location.path, {location.offset: config(gpiod)}, consumer, event_buffer_size=events
            )
        except OSError as error:
            raise request_error(gpiod, error, location) from error
        self._location, self._fd = location, self._request.fd
        self.title = str(location)

    def _release(self) -> None:
        request, self._request, self._fd = self._request, None, -1
        if request is not None:
            request.release()

    def _error(self, error: OSError) -> LinkError:
        """Return the LinkError for a system call that failed on the open request."""
        if error.errno in GONE:
            return LinkMissing(f"{self.title} is gone ({os.strerror(error.errno or 0)}): was an adapter pulled out?")
        return LinkError(f"{self.title} cannot be used: {os.strerror(error.errno or 0)}")


class GpioInput(_Line):
    """Input line of a GPIO chip, an `InputLine`. Synchronization: the loop's thread only."""

    def __init__(
        self, settings: InputSettings, purpose: str = "", rising_only: bool = False, *, devices: Path = DEVICES
    ) -> None:
        super().__init__(settings, purpose, devices)
        self._edges = "RISING" if rising_only else "BOTH"
        self._bias = settings.bias.replace("-", "_").upper()
        self._decoder = LineEventDecoder()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_edges: OnEdges | None = None
        self._on_end: OnLineEnd | None = None

    @property
    def edges_lost(self) -> int:
        """Edges that the kernel dropped because they were not read in time, over all requests."""
        return self._decoder.lost

    def open(self) -> None:
        """Request the line; the kernel buffers its edges. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        self._open(self._config, KERNEL_EVENTS)
        os.set_blocking(self._fd, False)
        self._decoder.restart()

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        """Deliver the edges since `open`, and new ones as they come; without `watch` only when `drain` is called."""
        self._on_edges, self._on_end = on_edges, on_end
        self._loop = asyncio.get_running_loop()
        if watch:
            self._loop.add_reader(self._fd, self.drain)

    def fileno(self) -> int:
        """Return the descriptor of the request; -1 while the line is closed."""
        return self._fd

    def drain(self) -> None:
        """Read and deliver the buffered edges; one system call if there are none. Does not block."""
        if self._on_edges is None:
            return
        for _ in range(KERNEL_EVENTS // READ_EVENTS):  # bounded: a floating wire must not block the loop
            try:
                data = os.read(self._fd, READ_EVENTS * EVENT.size)
            except BlockingIOError:
                return
            except OSError as error:
                self._end(self._error(error))
                return
            self._on_edges(self._decoder.decode(data))
            if len(data) < READ_EVENTS * EVENT.size or self._on_edges is None:
                return

    def level(self) -> bool:
        """Return whether the line is active now. Raises LinkMissing, LinkError."""
        if self._request is None:
            raise LinkError(f"{self.title} is not open")
        try:
            return bool(self._request.get_value(self._location.offset))
        except OSError as error:
            raise self._error(error) from error

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
    """Output line of a GPIO chip, an `OutputLine`. Synchronization: one thread at a time."""

    def __init__(
        self,
        settings: OutputSettings,
        purpose: str = "",
        *,
        devices: Path = DEVICES,
        drive: Callable[[int, bool], None] | None = None,
    ) -> None:
        """`drive` sets the level of the line, from the descriptor of its request; `set_line` if None."""
        super().__init__(settings, purpose, devices)
        self._open_drain = settings.open_drain
        self._drive = drive or set_line

    def open(self) -> None:
        """Request the line as an output that is inactive from the start. Raises as `GpioInput.open`."""
        self._open(self._config, None)

    def set(self, active: bool) -> None:
        """Set the level of the line. Raises LinkMissing, LinkError."""
        if self._request is None:
            raise LinkError(f"{self.title} is not open")
        try:
            self._drive(self._fd, active)
        except OSError as error:
            raise self._error(error) from error

    def close(self) -> None:
        """Set the line inactive and release it; may be called twice."""
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
