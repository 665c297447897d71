"""Directory of recordings: names, order, and a limit that removes only recordings."""

from pathlib import Path

from imud.model.units import NS_PER_S
from imud.publishers.recorder.directory import NAME, RecordingDirectory


def filled(folder: Path, keep_bytes: int, *sizes: int) -> RecordingDirectory:
    directory = RecordingDirectory(folder / "recordings", keep_bytes)
    directory.make()
    for number, size in enumerate(sizes):
        directory.new_file((1_763_717_507 + number) * NS_PER_S, 7, number).write_bytes(bytes(size))
    return directory


def test_names_sort_by_time_and_are_recognized(tmp_path: Path) -> None:
    directory = filled(tmp_path, 1000, 10, 20)
    assert directory.new_file(1_763_717_507 * NS_PER_S, 0x1_0000_00AB, 12).name == (
        "20251121T093147Z-000000ab-000012.imudrec"
    )
    assert [file.size for file in directory.files()] == [10, 20]
    assert all(NAME.fullmatch(file.name) for file in directory.files())


def test_the_oldest_are_removed_until_there_is_room(tmp_path: Path) -> None:
    directory = filled(tmp_path, 100, 40, 30, 20)
    assert len(directory.make_room(10)) == 0
    (removed,) = directory.make_room(11)
    assert removed.endswith("-000000.imudrec")
    assert [file.size for file in directory.files()] == [30, 20]
    assert directory.removed == 1


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


def test_the_measured_size_excludes_open_files(tmp_path: Path) -> None:
    directory = filled(tmp_path, 100, 40, 30, 20)
    assert directory.kept_bytes == 0
    directory.measure()
    assert directory.kept_bytes == 90
    directory.in_use.add(directory.files()[-1].name)
    directory.make_room(20)
    assert directory.kept_bytes == 30  # imud removed the oldest file, and the newest is open
    directory.add(7)
    assert directory.kept_bytes == 37
