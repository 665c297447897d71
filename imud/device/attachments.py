"""Parts of a device next to its link: signals on GPIO lines, a reset line, a data-ready line, a source of UTC.

All of them live by one small contract, so that the device goes through those that exist. They are made here.
"""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from imud.config.model import DeviceConfig
from imud.contracts.command import Action
from imud.contracts.lines import AlarmRanges, LineFactory
from imud.contracts.status import LinesStatus, UtcStatus
from imud.device.health import DeviceEvents
from imud.device.utc import DevicePort, UtcFeed, make_keeper
from imud.host.clock import HostClock
from imud.lines.reset import ResetLine, make_reset
from imud.lines.sync import LineActions, SyncSignals
from imud.model.sample import Sample
from imud.sampling.clock import SampleClock


class Attachment(Protocol):
    """A part of a device next to its link. Synchronization: the loop's thread only."""

    def start(self, clock: SampleClock) -> None:
        """Begin delivery to this clock: the device was found."""
        ...

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Do periodic work, ten times a second while the device's task runs: CLOCK_MONOTONIC and the newest sample."""
        ...

    def stop(self) -> None:
        """End delivery: the device's link ended; may be called twice."""
        ...

    def close(self) -> None:
        """Release everything; may be called twice."""
        ...


@dataclass(frozen=True, slots=True)
class AttachmentHooks:
    """Callbacks from attachments to their device."""

    port: DevicePort
    """The device's port, as far as sentences with UTC need it."""
    on_reset: Callable[[], None]
    """Called right before the reset line is pulsed."""


class Attachments:
    """Attachments of one device. Synchronization: the loop's thread only."""

    def __init__(
        self, config: DeviceConfig, lines: LineFactory, hooks: AttachmentHooks, notices: DeviceEvents, host: HostClock
    ) -> None:
        """Make the attachments that `config` has; `lines` makes the GPIO lines."""
        raise_event = notices.raise_event
        self._utc: UtcFeed | None = make_keeper(config, hooks.port, host)
        self._signals: SyncSignals | None = None
        if config.lines is not None:
            on_pulses = self._utc.on_pulses if self._utc is not None else None
            self._signals = SyncSignals(
                config.name, config.lines, lines, raise_event, host.now_ns, on_pulses=on_pulses,
                follow=host.utc_offset_ns,
            )  # fmt: skip
        self._reset: ResetLine | None = make_reset(
            config.name, config.lines, lines, raise_event, host.now_ns, hooks.on_reset
        )
        self._line_actions = LineActions(self._reset, self._signals)
        made: tuple[Attachment | None, ...] = (
            self._signals,
            self._reset,
            self._utc,
        )
        self._present = [one for one in made if one is not None]
        self.drain_edges: Callable[[], None] | None = self._signals.drain if self._signals is not None else None
        """Gives the clock all edges that the kernel has; None without lines. To be called before bytes are decoded."""

    def add(self, attachment: Attachment) -> None:
        """Add an attachment."""
        self._present.append(attachment)

    # --- the contract, for all of them -------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """Start all attachments: the device was found."""
        for one in self._present:
            one.start(clock)

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Call `tick` of all attachments, ten times a second."""
        for one in self._present:
            one.tick(now_ns, newest)

    def stop(self) -> None:
        """Stop all attachments: the device's link ended; may be called twice."""
        for one in self._present:
            one.stop()

    def close(self) -> None:
        """Release everything; may be called twice."""
        for one in self._present:
            one.close()

    # --- signals -----------------------------------------------------------------------------------------------------

    def set_alarm_ranges(self, ranges: AlarmRanges | None) -> None:
        """Set what ALARM should indicate by the device's settings; None: not known, and not checked."""
        if self._signals is not None:
            self._signals.set_alarm_ranges(ranges)

    def lines_status(self) -> LinesStatus | None:
        """Return the status of the lines; None for a device without lines."""
        return self._signals.status(self._reset) if self._signals is not None else None

    def utc_status(self) -> UtcStatus | None:
        """Return the status of UTC; None for a device without."""
        return self._utc.status() if self._utc is not None else None

    # --- the reset line ----------------------------------------------------------------------------------------------

    async def reset_settled(self) -> None:
        """Return when no reset is going on and the device had the time it needs after one."""
        if self._reset is not None:
            await self._reset.settled()

    def device_found(self) -> None:
        """Note that samples of the device come."""
        if self._reset is not None:
            self._reset.found()

    async def device_not_found(self, now_ns: int) -> None:
        """Note that a round of search ended without the device: reset it by its line, if due."""
        if self._reset is not None:
            await self._reset.not_found(now_ns)

    @property
    def can_reset(self) -> bool:
        """Whether there is a reset line."""
        return self._reset is not None

    # --- actions -----------------------------------------------------------------------------------------------------

    @property
    def actions(self) -> Mapping[str, Action]:
        """Actions by GPIO lines, which any device can have, by name."""
        return self._line_actions.rows

    def run_action(self, name: str, arguments: Mapping[str, Any]) -> Awaitable[object]:
        """Run one of `actions`. Raises BadArgument, CommandError."""
        return self._line_actions.run(name, arguments)
