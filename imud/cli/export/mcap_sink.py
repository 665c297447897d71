"""An export as MCAP: messages of a dialect, a channel for each kind. It needs the extra `export`."""

from collections.abc import Callable, Collection, Mapping, Sequence

from imud.bridges.channel import Diagnoses, Dialect, LossCounts, MessageChannel, MessageFrames, StampedEvent
from imud.bridges.diagnosis import RecordedDiagnosis
from imud.bridges.mcap_file import McapChannel, McapFile
from imud.contracts.publisher import Batch
from imud.contracts.sensors.deviations import Deviations
from imud.frames.conventions import Convention
from imud.sample import Sample


class McapSink:
    """Channels of a dialect in a file of MCAP. A channel is there from its first message on."""

    def __init__(
        self,
        file: McapFile,
        dialect: Dialect,
        convention: Convention,
        fields: Collection[str] | None,
        noise: Mapping[str, Deviations],
    ) -> None:
        """`fields` chooses the channels of samples that say something of one of them; None: all. `noise`: by device."""
        self._file = file
        self._dialect = dialect
        self._convention = convention
        self._fields = fields
        self._noise = noise
        self._devices: dict[str, list[_SampleChannel]] = {}
        self._losses: dict[str, tuple[MessageChannel[LossCounts], McapChannel]] = {}
        self._events: tuple[MessageChannel[StampedEvent], McapChannel] | None = None
        self._diagnosis = RecordedDiagnosis()
        self._diagnostics: tuple[MessageChannel[Diagnoses], McapChannel] | None = None
        self._shared: dict[str, McapChannel] = {}
        """Channels by their topic: that of transforms is one for all devices."""

    def samples(self, batch: Batch) -> None:
        """Write the messages of each."""
        channels = self._devices.get(batch.device)
        if channels is None:
            channels = self._devices[batch.device] = self._channels_of(batch)
        samples = batch.samples
        times_ns = [sample.utc_ns for sample in samples]
        for channel in channels:
            channel.add(samples, times_ns)
        self._diagnose(self._diagnosis.samples(batch.device, samples))

    def losses(self, losses: LossCounts) -> None:
        """Write the message."""
        self._diagnosis.losses(losses)
        known = self._losses.get(losses.device)
        if known is None:
            described = self._dialect.losses(losses.device)
            known = self._losses[losses.device] = described, self._file.add_channel(described)
        described, channel = known
        data = described.encode(losses)
        if data is not None:
            channel.add(losses.utc_ns, data)

    def event(self, event: StampedEvent) -> None:
        """Write the message."""
        if self._events is None:
            described = self._dialect.events()
            self._events = described, self._file.add_channel(described)
        described, channel = self._events
        data = described.encode(event)
        if data is not None:
            channel.add(event.utc_ns, data)
        self._diagnose(self._diagnosis.event(event))

    def _diagnose(self, diagnoses: Diagnoses | None) -> None:
        """Write the message, where there is one."""
        if diagnoses is None:
            return
        if self._diagnostics is None:
            described = self._dialect.diagnostics()
            self._diagnostics = described, self._file.add_channel(described)
        described, channel = self._diagnostics
        data = described.encode(diagnoses)
        if data is not None:
            channel.add(diagnoses.utc_ns, data)

    def finish(self) -> None:
        """Write what waits, and the index."""
        self._file.finish()

    def close(self) -> None:
        """End the thread that compresses."""
        self._file.close()

    def _channels_of(self, batch: Batch) -> "list[_SampleChannel]":
        noise = self._noise.get(batch.device, Deviations())
        frames = MessageFrames(batch.device, self._convention, batch.frame.device.has_north, noise)
        wanted = self._fields
        return [
            _SampleChannel(described, self._open)
            for described in self._dialect.samples(frames)
            if wanted is None or described.fields & set(wanted)
        ]

    def _open(self, described: MessageChannel[Sample]) -> McapChannel:
        channel = self._shared.get(described.topic)
        if channel is None:
            channel = self._shared[described.topic] = self._file.add_channel(described)
        return channel


class _SampleChannel:
    """A channel of samples, opened with its first message."""

    def __init__(
        self, described: MessageChannel[Sample], open_: Callable[[MessageChannel[Sample]], McapChannel]
    ) -> None:
        self._described = described
        self._encode = described.encode
        self._open = open_
        self._channel: McapChannel | None = None

    def add(self, samples: Sequence[Sample], times_ns: Sequence[int]) -> None:
        """Write a message of each that has one, of these times."""
        made = list(map(self._encode, samples))
        messages = [data for data in made if data is not None]
        if not messages:
            return
        if len(messages) < len(made):
            times_ns = [t_ns for t_ns, data in zip(times_ns, made, strict=True) if data is not None]
        if self._channel is None:
            self._channel = self._open(self._described)
        self._channel.add_run(times_ns, messages)
