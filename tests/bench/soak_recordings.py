"""The checks of `make soak` for the recorder: each file before its removal, and the counters of the recorder.

A file is read completely when the next file exists. The size limit removes all files except the newest ones, so each
file is read soon. The numbers of records, lost records, bytes and removed files must agree with the metrics of the
recorder. The remaining files are replayed and compared with the run.
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

FILE_MB: Final = 1.0  # small, so that the budget removes files during the run
KEEP_MB: Final = 3.0
"""Size limit of all files, MB: one file, and the data that the recorder writes until the file is read."""
SCRAPE_LIMIT_S: Final = 5.0
CLOSE_LIMIT_S: Final = 20.0
"""Maximum time for a consistent reading of files and counters, s. The recorder writes a block once per second."""


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
        """Read the finished files. Call more often than new files start."""
        for file in self._files()[:-1]:
            if file.name not in self.read:
                self._read(file)

    def close_account(self, metrics_port: int) -> list[str]:
        """Compare the files with the counters of the recorder while the daemon writes. Return the differences.

        The values of the files must be between the counters before and after the read. While the recorder writes a
        block, a counter may be ahead of the file. The comparison is then repeated.
        """
        end, found = monotonic() + CLOSE_LIMIT_S, ["the recorder: no comparison of files and counters"]
        while found and monotonic() < end:
            self.look()
            before = recorder_metrics(metrics_port)
            files = self._files()
            # the newest file grows: read it between two reads of the counters
            left, newest = len(files), files[-1].read_bytes()
            sizes = len(newest) + sum(file.stat().st_size for file in files[:-1] if file.exists())
            after = recorder_metrics(metrics_port)
            counts = [count for name, count in self.read.items() if name != files[-1].name]
            counts.append(count_of(BytesIO(newest), files[-1].name)[0])
            found = _compare(counts, before, after, left)
            if sizes > KEEP_MB * 1e6:
                found.append(f"recordings: expected at most {KEEP_MB:g} MB, got {sizes} bytes")
        return found

    def finish(self) -> str:
        """Read and replay the remaining files after the end of the daemon. Return a summary as text."""
        left, samples, checks = self._files(), 0, 0
        for file in left:
            self._read(file)
            file_samples, file_checks = self._replay(file)
            samples, checks = samples + file_samples, checks + file_checks
        # files have consecutive numbers; a missing number is a file that was removed unread
        numbers = sorted(int(name.split("-")[2].removesuffix(".imudrec")) for name in self.read)
        if numbers != list(range(len(numbers))):
            self.problems.append(
                f"recordings: expected consecutive file numbers, got {numbers}; files were removed before the check"
            )
        if len(left) == len(self.read) and sum(count.bytes for count in self.read.values()) > KEEP_MB * 1e6:
            self.problems.append(f"recordings: expected removed files above {KEEP_MB:g} MB, got all {len(left)} files")
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
        """Replay a file. Return the number of samples and the number of comparisons with the run."""
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
    """Return the values of the files that are not between the counters before and after."""
    pairs = {
        "records": sum(count.records for count in counts), "records_dropped": sum(count.lost for count in counts),
        "written_bytes": sum(count.bytes for count in counts), "files_removed": len(counts) - files_left,
    }  # fmt: skip
    return [
        f"recorder: expected {name} from {before[name]} to {after[name]}, got {value} in the files"
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
