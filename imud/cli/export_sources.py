"""What is exported: a recording or a capture, played into a sink in the axes that are wanted."""

import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from fcntl import F_SETPIPE_SZ, fcntl
from operator import attrgetter
from pathlib import Path
from time import monotonic
from typing import IO, TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple, Protocol, TextIO

import msgspec

from imud.attitude.conventions import Convention
from imud.attitude.published import PublishedAxes
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
from imud.host.files import open_regular
from imud.host.threads import rare_garbage_collection
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.model.event import Event, kind_of
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import SAMPLE_FIELDS, Sample
from imud.recording.capture_player import CapturePlayer, KnownTimes
from imud.recording.player import PlayedDevice, Player, RecordedEvent

if TYPE_CHECKING:  # imports libraries of the extra `export`, which CSV does not need
    from imud.bridges.mcap import McapChannel, McapFile

CSV_BYTES: Final = 1 << 16
"""Text that is gathered before it is written."""
TABLES: Final = ("samples", "events", "losses")


class Sink(Protocol):
    """What takes all that a file has, in its order."""

    def samples(self, batch: Batch) -> None:
        """Take samples, in the axes that are wanted."""
        ...

    def losses(self, losses: LossCounts) -> None:
        """Take the losses of a device, which have grown."""
        ...

    def event(self, event: StampedEvent) -> None:
        """Take an event."""
        ...

    def finish(self) -> None:
        """Write what waits."""
        ...

    def close(self) -> None:
        """Release everything; may be called twice."""
        ...


class CsvSink:
    """One table as CSV."""

    def __init__(self, out: ByteWriter, what: str, fields: Collection[str] | None, *, without_times: bool) -> None:
        """`what` is one of TABLES; `fields` are those of samples, None for all."""
        self._out = out
        self._what = what
        names = SAMPLE_FIELDS if fields is None else tuple(fields)
        self._rows = table.SampleText(names, without_times)
        heads = {"samples": table.sample_columns(names), "events": table.EVENT_COLUMNS, "losses": table.LOSS_COLUMNS}
        self._text = bytearray(table.csv_text([heads[what]]))

    def samples(self, batch: Batch) -> None:
        """Write a row each."""
        if self._what == "samples":
            self._text += self._rows.of(batch.samples)
            if len(self._text) >= CSV_BYTES:
                self.finish()

    def losses(self, losses: LossCounts) -> None:
        """Write a row."""
        if self._what == "losses":
            self._text += table.csv_text([table.loss_row(losses)])

    def event(self, event: StampedEvent) -> None:
        """Write a row."""
        if self._what == "events":
            self._text += table.csv_text([table.event_row(event)])

    def finish(self) -> None:
        """Write what waits."""
        self._out.write(bytes(self._text))
        self._text.clear()

    def close(self) -> None:
        """No-op: nothing is held."""


HEAD: Final = struct.Struct("<BIQ")
"""Kind, length, and how many bytes of the file are read."""
LENGTH_MAX: Final = 1 << 26
"""Far more than a message has: beyond it something else writes into the pipe."""
PIPE_BYTES: Final = 1 << 20
"""Of the pipe, as far as the kernel allows it: playing goes on while a chunk of some hundred kilobytes is written."""
SAMPLES: Final = 64
"""Samples in a message at most: a sixth of a second at 400 Hz, so that messages of a file are nearly in their order."""
GC_ALLOCATIONS: Final = 50_000
"""Objects between two looks for cycles, of which playing makes next to none; each look goes through all objects."""
DEVICE, BATCH, LOSSES, EVENT, END, ERROR = range(1, 7)
_LOST: Final = attrgetter("samples", *LossCounts._fields[4:])
"""Counters of a ledger in the order of `LossCounts`."""

Played = tuple[str, int, list[str]]
"""Report for people, exit status, names of the devices."""


class LossWatch:
    """Gives the samples of wanted devices and their events to a sink, and before samples what was lost."""

    def __init__(self, sink: Sink, devices: Collection[str]) -> None:
        """`devices` are those that are wanted, none: all."""
        self._sink = sink
        self._devices = devices
        self._lost: dict[str, tuple[int, ...]] = {}

    def batch(self, batch: Batch, ledger: Ledger) -> None:
        """Pass on samples."""
        if self._devices and batch.device not in self._devices:
            return
        samples, *lost = _LOST(ledger)
        counts = tuple(lost)
        if counts != self._lost.get(batch.device):
            self._lost[batch.device] = counts
            first, before = batch.samples[0], samples - len(batch.samples)
            self._sink.losses(LossCounts(first.t_ns, first.utc_ns, batch.device, before, *counts))
        self._sink.samples(batch)

    def event(self, event: Event, utc_ns: int) -> None:
        """Pass on an event of a device that is wanted, or of the daemon itself."""
        if not self._devices or not event.device or event.device in self._devices:
            self._sink.event(StampedEvent(event, utc_ns))


def play_here(file: BinaryIO, name: str, sink: Sink, devices: Collection[str]) -> Played:
    """Play a recording in this process. Raises ImudError."""
    watch = LossWatch(sink, devices)
    player = Player(lambda batch: watch.batch(batch, player.devices[batch.device_id].ledger), on_event=watch.event)
    report, status = play_to_end(file, name, player)
    return report, status, sorted(device.described.name for device in player.devices.values())


def play_beside(path: Path, sink: Sink, devices: Sequence[str], at: Callable[[int], None]) -> Played:
    """Play a recording in a process of its own; `at` is called with the bytes read so far. Raises ImudError."""
    argv = [sys.executable, "-I", "-m", "imud.cli.export_sources", str(path.absolute()), *devices]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        with suppress(OSError):  # more than pipe-max-size, or than this user may have: it is slower, and the same
            fcntl(process.stdout, F_SETPIPE_SZ, PIPE_BYTES)
        try:
            return _take(process.stdout, path, sink, at)
        finally:
            process.kill()


def _take(pipe: IO[bytes], path: Path, sink: Sink, at: Callable[[int], None]) -> Played:
    """Give a sink what comes through the pipe."""
    frames: dict[int, tuple[str, PublishedAxes]] = {}
    decode_samples = msgspec.msgpack.Decoder(list[Sample]).decode
    while len(head := pipe.read(HEAD.size)) == HEAD.size:
        kind, length, position = HEAD.unpack(head)
        data = pipe.read(min(length, LENGTH_MAX))
        if len(data) < length:
            break
        if kind == BATCH:
            device_id = int.from_bytes(data[:2], "little")
            name, frame = frames[device_id]
            at(position)
            sink.samples(Batch(name, device_id, decode_samples(data[2:]), frame))
        elif kind == DEVICE:
            device_id, name, frame = msgspec.msgpack.decode(data, type=tuple[int, str, PublishedAxes])
            frames[device_id] = name, frame
        elif kind == LOSSES:
            sink.losses(msgspec.msgpack.decode(data, type=LossCounts))
        elif kind == EVENT:
            recorded, utc_ns = msgspec.msgpack.decode(data, type=tuple[RecordedEvent, int])
            event = Event(recorded.t_ns, recorded.device, kind_of(recorded.kind), recorded.message, recorded.detail)
            sink.event(StampedEvent(event, utc_ns))
        elif kind == END:
            played: Played = msgspec.msgpack.decode(data, type=Played)
            return played
        else:
            raise ImudError(data.decode(errors="replace"))
    raise ImudError(f"{path}: the process that plays it ended before its end; was it killed, is memory short?")


class PipeSink:
    """A sink that writes what it takes to a pipe."""

    def __init__(self, out: BinaryIO, position: Callable[[], int]) -> None:
        self._out = out
        self._position = position
        self._frames: dict[int, PublishedAxes] = {}
        self._waiting: list[Sample] = []
        self._device_id = -1
        self._encode = msgspec.msgpack.Encoder().encode

    def samples(self, batch: Batch) -> None:
        """Gather samples of one device."""
        device_id = batch.device_id
        if device_id != self._device_id or batch.frame is not self._frames.get(device_id):
            self.finish()
            self._device_id, self._frames[device_id] = device_id, batch.frame
            frame = batch.frame
            words = (frame.device, frame.mounting, frame.convention, frame.declination_deg, frame.from_angles)
            self._put(DEVICE, self._encode((device_id, batch.device, PublishedAxes(*words))))
        self._waiting += batch.samples
        if len(self._waiting) >= SAMPLES:
            self.finish()

    def losses(self, losses: LossCounts) -> None:
        """Write losses, after the samples before them."""
        self.finish()
        self._put(LOSSES, self._encode(losses))

    def event(self, event: StampedEvent) -> None:
        """Write an event, after the samples before it."""
        self.finish()
        self._put(EVENT, self._encode(event))

    def end(self, kind: int, value: Any) -> None:
        """Write the end: what came of it, or why it failed."""
        self.finish()
        self._put(kind, value.encode() if isinstance(value, str) else self._encode(value))
        self._out.flush()

    def finish(self) -> None:
        """Write the samples that wait."""
        samples, self._waiting = self._waiting, []
        if samples:
            self._put(BATCH, self._device_id.to_bytes(2, "little") + self._encode(samples))

    def close(self) -> None:
        """No-op: the pipe is the caller's."""

    def _put(self, kind: int, data: bytes) -> None:
        self._out.write(HEAD.pack(kind, len(data), self._position()) + data)


def main(path: str, devices: Sequence[str]) -> None:
    """Play a recording into standard output."""
    with rare_garbage_collection(GC_ALLOCATIONS), open_regular(path) as file:
        sink = PipeSink(sys.stdout.buffer, file.tell)
        try:
            sink.end(END, play_here(file, path, sink, devices))
        except ImudError as error:
            sink.end(ERROR, str(error))


EVERY_S: Final = 0.2
"""Time between two pictures."""
LOOK_SAMPLES: Final = 2000
"""Samples between two looks at the clock, which is 20 ms or so."""
BAR: Final = 24
"""Characters of the bar."""
CLEAR: Final = "\r\x1b[K"


class Progress:
    """The bar. It is nothing where standard error is no terminal."""

    def __init__(self, size_bytes: int, out: TextIO | None = None, now_s: Callable[[], float] = monotonic) -> None:
        """`size_bytes` is that of the whole file."""
        out = sys.stderr if out is None else out
        self._out = out if out.isatty() else None
        self._size = max(size_bytes, 1)
        self._now_s = now_s
        self._begun_s = self._due_s = now_s()
        self._looked = 0
        self.samples = 0
        """Samples so far."""

    @property
    def spent_s(self) -> float:
        """Time since the begin."""
        return self._now_s() - self._begun_s

    def add(self, samples: int, position: Callable[[], int]) -> None:
        """Count samples, and draw if it is time; `position` says how many bytes are read."""
        self.samples += samples
        if self._out is None or self.samples < self._looked + LOOK_SAMPLES:
            return
        self._looked = self.samples
        now_s = self._now_s()
        if now_s >= self._due_s:
            self._due_s = now_s + EVERY_S
            self._draw(position(), now_s - self._begun_s)

    def close(self) -> None:
        """Remove the bar; may be called twice."""
        if self._out is not None:
            self._out.write(CLEAR)
            self._out.flush()
            self._out = None

    def _draw(self, read_bytes: int, spent_s: float) -> None:
        assert self._out is not None
        share = min(read_bytes / self._size, 1.0)
        full = int(share * BAR)
        left = f", {spent_s / share - spent_s:.0f} s left" if share > 0.02 else ""
        text = f"[{'#' * full}{'.' * (BAR - full)}] {100 * share:3.0f} %  {self.samples} samples{left}"
        self._out.write(CLEAR + text[: shutil.get_terminal_size().columns - 1])
        self._out.flush()


NOISE: Final = "noise"
"""Key of the recorded configuration."""
BESIDE_BYTES: Final = 1_000_000
"""From this size on a recording is played in a process of its own: a start of one takes as long as 20,000 samples."""


class Exported(NamedTuple):
    """What came of an export."""

    report: str
    """Of each device, and of the file, for people."""
    status: int
    """0: the file is whole, and its samples are those of the live run."""


class ExportFeed:
    """A sink that turns samples into the axes that are wanted for another one. Synchronization: one thread."""

    def __init__(self, sink: Sink, file: BinaryIO, progress: Progress, convention: Convention | None) -> None:
        """None as `convention` leaves axes as they were published."""
        self._sink = sink
        self._file = file
        self._read_bytes: int | None = None
        self._progress = progress
        self._convention = convention
        self.samples_taken = 0
        """Samples passed on."""

    def at(self, read_bytes: int) -> None:
        """Note how far the file is read, where another process reads it."""
        self._read_bytes = read_bytes

    def samples(self, batch: Batch) -> None:
        """Turn samples, and pass them on."""
        self._sink.samples(batch.converted(self._convention))
        self.samples_taken += len(batch.samples)
        self._progress.add(len(batch.samples), self._position)

    def losses(self, losses: LossCounts) -> None:
        """Pass them on."""
        self._sink.losses(losses)

    def event(self, event: StampedEvent) -> None:
        """Pass it on."""
        self._sink.event(event)

    def finish(self) -> None:
        """Write what waits."""
        self._sink.finish()

    def close(self) -> None:
        """No-op: the other sink is the caller's."""

    def _position(self) -> int:
        return self._file.tell() if self._read_bytes is None else self._read_bytes


def export_recording(file: BinaryIO, path: Path, feed: ExportFeed, devices: Sequence[str]) -> Exported:
    """Play a recording. Raises ImudError, BadArgument for a device that it does not have."""
    if path.stat().st_size < BESIDE_BYTES:
        report, status, known = play_here(file, str(path), feed, devices)
    else:
        report, status, known = play_beside(path, feed, devices, feed.at)
    for name in devices:
        if name not in known:
            there = ", ".join(known)
            raise BadArgument(f"--device {name}: expected a device of the recording, which has {there}")
    return Exported(report, status)


def recorded_noise(file: BinaryIO, name: str) -> dict[str, Deviations]:
    """Return the configured noise of each device of a recording. Raises ImudError.

    A device is described when it starts, which may be after the first samples of another device.
    """
    found: dict[str, Deviations] = {}
    for record in RecordingReader(file, name):
        if record.kind == Kind.DEVICE:
            device = decode_object(record, DeviceRecord)
            if device is not None and NOISE in device.configuration:
                try:
                    found[device.name] = msgspec.convert(device.configuration[NOISE], Deviations)
                except msgspec.ValidationError as error:
                    raise ImudError(f"{name}: the noise of {device.name} cannot be read: {reason_of(error)}") from None
    file.seek(0)
    return found


def export_capture(
    file: BinaryIO, path: Path, feed: ExportFeed, driver: Driver, options: Options, baud: int
) -> Exported:
    """Play a capture. Raises ImudError."""
    watch = LossWatch(feed, ())
    player = CapturePlayer(lambda batch: watch.batch(batch, player.device.ledger), driver, options, str(path))
    reader: CaptureReader | CandumpReader
    if isinstance(driver, CanDriver):
        reader = CandumpReader(file)
        player.play_frames(reader)
    else:
        reader = CaptureReader(file)
        player.play_bytes(reader, baud)
    device = player.device
    words = [(reader.problem, "the file: "), (player.times.value, "times: ")]
    lines = [line for text, label in words if text for line in paragraph(label, text)]
    is_damaged = isinstance(reader, CaptureReader) and reader.is_damaged
    status = 0 if device.ledger.samples and not is_damaged else 1
    return Exported("\n".join([*_block(device, player.times), "", *lines]), status)


def times_of(file: BinaryIO, driver: Driver) -> KnownTimes | None:
    """Look at the begin of a capture: what its times will be; None: there are some, and playing it says which."""
    if isinstance(driver, CanDriver):
        return KnownTimes.WALL_CLOCK
    stamped = CaptureReader(file).stamped
    file.seek(0)
    return None if stamped else KnownTimes.NONE


def _block(device: PlayedDevice, times: KnownTimes) -> list[str]:
    """Lines about the device, without those that need times that were recorded, or a live run."""
    without = ("compared",) if times.has_host_times else ("compared", "clock")
    return device_block(device, without)


class McapSink:
    """Channels of a dialect in a file of MCAP. A channel is there from its first message on."""

    def __init__(
        self,
        file: "McapFile",
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

    def _open(self, described: MessageChannel[Sample]) -> "McapChannel":
        channel = self._shared.get(described.topic)
        if channel is None:
            channel = self._shared[described.topic] = self._file.add_channel(described)
        return channel


class _SampleChannel:
    """A channel of samples, opened with its first message."""

    def __init__(
        self, described: MessageChannel[Sample], open_: "Callable[[MessageChannel[Sample]], McapChannel]"
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


if __name__ == "__main__":
    try:
        main(sys.argv[1], sys.argv[2:])
    except (BrokenPipeError, KeyboardInterrupt):  # the parent process has ended
        sys.stdout = None  # prevents a flush at exit, which would fail
