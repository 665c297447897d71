"""The player of a recording as a process of its own: decoding and dating on one core, writing on another.

It is started as `python -m imud.cli.export.playing FILE DEVICE…` and writes to its standard output what it plays, in
MessagePack with a head of kind and length. Nothing but `export_recording` starts it or reads that.
"""

import struct
import subprocess
import sys
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from fcntl import F_SETPIPE_SZ, fcntl
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, BinaryIO, Final

import msgspec

from imud.bridges.channel import LossCounts, StampedEvent
from imud.cli.export.sinks import Sink
from imud.cli.recording.replay import play_to_end
from imud.contracts.publisher import Batch
from imud.errors import ImudError
from imud.event import Event, kind_of
from imud.files import open_regular
from imud.frames.published import PublishedFrame
from imud.ledger import Ledger
from imud.runtime.recording.player import Player, RecordedEvent
from imud.sample import Sample
from imud.worker import rare_garbage_collection

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
    argv = [sys.executable, "-I", "-m", "imud.cli.export.playing", str(path.absolute()), *devices]
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
    frames: dict[int, tuple[str, PublishedFrame]] = {}
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
            device_id, name, frame = msgspec.msgpack.decode(data, type=tuple[int, str, PublishedFrame])
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
        self._frames: dict[int, PublishedFrame] = {}
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
            self._put(DEVICE, self._encode((device_id, batch.device, PublishedFrame(*words))))
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


if __name__ == "__main__":
    try:
        main(sys.argv[1], sys.argv[2:])
    except (BrokenPipeError, KeyboardInterrupt):  # who started it has ended
        sys.stdout = None  # nothing is flushed at the end
