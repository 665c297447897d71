"""What `make soak` looks at in the recorder: every file that it made, before it is removed, against its own counters.

Files are read whole when the next one has begun, thus all of them, while the budget lets only the newest stand. The
recorder's account closes when the files have as many records, lost records and bytes as its metrics say, and when as
many files are gone as it says it removed. The files that are left are replayed and compared with the run.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from time import monotonic
from typing import BinaryIO, Final
from urllib.request import urlopen

from imud.contracts.publisher import Batch
from imud.formats import records
from imud.formats.recording import RecordingReader
from imud.formats.records import Kind
from imud.model.errors import ImudError
from imud.recording.player import Player

FILE_MB: Final = 1.0
KEEP_MB: Final = 3.0
"""One file and what is written meanwhile: a file is there for long enough to be read, and is removed soon after."""
SCRAPE_LIMIT_S: Final = 5.0
CLOSE_LIMIT_S: Final = 20.0
"""A block is made in milliseconds, once a second: after some looks one of them is between two blocks."""


def settings(directory: Path) -> dict[str, object]:
    return {"enabled": True, "directory": str(directory), "file_mb": FILE_MB, "keep_gb": KEEP_MB / 1000}


@dataclass
class Count:
    records: int = 0
    lost: int = 0
    bytes: int = 0


@dataclass
class Recordings:
    directory: Path
    problems: list[str] = field(default_factory=list)
    read: dict[str, Count] = field(default_factory=dict)

    def look(self) -> None:
        """Read the files that ended since; called more often than files begin."""
        for file in self._files()[:-1]:
            if file.name not in self.read:
                self._read(file)

    def close_account(self, metrics_port: int) -> list[str]:
        """Compare with the recorder's counters while the daemon runs and writes; return what does not agree.

        What is in the files lies between the counters of before and after they were read. A counter may be ahead of
        the file for the moment in which a block is made: then it is looked at again.
        """
        end, found = monotonic() + CLOSE_LIMIT_S, ["the recorder's account was not looked at"]
        while found and monotonic() < end:
            self.look()
            before = recorder_metrics(metrics_port)
            files = self._files()
            left, newest = len(files), files[-1].read_bytes()
            sizes = len(newest) + sum(file.stat().st_size for file in files[:-1] if file.exists())
            after = recorder_metrics(metrics_port)
            counts = [count for name, count in self.read.items() if name != files[-1].name]
            counts.append(count_of(BytesIO(newest), files[-1].name)[0])
            found = _compare(counts, before, after, left)
            if sizes > KEEP_MB * 1e6:
                found.append(f"recordings take {sizes} bytes of {KEEP_MB:g} MB")
        return found

    def finish(self) -> str:
        """After the end of the daemon: read and replay what is left. Returns what there was, in words."""
        left, samples, checks = self._files(), 0, 0
        for file in left:
            self._read(file)
            file_samples, file_checks = self._replay(file)
            samples, checks = samples + file_samples, checks + file_checks
        numbers = sorted(int(name.split("-")[2].removesuffix(".imudrec")) for name in self.read)
        if numbers != list(range(len(numbers))):
            self.problems.append(f"files were removed before they could be read: there are {numbers}")
        if len(left) == len(self.read) and sum(count.bytes for count in self.read.values()) > KEEP_MB * 1e6:
            self.problems.append(f"no file of {len(left)} was removed, and they take more than {KEEP_MB:g} MB")
        total = sum(count.records for count in self.read.values())
        lost = sum(count.lost for count in self.read.values())
        return (
            f"{len(self.read)} recordings, {len(self.read) - len(left)} of them removed, {total} records, {lost} lost; "
            f"{len(left)} replayed: {samples} samples, {checks} checks"
        )

    def _files(self) -> list[Path]:
        return sorted(self.directory.glob("*.imudrec"))

    def _read(self, file: Path) -> None:
        try:
            with file.open("rb") as opened:
                self.read[file.name], problems = count_of(opened, file.name)
        except OSError as error:
            problems = [str(error)]
        self.problems += [f"{file.name}: {problem}" for problem in problems]

    def _replay(self, file: Path) -> tuple[int, int]:
        """Replay a file; returns samples and places where it was compared with the run."""
        samples = 0

        def publish(batch: Batch) -> None:
            nonlocal samples
            samples += len(batch.samples)

        player = Player(publish)
        try:
            with file.open("rb") as opened:
                player.play(RecordingReader(opened, file.name))
        except ImudError as error:
            self.problems.append(f"{file.name}: {error}")
        for device in player.devices.values():
            self.problems += [
                f"{file.name}: {device.described.name}: {one}" for one in device.differences[:1] + device.fresh_starts
            ]
        return samples, sum(device.checks for device in player.devices.values())


def _compare(counts: list[Count], before: Mapping[str, int], after: Mapping[str, int], files_left: int) -> list[str]:
    """What of the files is not between the counters of before and after."""
    pairs = {
        "records": sum(count.records for count in counts),
        "records_dropped": sum(count.lost for count in counts),
        "written_bytes": sum(count.bytes for count in counts),
        "files_removed": len(counts) - files_left,
    }
    return [
        f"recorder: {name} {before[name]} to {after[name]}, in the files {value}"
        for name, value in pairs.items()
        if not before[name] <= value <= after[name]
    ]


def count_of(file: BinaryIO, name: str) -> tuple[Count, list[str]]:
    count, reader = Count(), RecordingReader(file, name)
    try:
        for record in reader:
            count.records += 1
            if record.kind == Kind.LOST:
                count.lost += records.decode_lost(record.body).records
    except ImudError as error:
        return count, [str(error)]
    count.bytes = reader.stored_bytes
    return count, reader.problems


def recorder_metrics(port: int) -> dict[str, int]:
    with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=SCRAPE_LIMIT_S) as answer:
        lines = answer.read().decode().splitlines()
    found = {}
    for line in lines:
        name, _, value = line.partition(" ")
        if name.startswith(("imud_recorder_", "imud_recordings_")):
            short = name.removeprefix("imud_recorder_").removeprefix("imud_recordings_").removesuffix("_total")
            found[short] = int(float(value))
    return found
