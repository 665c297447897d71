"""Export of a recording or a capture: players that read the file, and sinks that write CSV or MCAP."""

import shutil
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple, Protocol, TextIO

import msgspec

from imud.attitude.conventions import Convention
from imud.bridges import csv as table
from imud.bridges.channel import (
    ByteWriter,
    Diagnoses,
    Dialect,
    LossCounts,
    MessageChannel,
    MessageFrames,
    RecordedDiagnosis,
    StampedEvent,
)
from imud.cli.output import paragraph
from imud.cli.replay import device_block, play_to_end
from imud.contracts.driver import CanDriver, Driver
from imud.contracts.publisher import Batch
from imud.contracts.status import Deviations
from imud.formats.can import CandumpReader
from imud.formats.capture import CaptureReader
from imud.formats.recording import RecordingReader
from imud.formats.records import DeviceRecord, Kind, decode_object
from imud.host.threads import rare_garbage_collection
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.model.event import Event
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import SAMPLE_FIELDS, Sample
from imud.recording.capture_player import CapturePlayer, KnownTimes
from imud.recording.player import PlayedDevice, Player, RecordedClock

if TYPE_CHECKING:  # imports libraries of the extra `export`, which CSV does not need
    from imud.bridges.mcap import McapChannel, McapFile

CSV_BYTES: Final = 1 << 16  # size of the text buffer, bytes
TABLES: Final = ("samples", "events", "losses")


class Sink(Protocol):
    """Receiver of the content of a file, in the order of the file."""

    def samples(self, batch: Batch) -> None:
        """Write samples in the requested axes."""
        ...

    def losses(self, losses: LossCounts) -> None:
        """Write the increased loss counters of a device."""
        ...

    def event(self, event: StampedEvent) -> None:
        """Write an event."""
        ...

    def session(self, epoch: int) -> None:
        """Note that another file follows. `epoch` identifies its run of imud."""
        ...

    def finish(self) -> None:
        """Write buffered data."""
        ...

    def close(self) -> None:
        """Release all resources. A second call does nothing."""
        ...


class CsvSink:
    """Sink that writes one table as CSV."""

    def __init__(self, out: ByteWriter, kind: str, fields: Collection[str] | None, *, without_times: bool) -> None:
        """`kind`: one of TABLES. `fields`: the fields of the samples, None for all."""
        self._out = out
        self._table = kind
        names = SAMPLE_FIELDS if fields is None else tuple(fields)
        self._rows = table.SampleText(names, without_times)
        heads = {"samples": table.sample_columns(names), "events": table.EVENT_COLUMNS, "losses": table.LOSS_COLUMNS}
        self._text = bytearray(table.csv_text([heads[kind]]))

    def samples(self, batch: Batch) -> None:
        if self._table == "samples":
            self._text += self._rows.of(batch.samples)
            if len(self._text) >= CSV_BYTES:
                self.finish()

    def losses(self, losses: LossCounts) -> None:
        if self._table == "losses":
            self._text += table.csv_text([table.loss_row(losses)])

    def event(self, event: StampedEvent) -> None:
        if self._table == "events":
            self._text += table.csv_text([table.event_row(event)])

    def session(self, epoch: int) -> None: ...

    def finish(self) -> None:
        self._out.write(bytes(self._text))
        self._text.clear()

    def close(self) -> None: ...


SAMPLES: Final = 64  # maximum in a batch: 0.16 s at 400 Hz, so that devices stay nearly in the order of time
GC_ALLOCATIONS: Final = 50_000  # allocations between two garbage collections: almost no reference cycles occur
_LOST: Final = attrgetter("samples", *LossCounts._fields[4:])  # counters of a ledger in the order of `LossCounts`

Played = tuple[str, int, list[str]]  # report as text, exit status, names of the devices


class LossWatch:
    """Filter that passes the samples and events of selected devices to a sink, and new losses before the samples."""

    def __init__(self, sink: Sink, devices: Collection[str]) -> None:
        """`devices`: the selected devices; empty for all devices."""
        self._sink = sink
        self._devices = devices
        self._lost: dict[str, list[int]] = {}

    def batch(self, batch: Batch, ledger: Ledger) -> None:
        """Pass samples to the sink. If the ledger contains new losses, pass the losses first."""
        if self._devices and batch.device not in self._devices:
            return
        samples, *counts = _LOST(ledger)
        if counts != self._lost.get(batch.device):
            self._lost[batch.device] = counts
            first, before = batch.samples[0], samples - len(batch.samples)
            self._sink.losses(LossCounts(first.t_ns, first.utc_ns, batch.device, before, *counts))
        self._sink.samples(batch)

    def event(self, event: Event, utc_ns: int) -> None:
        """Pass an event of a selected device or of the daemon to the sink."""
        if not self._devices or not event.device or event.device in self._devices:
            self._sink.event(StampedEvent(event, utc_ns))


class BatchingSink:
    """Sink that joins the samples of one device to batches of SAMPLES: another sink then needs half of the CPU time."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._first: Batch | None = None  # first of the joined batches
        self._samples: list[Sample] = []

    def samples(self, batch: Batch) -> None:
        first = self._first
        if first is None or batch.device_id != first.device_id or batch.frame is not first.frame:
            self.flush()
            self._first = batch
        self._samples += batch.samples
        if len(self._samples) >= SAMPLES:
            self.flush()

    def losses(self, losses: LossCounts) -> None:
        self.flush()  # keep the order of samples and losses
        self._sink.losses(losses)

    def event(self, event: StampedEvent) -> None:
        self.flush()
        self._sink.event(event)

    def session(self, epoch: int) -> None:
        self.flush()
        self._sink.session(epoch)

    def flush(self) -> None:
        """Pass the joined samples to the other sink."""
        samples, self._samples = self._samples, []
        if samples:
            assert self._first is not None
            self._sink.samples(Batch(self._first.device, self._first.device_id, samples, self._first.frame))

    def finish(self) -> None:
        self.flush()
        self._sink.finish()

    def close(self) -> None:
        self._sink.close()


def play_recording(file: BinaryIO, name: str, sink: Sink, devices: Collection[str]) -> Played:
    """Play a recording. Raises ImudError."""
    batches = BatchingSink(sink)
    watch = LossWatch(batches, devices)

    def count(batch: Batch) -> None:
        watch.batch(batch, player.devices[batch.device_id].ledger)

    player = Player(count, on_event=watch.event, on_session=batches.session)
    with rare_garbage_collection(GC_ALLOCATIONS):
        report, status = play_to_end(file, name, player)
        batches.flush()
    return report, status, sorted({device.described.name for device in player.all_devices})


EVERY_S: Final = 0.2  # time between two updates of the progress bar, s
LOOK_SAMPLES: Final = 2000  # number of samples between two reads of the clock, about 20 ms
BAR: Final = 24  # length of the progress bar, characters
CLEAR: Final = "\r\x1b[K"


class Progress:
    """Progress bar on standard error. It prints nothing if standard error is not a terminal."""

    def __init__(self, size_bytes: int, out: TextIO | None = None, now_s: Callable[[], float] = monotonic) -> None:
        """`size_bytes`: size of the input file."""
        out = sys.stderr if out is None else out
        self._out = out if out.isatty() else None
        self._size = max(size_bytes, 1)
        self._now_s = now_s
        self._begun_s = self._due_s = now_s()
        self._looked = 0
        self.samples = 0  # number of samples so far

    @property
    def spent_s(self) -> float:
        """Time since the start, s."""
        return self._now_s() - self._begun_s

    def add(self, samples: int, position: Callable[[], int]) -> None:
        """Count samples. Update the bar if it is due. `position` returns the read position in bytes."""
        self.samples += samples
        if self._out is None or self.samples < self._looked + LOOK_SAMPLES:
            return
        self._looked = self.samples
        if (now_s := self._now_s()) >= self._due_s:
            self._due_s = now_s + EVERY_S
            self._draw(position(), now_s - self._begun_s)

    def close(self) -> None:
        """Remove the bar. A second call does nothing."""
        if self._out is not None:
            self._out.write(CLEAR)
            self._out.flush()
            self._out = None

    def _draw(self, read_bytes: int, spent_s: float) -> None:
        assert self._out is not None
        share = min(read_bytes / self._size, 1.0)
        full = int(share * BAR)
        left = f", {spent_s / share - spent_s:.0f} s left" if share > 0.02 else ""  # an earlier estimate is too rough
        text = f"[{'#' * full}{'.' * (BAR - full)}] {100 * share:3.0f} %  {self.samples} samples{left}"
        self._out.write(CLEAR + text[: shutil.get_terminal_size().columns - 1])
        self._out.flush()


NOISE: Final = "noise"  # key of the noise in the recorded configuration of a device


class Exported(NamedTuple):
    """Result of an export."""

    report: str  # report about the devices and the file, as text
    status: int  # 0 if the file is complete and its samples are equal to the live run, otherwise 1


class RecordedFacts(NamedTuple):
    """Facts of a recording that an export needs before the first sample."""

    noise: dict[str, Deviations]  # configured noise of each device
    clock: RecordedClock


def recorded_facts(file: BinaryIO, name: str) -> RecordedFacts:
    """Return the noise and the clock of a recording. Raises ImudError.

    Read the complete file: the description of a device can come after the first samples of another device.
    """
    found, clock = dict[str, Deviations](), RecordedClock()
    for record in RecordingReader(file, name):
        clock.read(record)
        if record.kind == Kind.DEVICE:
            device = decode_object(record, DeviceRecord)
            if device is not None and NOISE in device.configuration:
                try:
                    found[device.name] = msgspec.convert(device.configuration[NOISE], Deviations)
                except msgspec.ValidationError as error:
                    raise ImudError(f"{name}: cannot read the noise of {device.name}: {reason_of(error)}") from None
    file.seek(0)
    return RecordedFacts(found, clock)


class ExportFeed:
    """Sink that converts samples to the requested axes and passes them to another sink. Synchronization: one thread."""

    def __init__(
        self,
        sink: Sink,
        file: BinaryIO,
        progress: Progress,
        convention: Convention | None,
        clock: RecordedClock,
    ) -> None:
        """`convention`: None keeps the published axes."""
        self._sink = sink
        self._clock = clock
        self._file = file
        self._progress = progress
        self._convention = convention
        self.samples_taken = 0  # number of exported samples

    def samples(self, batch: Batch) -> None:
        self._sink.samples(self._clock.placed(batch).converted(self._convention))
        self.samples_taken += len(batch.samples)
        self._progress.add(len(batch.samples), self._file.tell)

    def losses(self, losses: LossCounts) -> None:
        self._sink.losses(losses._replace(utc_ns=self._clock.utc_ns(losses.t_ns, losses.utc_ns)))

    def event(self, event: StampedEvent) -> None:
        self._sink.event(event._replace(utc_ns=self._clock.utc_ns(event.event.t_ns, event.utc_ns)))

    def session(self, epoch: int) -> None:
        self._clock.begin(epoch)

    def finish(self) -> None:
        self._sink.finish()

    def close(self) -> None: ...


def export_recording(file: BinaryIO, path: Path, feed: ExportFeed, devices: Sequence[str]) -> Exported:
    """Export a recording. Raises ImudError, and BadArgument if the recording does not contain a selected device."""
    report, status, known = play_recording(file, str(path), feed, devices)
    for name in devices:
        if name not in known:
            raise BadArgument(f"--device {name}: expected a device of the recording: {', '.join(known) or 'none'}")
    return Exported(report, status)


def export_capture(
    reader: CaptureReader | CandumpReader, path: Path, feed: ExportFeed, driver: Driver, options: Options, baud: int
) -> Exported:
    """Export a capture. Raises ImudError."""
    watch = LossWatch(feed, ())
    player = CapturePlayer(lambda batch: watch.batch(batch, player.device.ledger), driver, options, str(path))
    if isinstance(reader, CandumpReader):
        player.play_frames(reader)
    else:
        player.play_bytes(reader, baud)
    device = player.device
    others = ""
    if isinstance(reader, CandumpReader) and isinstance(driver, CanDriver):
        others = driver.other_nodes(options, reader.identifiers.values())
    words = [
        (reader.problem, "file: "),
        (others, "file: "),
        (player.problem, "device: "),
        (player.times.value, "times: "),
    ]
    lines = [line for text, label in words if text for line in paragraph(label, text)]
    is_damaged = isinstance(reader, CaptureReader) and reader.is_damaged
    status = 0 if device.ledger.samples and not is_damaged else 1
    return Exported("\n".join([*_block(device, player.times), "", *lines]), status)


def times_of(file: BinaryIO, driver: Driver) -> KnownTimes | None:
    """Return the kind of times in a capture. None if the capture is time-stamped: the player then finds the kind."""
    if isinstance(driver, CanDriver):
        return KnownTimes.WALL_CLOCK
    stamped = CaptureReader(file).stamped
    file.seek(0)
    return None if stamped else KnownTimes.NONE


def _block(device: PlayedDevice, times: KnownTimes) -> list[str]:
    """Format the device without the rows that need recorded times or a live run."""
    without = ("compared",) if times.has_host_times else ("compared", "clock")
    return device_block(device, without)


class McapSink:
    """Sink that writes the channels of a dialect to an MCAP file. The first message of a channel adds the channel."""

    def __init__(
        self,
        file: "McapFile",
        dialect: Dialect,
        convention: Convention,
        fields: Collection[str] | None,
        noise: Mapping[str, Deviations],
    ) -> None:
        """`fields`: write only channels of samples with one of these fields; None for all. `noise`: by device."""
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
        self._shared: dict[str, McapChannel] = {}  # Channels by topic. All devices share the channel of transforms.

    def samples(self, batch: Batch) -> None:
        channels = self._devices.get(batch.device)
        if channels is None:
            channels = self._devices[batch.device] = self._channels_of(batch)
        samples = batch.samples
        times_ns = [sample.utc_ns for sample in samples]
        for channel in channels:
            channel.add(samples, times_ns)
        for diagnoses in self._diagnosis.samples(batch.device, samples):
            self._diagnose(diagnoses)

    def losses(self, losses: LossCounts) -> None:
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
        if self._events is None:
            described = self._dialect.events()
            self._events = described, self._file.add_channel(described)
        described, channel = self._events
        data = described.encode(event)
        if data is not None:
            channel.add(event.utc_ns, data)
        self._diagnose(self._diagnosis.event(event))

    def session(self, epoch: int) -> None: ...

    def _diagnose(self, diagnoses: Diagnoses | None) -> None:
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
        """Write buffered messages and the index."""
        self._file.finish()

    def close(self) -> None:
        """Stop the compression thread."""
        self._file.close()

    def _channels_of(self, batch: Batch) -> "list[_SampleChannel]":
        noise = self._noise.get(batch.device, Deviations())
        frames = MessageFrames(batch.device, self._convention, batch.frame.device.has_north, noise)
        wanted = self._fields
        return [
            _SampleChannel(described, self)
            for described in self._dialect.samples(frames)
            if wanted is None or described.fields & set(wanted)
        ]

    def open_channel(self, described: MessageChannel[Sample]) -> "McapChannel":
        channel = self._shared.get(described.topic)
        if channel is None:
            channel = self._shared[described.topic] = self._file.add_channel(described)
        return channel


class _SampleChannel:
    """Channel of samples. The first message adds the channel to the file."""

    def __init__(self, described: MessageChannel[Sample], sink: McapSink) -> None:
        self._described = described
        self._encode = described.encode
        self._sink = sink
        self._channel: McapChannel | None = None

    def add(self, samples: Sequence[Sample], times_ns: Sequence[int]) -> None:
        """Write the messages of the samples. `times_ns` are the times of the samples."""
        made = list(map(self._encode, samples))
        messages = [data for data in made if data is not None]
        if not messages:
            return
        if len(messages) < len(made):
            times_ns = [t_ns for t_ns, data in zip(times_ns, made, strict=True) if data is not None]
        if self._channel is None:
            self._channel = self._sink.open_channel(self._described)
        self._channel.add_run(times_ns, messages)
