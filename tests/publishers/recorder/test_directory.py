"""Directory of recordings: names, order, and a limit that removes only recordings."""

import os
from pathlib import Path
from unittest.mock import Mock, patch

import pytest

from imud.model.units import NS_PER_S
from imud.publishers.recorder.directory import NAME, SNAPSHOT, FlightOptions, RecorderOptions, RecordingDirectory


def filled(folder: Path, keep_bytes: int, *sizes: int) -> RecordingDirectory:
    directory = RecordingDirectory(folder / "recordings", keep_bytes)
    directory.make()
    for number, size in enumerate(sizes):
        directory.new_file((1_763_717_507 + number) * NS_PER_S, 7, number).write_bytes(bytes(size))
    return directory


def test_names_sort_by_time_and_are_recognized(tmp_path: Path) -> None:
    directory = filled(tmp_path, 1000, 10, 20)
    name = directory.new_file(1_763_717_507 * NS_PER_S, 0x1_0000_00AB, 12).name
    assert (name, [file.size for file in directory.files()]) == ("20251121T093147Z-000000ab-000012.imudrec", [10, 20])
    with patch("imud.publishers.recorder.directory.FILES_MAX", 1):
        assert len(directory.files()) == 1
    with pytest.raises(ValueError, match=f"another directory than {tmp_path}, got the same"):
        RecorderOptions(directory=str(tmp_path), flight=FlightOptions(directory=f"{tmp_path}/."))
    with pytest.raises(ValueError, match="room for two files of file_mb"):
        RecorderOptions(keep_gb=0.199)
    with pytest.raises(ValueError, match="room for a snapshot"):
        RecorderOptions(keep_gb=0.263, enabled=True, flight=FlightOptions(enabled=True))
    for keep_gb, enabled in ((0.264, True), (0.2, False)):  # two files of 100 MB and a snapshot of 64 MB
        options = RecorderOptions(keep_gb=keep_gb, enabled=enabled, flight=FlightOptions(enabled=True))
    assert options.keep_bytes == 200_000_000
    assert all(NAME.fullmatch(file.name) for file in directory.files())


def test_the_oldest_are_removed_until_there_is_room(tmp_path: Path) -> None:
    directory = filled(tmp_path, 100, 40, 30, 20)
    assert len(directory.make_room(10)) == 0
    (removed,) = directory.make_room(11)
    assert removed.endswith("-000000.imudrec")
    assert ([file.size for file in directory.files()], directory.removed) == ([30, 20], 1)
    directory = filled(tmp_path / "measured", 100, 40, 30, 20)
    assert directory.kept_bytes == 0
    directory.measure()
    assert directory.kept_bytes == 90
    directory.in_use.add(directory.files()[-1].name)
    directory.make_room(20)
    assert directory.kept_bytes == 30  # imud removed the oldest file, and the newest is open
    directory.add(7)
    assert directory.kept_bytes == 37


def test_the_open_file_and_other_files_are_not_removed(tmp_path: Path) -> None:
    directory = filled(tmp_path, 10, 50, 50)
    foreign = [directory.path / name for name in ("mine.imudrec", "20251121T093147Z-000000ab-000012.imudrec.gz")]
    for path in foreign:
        path.write_bytes(bytes(50))
    (directory.path / "20251121T093147Z-00000000-000012.imudrec").symlink_to(foreign[0])
    newest = directory.files()[-1].name
    directory.in_use.add(newest)
    directory.make_room(0)
    assert [file.name for file in directory.files()] == [newest]
    assert all(path.exists() for path in foreign)


CASES = {
    "the numbers decide within a run": ([("aa", 9, "", 2), ("aa", 10, "", 1)], "", ["aa 9", "aa 10"]),
    "snapshots between recordings": (
        [("aa", 0, "", 1), ("aa", 0, SNAPSHOT, 2), ("aa", 1, "", 3)], "", ["aa 0", "aa 0-snapshot", "aa 1"],
    ),
    "unknown runs by time": ([("aa", 5, "", 2), ("bb", 0, "", 3), ("cc", 7, "", 1)], "", ["cc 7", "aa 5", "bb 0"]),
    "the clock was years ahead in an earlier run": (
        [("aa", 0, "", 9), ("bb", 0, "", 2), ("cc", 0, "", 3)], "aa bb", ["cc 0", "aa 0", "bb 0"],
    ),
    "the clock is behind now": (
        [("01", 0, "", 1), ("01", 1, "", 2), ("aa", 3, "", 8), ("bb", 4, "", 9)], "aa bb",
        ["aa 3", "bb 4", "01 0", "01 1"],
    ),
    "damaged list of runs": ([("01", 0, "", 1), ("aa", 0, "", 9)], "\0 \x80x", ["aa 0", "01 0"]),
}  # fmt: skip


@pytest.mark.parametrize(("files", "known", "removed"), CASES.values(), ids=CASES)
def test_the_order_of_removal_does_not_depend_on_the_wall_clock(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, files: list[tuple[str, int, str, int]], known: str,
    removed: list[str],
) -> None:  # fmt: skip
    """Files as (run, number, kind, time of the last write). The time in the name is the same for all files."""
    caplog.set_level("INFO")
    for run, number, kind, time_s in files:
        path = tmp_path / f"20260101T000000Z-{run:0>8}-{number:06d}{kind}.imudrec"
        path.write_bytes(bytes(10))
        os.utime(path, (time_s, time_s))
    runs = b"".join(b"%08s\n" % run.encode("latin-1") for run in known.split())
    (tmp_path / ".runs").write_bytes(runs.replace(b" ", b"0"))
    directory = RecordingDirectory(tmp_path, 0)
    following = max([number + 1 for run, number, kind, _ in files if (run, kind) == ("01", "")], default=0)
    assert directory.begin_run(1) == following  # the files after a reload continue the numbers
    words = [name.removesuffix(".imudrec").split("-", 2)[1:] for name in directory.make_room(0)]
    assert [f"{run[6:]} {int(number[:6])}{number[6:]}" for run, number in words] == removed
    logged = [record.getMessage() for record in caplog.records]
    assert [text.startswith(f"removed the oldest recording {tmp_path}/") for text in logged] == [True] * len(files)


def test_files_of_this_run_have_the_order_of_their_creation(tmp_path: Path) -> None:
    """The wall clock was years ahead and is then set back, so that the snapshot has the oldest time."""
    directory = RecordingDirectory(tmp_path, 0)
    directory.begin_run(1)
    made = [directory.new_file(2_000_000_000 * NS_PER_S, 1, 0), directory.new_file(0, 1, 0, SNAPSHOT)]
    for path, time_s in zip(made, (2_000_000_000, 1), strict=True):
        path.write_bytes(b"1")
        os.utime(path, (time_s, time_s))
    assert [file.name for file in directory.files()] == [path.name for path in made]


def test_the_order_of_runs_after_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse = Mock(side_effect=OSError)
    directory, runs = RecordingDirectory(tmp_path, 100), tmp_path / ".runs"
    with monkeypatch.context() as patch:
        patch.setattr("imud.publishers.recorder.directory.replace_file", refuse)
        directory.begin_run(0xAA)
    assert not runs.exists()
    directory.new_file(0, 0xAA, 0).touch()
    directory.make_room(0)
    RecordingDirectory(tmp_path, 100).begin_run(0xBB)
    assert runs.read_text().split() == ["000000aa", "000000bb"]
    RecordingDirectory(tmp_path, 100).begin_run(0xCC)
    assert runs.read_text().split() == ["000000aa", "000000cc"]  # the second run has no file
