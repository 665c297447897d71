"""The output `recorder`: files that are always written, the flight recorder, or both, within one budget of the disk."""

from pathlib import Path

from imud.contracts.publisher import Batch, Publisher, PublisherContext, PublisherType
from imud.event import Event
from imud.publishers.recorder.continuous import Recorder
from imud.publishers.recorder.directory import RecordingDirectory
from imud.publishers.recorder.flight import FlightRecorder
from imud.publishers.recorder.settings import RecorderSettings
from imud.worker import BusThread, StartWorker


class RecorderOutput:
    """What the settings ask for. Synchronization: the event loop's thread only."""

    def __init__(
        self, settings: RecorderSettings, context: PublisherContext, start_worker: StartWorker = BusThread
    ) -> None:
        directory = RecordingDirectory(Path(settings.directory), settings.keep_bytes)
        self._flight = FlightRecorder(settings, context, directory, start_worker) if settings.flight.enabled else None
        self._parts: list[Publisher] = [self._flight] if self._flight is not None else []
        if settings.enabled:
            self._parts.append(Recorder(settings, context, directory, start_worker))

    def start(self) -> None:
        """Start them. Raises ServerError, and leaves nothing running then."""
        try:
            for part in self._parts:
                part.start()
        except BaseException:
            self.close()
            raise

    def add_device(self, name: str, device_id: int) -> None:
        """Note a device."""
        for part in self._parts:
            part.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        """Forget a device."""
        for part in self._parts:
            part.remove_device(name)

    def publish(self, batch: Batch) -> None:
        """Look for alerts: what samples are made of is recorded elsewhere."""
        if self._flight is not None:
            self._flight.publish(batch)

    def event(self, event: Event) -> None:
        """Record an event."""
        for part in self._parts:
            part.event(event)

    def tick(self, now_ns: int) -> None:
        """Do what is due."""
        for part in self._parts:
            part.tick(now_ns)

    def close(self) -> None:
        """End all; may be called twice."""
        for part in self._parts:
            part.close()


def _wanted(settings: RecorderSettings) -> bool:
    return settings.enabled or settings.flight.enabled


PUBLISHER = PublisherType("recorder", RecorderSettings, RecorderOutput, _wanted, required=False)
