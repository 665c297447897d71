"""Relay of the daemon's samples, events and status to a viewer, as messages of a dialect (`imud.bridges`)."""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from threading import Event as ThreadEvent
from time import monotonic, time_ns
from typing import Any, Final, Protocol

import msgspec

from imud.bridges.channel import Diagnoses, Dialect, MessageChannel, MessageFrames, StampedEvent
from imud.bridges.diagnosis import LiveDiagnosis
from imud.bridges.json_channels import status_channel
from imud.client import Client
from imud.client.feed import clock_ahead_ns, utc_offset_ns
from imud.client.watch import EventStream, Watch, event_of, params_of
from imud.contracts.sensors.deviations import Deviations
from imud.contracts.status import DeviceStatus
from imud.errors import ImudError
from imud.event import Event
from imud.frames.conventions import Convention
from imud.sample import Sample

ROUND_S: Final = 0.25
"""Time between two looks at events and at who looks: a tenth would be no better to a person, and costs more."""
STATUS_S: Final = 1.0
RETRY_S: Final = 1.0
"""Time between two attempts to reach the daemon."""
NORTH: Final = "ENU"
"""Navigation frame of a device whose heading has to do with north, as the status has it."""


class Viewer(Protocol):
    """What shows messages, or has clients that do."""

    @property
    def is_looked_at(self) -> bool:
        """Whether a viewer wants samples now."""
        ...

    def open(self, channel: MessageChannel[Any]) -> None:
        """Offer a channel; no-op for one whose topic is offered already."""
        ...

    def close_topic(self, topic: str) -> None:
        """Offer it no more; no-op for one that is not."""
        ...

    def send(self, channel: MessageChannel[Any], item: object, utc_ns: int) -> None:
        """Make a message of `item` for those who want it."""
        ...

    def problem(self, text: str) -> None:
        """Show why nothing comes; empty: it does."""
        ...


class Relay:
    """Relay from the daemon at `path`. Synchronization: `run` in one thread, `stop` in any."""

    def __init__(
        self,
        path: str,
        viewer: Viewer,
        dialect: Dialect,
        *,
        devices: Sequence[str] = (),
        rate_hz: float | None = None,
        noise: Mapping[str, Deviations] | None = None,
        utc_offset_ns: Callable[[int], int] = lambda now_ns: utc_offset_ns(clock_ahead_ns(now_ns)),
    ) -> None:
        """`devices` are those that are shown, none: all; each at most `rate_hz`, None: every sample.

        `utc_offset_ns` gets what the daemon's CLOCK_MONOTONIC was just now, and returns what makes UTC of it.
        `noise`, by device, is taken in place of what the daemon's configuration has.
        """
        self._path = path
        self._viewer = viewer
        self._wanted = list(devices)
        self._rate_hz = rate_hz
        self._noise = noise or {}
        self._utc_offset_of = utc_offset_ns
        self._utc_offset_ns = 0
        """As of the newest status."""
        self._dialect = dialect
        self._events = dialect.events()
        self._diagnostics = dialect.diagnostics()
        self._diagnosis = LiveDiagnosis()
        self._devices: dict[str, _ShownDevice] = {}
        self._stop = ThreadEvent()

    def run(self) -> None:
        """Relay until `stop`."""
        self._viewer.open(self._events)
        self._viewer.open(self._diagnostics)
        while not self._stop.is_set():
            try:
                with Client(self._path) as client:
                    self._read(client)
            except (ImudError, TimeoutError) as error:
                self._viewer.problem(str(error))
                self._show_diagnoses(self._diagnosis.stale(str(error), time_ns()))
                self._stop.wait(RETRY_S)

    def stop(self) -> None:
        """End `run`, within a round."""
        self._stop.set()

    def _read(self, client: Client) -> None:
        """Relay until the end, or until the connection is lost, which raises."""
        events = client.events(self._wanted or None, timeout_s=ROUND_S)
        watch: Watch | None = None
        due_s = 0.0
        while not self._stop.is_set():
            if monotonic() >= due_s:
                self._show_status(client)
                due_s = monotonic() + STATUS_S
            if not self._viewer.is_looked_at:
                if watch is not None:
                    client.unwatch()
                    watch = None
                with suppress(TimeoutError):
                    self._show_event(next(events))
            elif watch is None:
                watch = client.watch(
                    self._wanted or None, rate_hz=self._rate_hz, timeout_s=ROUND_S, convention=Convention.ENU_FLU
                )
            else:
                self._show_samples(watch)
            while isinstance(message := client.kept_message(EventStream.NAMES), dict):
                self._show_event(event_of(params_of(message)))

    def _show_samples(self, watch: Watch) -> None:
        """Relay what comes in a round, each at once."""
        end_s = monotonic() + ROUND_S
        with suppress(TimeoutError):
            while monotonic() < end_s:
                sample = next(watch)
                device = self._devices.get(sample.device)
                if device is not None:  # one that was configured just now is shown with the next status
                    device.show(sample)

    def _show_event(self, event: Event) -> None:
        stamped = StampedEvent(event, event.t_ns + self._utc_offset_ns)
        self._viewer.send(self._events, stamped, stamped.utc_ns)

    def _show_diagnoses(self, diagnoses: Diagnoses) -> None:
        if diagnoses.devices:
            self._viewer.send(self._diagnostics, diagnoses, diagnoses.utc_ns)

    def _show_status(self, client: Client) -> None:
        answer = client.status()
        statuses = msgspec.convert(answer["devices"], list[DeviceStatus])
        self._utc_offset_ns = self._utc_offset_of(answer["now_ns"])
        utc_ns = answer["now_ns"] + self._utc_offset_ns
        self._viewer.problem("")
        there = {status.name: status for status in statuses if not self._wanted or status.name in self._wanted}
        for name in self._devices.keys() - there.keys():
            gone = self._devices.pop(name)
            gone.close(kept=frozenset().union(*(device.topics for device in self._devices.values())))
        for name, status in there.items():
            known = self._devices.get(name)
            noise = (status.noise or Deviations()).updated(self._noise.get(name, Deviations()))
            frames = MessageFrames(name, has_north=_has_north(status), deviations=noise)
            if known is None or known.frames != frames:
                known = self._devices[name] = _ShownDevice(self._viewer, self._dialect, frames)
            known.show_status(status, utc_ns)
        self._show_diagnoses(self._diagnosis.of(there.values(), utc_ns))
        unknown = [name for name, device in self._devices.items() if not device.is_offered]
        for sample in client.poll(unknown, convention=Convention.ENU_FLU) if unknown else ():
            self._devices[sample.device].show(sample)


class _ShownDevice:
    """The channels of one device."""

    def __init__(self, viewer: Viewer, dialect: Dialect, frames: MessageFrames) -> None:
        self.frames = frames
        self._viewer = viewer
        self._status = status_channel(frames.device)
        self._channels = dialect.samples(frames)
        self._open: set[str] = set()
        viewer.open(self._status)

    @property
    def is_offered(self) -> bool:
        """Whether channels of its samples are offered: what they are is known from the first sample."""
        return bool(self._open)

    def show(self, sample: Sample) -> None:
        """Send the messages of a sample; a channel is offered with the first sample that has something for it."""
        for channel in self._channels:
            if channel.topic not in self._open:
                if channel.encode(sample) is None:
                    continue
                self._open.add(channel.topic)
                self._viewer.open(channel)
            self._viewer.send(channel, sample, sample.utc_ns)

    def show_status(self, status: DeviceStatus, utc_ns: int) -> None:
        """Send the status."""
        self._viewer.send(self._status, (status, utc_ns), utc_ns)

    @property
    def topics(self) -> frozenset[str]:
        """Topics that are offered for it; that of transforms is one for all devices."""
        return frozenset((*self._open, self._status.topic))

    def close(self, kept: Collection[str]) -> None:
        """Offer nothing of it any more but the topics that others have as well."""
        for topic in self.topics.difference(kept):
            self._viewer.close_topic(topic)


def _has_north(status: DeviceStatus) -> bool:
    """Whether the navigation frame of its samples in enu-flu is ENU; while its driver is not known, as if it was."""
    if status.frame is None:
        return True
    words = status.frame.conventions.get(str(Convention.ENU_FLU))
    return words is None or words.navigation_frame == NORTH
