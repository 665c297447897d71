"""Attachments of a device: GPIO lines, reset line and data-ready line, and the feed of UTC.

All attachments have the same methods, so that the device calls them in one loop.
"""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final, Protocol

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.command import Verb
from imud.contracts.driver import Driver
from imud.contracts.lines import AlarmRanges, LineFactory
from imud.contracts.link import DeviceLink
from imud.contracts.status import LinesStatus, UtcStatus
from imud.device.health import DeviceEvents
from imud.device.utc import UtcFeed, make_utc_feed
from imud.host.clock import HostClock
from imud.lines.reset import ResetLine, make_reset
from imud.lines.sync import LineVerbs, SyncSignals
from imud.model.event import EventKind
from imud.model.sample import Sample
from imud.sampling.clock import SampleClock


class Attachment(Protocol):
    """A part of a device next to its link. Synchronization: the loop's thread only."""

    def start(self, clock: SampleClock) -> None:
        """Start to work with this clock: imud has found the device."""
        ...

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Do periodic work at each tick of the device. `now_ns` is CLOCK_MONOTONIC."""
        ...

    def stop(self) -> None:
        """Stop to work with the clock: the link of the device ended. A second call does nothing."""
        ...

    def close(self) -> None:
        """Release all resources. A second call does nothing."""
        ...


class Attachments:
    """Attachments of one device. Synchronization: the loop's thread only."""

    def __init__(
        self, config: DeviceConfig, lines: LineFactory, link: DeviceLink, events: DeviceEvents, host: HostClock
    ) -> None:
        """Create the configured attachments. `lines` opens the GPIO lines, `link` is the transport of the device."""
        self._config = config
        self._events = events
        self._host = host
        raise_event = events.raise_event
        self._utc: UtcFeed | None = make_utc_feed(config, link, host)
        self._signals: SyncSignals | None = None
        if config.lines is not None:
            self._signals = SyncSignals(config.name, config.lines, lines, raise_event, host, self._utc)
        self._reset: ResetLine | None = make_reset(config.name, config.lines, lines, raise_event, host, link)
        self._line_verbs = LineVerbs(self._reset, self._signals)
        # differences between the GPIO lines and the device settings, by the key of the line
        self._differences: Mapping[str, str] = {}
        made: tuple[Attachment | None, ...] = (self._signals, self._reset, self._utc)
        self._present = [one for one in made if one is not None]
        self.needs_ticks: Final = bool(self._present)
        """Whether GPIO lines or a source of UTC need ten ticks per second."""
        self.drain_edges: Callable[[], None] | None = self._signals.drain if self._signals is not None else None
        """Passes all edges in the kernel's buffer to the clock. Call it before the codec decodes bytes. None if the
        device has no GPIO lines."""

    def add(self, attachment: Attachment) -> None:
        self._present.append(attachment)

    # --- all attachments ---------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        for one in self._present:
            one.start(clock)

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        for one in self._present:
            one.tick(now_ns, newest)

    def stop(self) -> None:
        for one in self._present:
            one.stop()

    def close(self) -> None:
        for one in self._present:
            one.close()

    # --- GPIO lines --------------------------------------------------------------------------------------------------

    def set_alarm_ranges(self, ranges: AlarmRanges | None) -> None:
        """Set the ranges that the line ALARM indicates. With None imud does not check the line."""
        if self._signals is not None:
            self._signals.set_alarm_ranges(ranges)

    def compare_settings(self, settings: Mapping[str, Any], driver: Driver | None) -> None:
        """Compare the GPIO lines with the values of the device settings. Raise an event for each new difference."""
        lines = self._config.lines
        if lines is None:
            return
        read_ranges = driver.alarm_ranges if driver is not None else None
        self.set_alarm_ranges(read_ranges(settings) if read_ranges is not None else None)
        found = driver.line_differences(settings, lines) if driver is not None else {}
        for key, words in found.items():
            if self._differences.get(key) != words:
                message = f"line {key}: {words}"
                self._events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message, line=key)
        self._differences = found

    def lines_status(self) -> LinesStatus | None:
        """Return the status of the GPIO lines; None for a device without lines."""
        if self._signals is None:
            return None
        status = self._signals.status(self._reset)
        if not self._differences:
            return status
        return msgspec.structs.replace(status, problems={**self._differences, **status.problems})

    def utc_status(self) -> UtcStatus | None:
        """Return the status of the UTC feed; None for a device without UTC feed."""
        return self._utc.status() if self._utc is not None else None

    def utc_problem(self) -> str:
        """Return the present fault of the UTC feed; empty if there is no fault."""
        return self._utc.problem if self._utc is not None else ""

    # --- the reset line ----------------------------------------------------------------------------------------------

    async def reset_settled(self) -> None:
        """Return when no reset is in progress and the start-up time of the device has passed."""
        if self._reset is not None:
            await self._reset.settled()

    def device_found(self) -> None:
        """Note that samples of the device arrive."""
        if self._reset is not None:
            self._reset.found()

    async def device_not_found(self, now_ns: int) -> None:
        """Note that a search round did not find the device. Reset the device by its line if this is due."""
        if self._reset is not None:
            await self._reset.not_found(now_ns)

    @property
    def can_reset(self) -> bool:
        """Whether the device has a reset line."""
        return self._reset is not None

    # --- verbs -----------------------------------------------------------------------------------------------------

    @property
    def verbs(self) -> Mapping[str, Verb]:
        """Verbs with GPIO lines by name. They do not depend on the driver."""
        return self._line_verbs.rows

    def run_verb(self, name: str, arguments: Mapping[str, Any]) -> Awaitable[object]:
        """Run one of `verbs`. Raises BadArgument or CommandError."""
        return self._line_verbs.run(name, arguments)
