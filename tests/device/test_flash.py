"""Flash writes: counted over all runs, limited per day, with any wall clock."""

from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
import yaml

from imud.device.flash import FILE_NAME, BackupFolder, FlashValues, FlashWrites, ModuleFlash, backup_text
from imud.host.clock import HostClock
from imud.model.units import NS_PER_S

DAY_S = 86_400
LIMIT_ASKED = 40
LIMIT_ITSELF = 4
MODULES_MAX = 1024

BEGIN_S = 1_800_000_000


class Days:
    """A wall clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = BEGIN_S

    @property
    def host(self) -> HostClock:
        return HostClock(lambda: 0, lambda: self.now_s * NS_PER_S, lambda: 0)


def test_the_limit_of_imud_itself_is_lower_than_the_limit_of_users() -> None:
    days = Days()
    writes = FlashWrites(None, days.host)
    itself, asked = (partial(writes.refusal, "A", asked=asked) for asked in (False, True))
    for number in range(LIMIT_ASKED):
        assert bool(itself()) == (number >= LIMIT_ITSELF)
        assert not asked()
        ModuleFlash(writes, "A", asked=True).spend()
        days.now_s += 1
    assert "written 40 times in 24 hours, the limit is 40" in asked()
    assert "the limit of imud itself" in itself()
    assert not writes.refusal("B", asked=False)
    days.now_s = BEGIN_S + DAY_S + LIMIT_ASKED - LIMIT_ITSELF - 1
    assert itself()
    days.now_s += 1
    assert not itself()
    assert writes.record("A").writes == LIMIT_ASKED


def test_counts_survive_a_restart_of_imud(tmp_path: Path) -> None:
    days = Days()
    with closing(FlashWrites(tmp_path, days.host)) as writes:
        writes.count("A")
        writes.count("A")
        writes.keep_unreadable("A", {"secret": 5})
    with closing(FlashWrites(tmp_path, days.host)) as writes:
        assert writes.record("A").unreadable == {"secret": 5}
        assert (writes.record("A").writes, writes.writes_day("A")) == (2, 2)
        assert (writes.record("B").writes, writes.record("B").unreadable) == (0, {})


def test_a_wrong_clock_does_not_forbid_writes_and_the_modules_written_last_are_remembered() -> None:
    days = Days()
    days.now_s += 10 * 365 * DAY_S
    writes = FlashWrites(None, days.host)
    for _ in range(LIMIT_ITSELF):
        writes.count("A")
    days.now_s = BEGIN_S
    assert writes.writes_day("A") == LIMIT_ITSELF
    days.now_s += DAY_S
    assert writes.writes_day("A") == 0
    writes = FlashWrites(None, Days().host)
    for number in range(MODULES_MAX):
        writes.count(str(number))
    writes.count("0")
    writes.count("one more")
    assert [writes.record(name).writes for name in ("0", "1", "2", "one more")] == [2, 0, 1, 1]


@pytest.mark.parametrize("content", [b"{", b'{"A": {"writes": "x"}}', b"[]"])
def test_an_invalid_file_only_loses_the_counts(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / FILE_NAME).write_bytes(content)
    with closing(FlashWrites(tmp_path, Days().host)) as writes:
        assert writes.record("A").writes == 0
        writes.count("A")
    assert "counts the writes to flash from 0" in caplog.text
    with closing(FlashWrites(tmp_path, Days().host)) as writes:
        assert writes.record("A").writes == 1


BACKUPS_MAX = 10

T_NS = 1_795_000_000 * NS_PER_S  # 2026-11-18T11:06:40Z


def test_a_backup_has_identity_time_and_settings_and_the_newest_are_kept(tmp_path: Path) -> None:
    folder = BackupFolder(tmp_path / "state")
    other = folder.write("bow-2", "x", T_NS)
    files = [folder.write("bow", str(number), T_NS + number * NS_PER_S) for number in range(BACKUPS_MAX + 3)]
    assert {file.name for file in (tmp_path / "state" / "backups").iterdir()} == {
        other.name, *(file.name for file in files[3:]),
    }  # fmt: skip
    assert (files[-1].name, files[-1].read_text()) == ("bow.20261118T110652.000000Z.yaml", "12")
    assert files[-1].stat().st_mode & 0o007 == 0
    with pytest.raises(OSError, match="no state directory"):
        BackupFolder(None).write("bow", "x", T_NS)
    text = backup_text("bow", "hipnuc-uart", {"product": "HI14", "serial_number": "04"}, {"mode": "6-axis"}, T_NS)
    assert yaml.safe_load(text) == {
        "device": "bow", "driver": "hipnuc-uart", "time": "2026-11-18T11:06:40Z",
        "identity": {"product": "HI14", "serial_number": "04"}, "settings": {"mode": "6-axis"},
    }  # fmt: skip
    assert text.startswith("# Settings of bow as the device reported them. `imud settings bow --restore FILE`")


def test_a_value_is_lost_unless_flash_contains_it_and_unknown_values_are_named() -> None:
    flash = FlashValues()
    now = {"same": 1, "differs": 3, "unknown": 4, "unchanged": 5}
    flash.saved({"same": 1, "differs": 2}, is_certain=True)
    before = {"same": 9, "differs": 3, "unknown": 9, "unchanged": 5}  # another program changed them without a save
    assert flash.lost(before, now) == ({"differs": 3, "unknown": 4}, ("unknown",))
    assert flash.lost(None, now) == ({"differs": 3}, ())
