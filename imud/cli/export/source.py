"""What is exported: a recording or a capture, played into a sink in the axes that are wanted."""

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import msgspec

from imud.bridges.channel import LossCounts, StampedEvent
from imud.cli.export.playing import LossWatch, play_beside, play_here
from imud.cli.export.progress import Progress
from imud.cli.export.sinks import Sink
from imud.cli.output import paragraph
from imud.cli.recording.replay import device_block
from imud.contracts.can import CanDriver
from imud.contracts.driver import Driver
from imud.contracts.publisher import Batch
from imud.contracts.sensors.deviations import Deviations
from imud.contracts.settings import Settings
from imud.errors import BadArgument, ImudError, reason_of
from imud.formats.candump import CandumpReader
from imud.formats.capture import CaptureReader
from imud.formats.recording.file import RecordingReader
from imud.formats.recording.records import DeviceRecord, Kind, decode_object
from imud.frames.conventions import Convention
from imud.runtime.recording.captures import CapturePlayer, KnownTimes
from imud.runtime.recording.player import PlayedDevice

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
    file: BinaryIO, path: Path, feed: ExportFeed, driver: Driver, options: Settings, baud: int
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
