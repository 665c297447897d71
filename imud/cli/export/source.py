"""What is exported: a recording or a capture, played into a sink in the axes that are wanted."""

from collections.abc import Collection
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from imud.bridges.channel import LossCounts, StampedEvent
from imud.cli.export.progress import Progress
from imud.cli.export.sinks import Sink
from imud.cli.output import paragraph
from imud.cli.recording.replay import block, play
from imud.contracts.can import CanDriver
from imud.contracts.driver import Driver
from imud.contracts.publisher import Batch
from imud.contracts.settings import Settings
from imud.errors import BadArgument
from imud.event import Event
from imud.formats.candump import CandumpReader
from imud.formats.capture import CaptureReader
from imud.frames.conventions import Convention
from imud.ledger import Ledger
from imud.runtime.recording.captures import CapturePlayer, KnownTimes
from imud.runtime.recording.player import PlayedDevice, Player

_LOST: Final = attrgetter("samples", *LossCounts._fields[4:])
"""Counters of a ledger in the order of `LossCounts`."""


class Exported(NamedTuple):
    """What came of an export."""

    report: str
    """Of each device, and of the file, for people."""
    status: int
    """0: the file is whole, and its samples are those of the live run."""


class ExportFeed:
    """Passes on what a player makes. Synchronization: one thread."""

    def __init__(
        self, sink: Sink, file: BinaryIO, progress: Progress, devices: Collection[str], convention: Convention | None
    ) -> None:
        """`devices` are those that are wanted, none: all; None as `convention` leaves axes as they were published."""
        self._sink = sink
        self._position = file.tell
        self._progress = progress
        self._devices = devices
        self._convention = convention
        self._lost: dict[str, tuple[int, ...]] = {}
        self.samples = 0
        """Samples passed on."""

    def batch(self, batch: Batch, ledger: Ledger) -> None:
        """Pass on samples, and before them what was lost since those before."""
        if self._devices and batch.device not in self._devices:
            return
        samples, *lost = _LOST(ledger)
        counts = tuple(lost)
        if counts != self._lost.get(batch.device):
            self._lost[batch.device] = counts
            first = batch.samples[0]
            before = samples - len(batch.samples)
            self._sink.losses(LossCounts(first.t_ns, first.utc_ns, batch.device, before, *counts))
        self._sink.samples(batch.converted(self._convention))
        self.samples += len(batch.samples)
        self._progress.add(len(batch.samples), self._position)

    def event(self, event: Event, utc_ns: int) -> None:
        """Pass on an event of a device that is wanted, or of the daemon itself."""
        if not self._devices or not event.device or event.device in self._devices:
            self._sink.event(StampedEvent(event, utc_ns))


def export_recording(file: BinaryIO, path: Path, feed: ExportFeed, devices: Collection[str]) -> Exported:
    """Play a recording. Raises ImudError, BadArgument for a device that it does not have."""
    player = Player(lambda batch: feed.batch(batch, player.devices[batch.device_id].ledger), on_event=feed.event)
    report, status = play(file, str(path), player)
    known = {device.described.name for device in player.devices.values()}
    for name in devices:
        if name not in known:
            there = ", ".join(sorted(known))
            raise BadArgument(f"--device {name}: expected a device of the recording, which has {there}")
    return Exported(report, status)


def export_capture(
    file: BinaryIO, path: Path, feed: ExportFeed, driver: Driver, options: Settings, baud: int
) -> Exported:
    """Play a capture. Raises ImudError."""
    player = CapturePlayer(lambda batch: feed.batch(batch, player.device.ledger), driver, options, str(path))
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
    return Exported("\n".join([*_block(device, player.times), "", *lines]), 0 if device.ledger.samples else 1)


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
    return block(device, without)
