"""Files of the state directory: the daemon starts and continues for any content of the files."""

import atexit
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final

import msgspec

from imud.device import flash
from imud.device import search as remembered
from imud.device.flash import LIMIT_ASKED, MODULES_MAX, FlashWrites
from imud.device.search import Remembered, RememberedDevice
from imud.host.clock import HostClock
from imud.model.units import NS_PER_S
from tests.fuzz.target import Target

UTC_NS: Final = 1_800_000_000 * NS_PER_S
MODULE: Final = "hipnuc 0123"


def names() -> Sequence[str]:
    return ["json"]


def make(_name: str) -> Target:
    return Target(run, seeds, words=words)


@cache
def _folder() -> Path:
    folder = tempfile.TemporaryDirectory(prefix="imud-fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
    atexit.register(folder.cleanup)
    return Path(folder.name)


def run(data: bytes) -> None:
    """Read the file as both kinds. Read the files again that the daemon then writes."""
    folder = _folder()
    (folder / remembered.FILE_NAME).write_bytes(data)
    devices = Remembered(folder)
    assert isinstance(devices.get("bow"), RememberedDevice | None)
    devices.put("new", RememberedDevice("hipnuc-uart", 115200))
    devices.close()
    assert Remembered(None).get("new") is None
    again = msgspec.json.decode((folder / remembered.FILE_NAME).read_bytes(), type=dict[str, RememberedDevice])
    assert again["new"] == devices.get("new")
    (folder / flash.FILE_NAME).write_bytes(data)
    writes = FlashWrites(folder, HostClock(lambda: 0, lambda: UTC_NS, lambda: 0))
    before = writes.record(MODULE).writes
    assert bool(writes.refusal(MODULE, asked=True)) == (writes.writes_day(MODULE) >= LIMIT_ASKED)
    writes.count(MODULE)
    assert writes.record(MODULE).writes == before + 1
    assert 1 <= writes.writes_day(MODULE) <= LIMIT_ASKED
    writes.keep_unreadable(MODULE, {"a": 1})
    writes.close()
    kept = msgspec.json.decode((folder / flash.FILE_NAME).read_bytes(), type=dict[str, flash.ModuleRecord])
    assert len(kept) <= MODULES_MAX
    assert kept[MODULE].writes == before + 1


def seeds() -> list[bytes]:
    record = {"writes": 3, "times_s": [UTC_NS // NS_PER_S - 5, 2**40], "told": {"rate_hz": 100, "axes": [1, None]}}
    found = {"bow": {"driver": "hipnuc-uart", "baud": 921600}, "c": {"driver": "imu61x-can", "baud": 0, "node": 5}}
    trees = [
        found, {MODULE: record}, {MODULE: {"writes": 2**63 - 1}}, {MODULE: {"writes": 2**64 - 1, "times_s": [2**63]}},
        {MODULE: {"writes": -5, "times_s": list(range(100))}}, {}, [], {str(n): {} for n in range(50)},
    ]  # fmt: skip
    texts = [b"", b"[" * 3000, b"\xff", b'{"hipnuc 0123":{"writes":1e3,"told":{"a":1e400}}}', b"{" * 10]
    huge = b'{"hipnuc 0123":{"writes":' + b"9" * 40 + b',"times_s":[' + b"9" * 40 + b"]}}"
    return [*map(msgspec.json.encode, trees), *texts, huge]


def words() -> list[bytes]:
    return [f'"{word}"'.encode() for word in (MODULE, "writes", "times_s", "told", "bow", "driver", "baud", "node")]
