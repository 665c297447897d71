"""`imud replay` of a recording: the samples, stamps, errors and ledgers of the live run again."""

import argparse
import sys
from collections.abc import Callable, Collection
from typing import BinaryIO, Final

import msgspec

from imud.cli.output import paragraph
from imud.contracts.publisher import Batch
from imud.errors import BadArgument
from imud.event import Event
from imud.files import open_regular
from imud.formats.recording.blocks import MAGIC, is_recording
from imud.formats.recording.file import RecordingReader
from imud.ledger import bytes_open, frames_open, lost
from imud.runtime.recording.player import PlayedDevice, Player
from imud.units import NS_PER_MS

DIFFERENCES_SHOWN = 3
LOOKED_AT_BYTES: Final = 1 << 20
"""Of a file whose begin is damaged: a recorder's blocks hold 256 KiB at most, but for records that are larger."""


def looks_like_recording(path: str) -> bool:
    """Whether a file is a recording by its first bytes, or by those of a later block. Raises OSError."""
    with open_regular(path) as file:
        begin = file.read(LOOKED_AT_BYTES)
    return is_recording(begin) or MAGIC in begin


def play_recording(args: argparse.Namespace) -> int:
    """Replay a recording; its ledgers go to standard error. 1 where it is not what the live run was, or has no sample.

    Raises BadArgument for options that are for captures only, ImudError.
    """
    for option, default in (("socket", None), ("option", []), ("driver", None), ("speed", None), ("baud", None)):
        if getattr(args, option) != default:
            raise BadArgument(
                f"--{option}: expected none with a recording, which has driver, options and times of the live run"
            )
    with open_regular(args.file) as file:
        return _play(file, args)


def _play(file: BinaryIO, args: argparse.Namespace) -> int:
    player = Player(print_samples if args.json else lambda _batch: None, fresh=args.fresh)
    report, status = play_to_end(file, str(args.file), player)
    sys.stdout.flush()
    print(report, file=sys.stderr)
    return status


def print_samples(batch: Batch) -> None:
    """Print one JSON line per sample. Raises OSError where it cannot be written."""
    print("".join(msgspec.json.encode(sample).decode() + "\n" for sample in batch.samples), end="")


def play_to_end(file: BinaryIO, name: str, player: Player) -> tuple[str, int]:
    """Play a recording to its end. Returns what came of it, for people, and the exit status of `imud replay`.

    Raises ImudError, and what the player's publisher raises as OSError.
    """
    reader = RecordingReader(file, name)
    player.play(reader)
    devices = list(player.devices.values())
    report = "\n\n".join(["\n".join(device_block(device)) for device in devices] + remarks(reader, player))
    same = all(not device.differences for device in devices) and not player.lost and not reader.is_damaged
    return report, 0 if same and any(device.ledger.samples for device in devices) else 1


def device_block(device: PlayedDevice, without: Collection[str] = ()) -> list[str]:
    """Format what came of a device, in 80 columns, without the rows of these names."""
    counts = device.ledger.snapshot()
    path = device.path
    newest = path.newest if path is not None else None
    clock = f"{newest.sync}, error {newest.t_err_ns / NS_PER_MS:.3f} ms" if newest is not None else "no sample"
    if path is not None and path.clock.expected_rate_hz:
        clock += f", {path.clock.expected_rate_hz:.1f} Hz by the device's clock"
    closes = not bytes_open(counts) and not frames_open(counts)
    rows = [
        ("link", f"{device.described.where}, driver {device.driver.name if device.driver else 'not found'}"),
        ("clock", clock),
        ("samples", f"{counts['samples']}; lost {lost(counts)}, {counts['lost_unknown']} gaps of unknown size"),
        ("bytes", f"{counts['bytes_in']}: {'closed' if closes else 'DOES NOT CLOSE'}"),
        ("compared", comparison(device)),
    ]
    lines = paragraph(f"{device.described.name}: ", "replayed")
    for name, text in rows:
        if name not in without:
            lines += paragraph(f"  {name:<10}", text)
    return lines


def comparison(device: PlayedDevice) -> str:
    """Format how the replay compares with what the recording says of the live run."""
    if device.fresh_starts:
        return (
            f"not the live run's stamps: {device.fresh_starts[0]}; the clock begins anew here, and needs some seconds "
            "until it is as good"
        )
    if not device.differences:
        return f"the same as the live run at {device.checks} of {device.checks} checks"
    return f"OTHER than the live run at {len(device.differences)} of {device.checks} checks: " + "; ".join(
        device.differences[:DIFFERENCES_SHOWN]
    )


def remarks(reader: RecordingReader, player: Player) -> list[str]:
    """What else is to be known of the file."""
    found = [f"the file: {problem}" for problem in reader.problems]
    if player.lost:
        found.append(f"records that were dropped when it was written: {player.lost}; what they held is missing")
    return ["\n".join(line for words in found for line in paragraph("", words))] if found else []


class Printer:
    """A publisher that prints samples as JSON lines, as long as they can be written."""

    def __init__(self, stop: Callable[[], None]) -> None:
        """`stop` is called at the first line that cannot be written."""
        self.problem: OSError | None = None
        """Why lines could not be written; None while they can."""
        self._stop = stop

    def start(self) -> None:
        """No-op: there is nothing to open."""

    def add_device(self, name: str, device_id: int) -> None:
        """No-op: every device is printed."""

    def remove_device(self, name: str) -> None:
        """No-op: nothing is kept per device."""

    def publish(self, batch: Batch) -> None:
        """One line per sample."""
        self._output("".join(msgspec.json.encode(sample).decode() + "\n" for sample in batch.samples))

    def event(self, event: Event) -> None:
        """No-op: events are in the log."""

    def tick(self, now_ns: int) -> None:
        """No-op: nothing depends on time."""

    def close(self) -> None:
        """Leave nothing in the buffer."""
        self._output("", flush=True)

    def _output(self, text: str, *, flush: bool = False) -> None:
        if self.problem is not None:
            return
        try:
            print(text, end="", flush=flush)
        except OSError as error:
            self.problem = error
            self._stop()
