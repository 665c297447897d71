"""Files of the state directory, and the states in recordings.

`json`: the daemon starts and continues for any content of the files. `recording`: a forged state supplies values only.
"""

import atexit
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, Final

import msgspec

from imud.device import flash
from imud.device import search as remembered
from imud.device.flash import LIMIT_ASKED, MODULES_MAX, FlashWrites
from imud.device.search import Remembered, RememberedDevice
from imud.formats.state import StateError, attribute_names
from imud.host.clock import HostClock, SteadyTime
from imud.model.errors import ImudError
from imud.model.units import NS_PER_S
from imud.sampling.state import load_path, load_steady
from tests.fuzz.target import Target, check_printable
from tests.support import states

UTC_NS: Final = 1_800_000_000 * NS_PER_S
MODULE: Final = "hipnuc 0123"
STATE_BYTES_MAX: Final = 1 << 14  # maximum length of an input with a state of a path, bytes
DRIVERS: Final = ("hipnuc-uart", "imu61x-uart", "hipnuc-canopen", "hipnuc-nmea2000", "imu61x-can", "imu61x-spi")
SAMPLES: Final = 20  # number of samples before and after a state


def names() -> Sequence[str]:
    return ["json", "recording"]


def make(name: str) -> Target:
    if name == "recording":
        return Target(run_recording, recording_seeds, change_value, bytes_max=STATE_BYTES_MAX)
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


# --- states in recordings -----------------------------------------------------------------------------------------


def run_recording(data: bytes) -> None:
    """Load the state and replay samples after it. The first byte selects the driver.

    The state imports no module and changes only values in the tables. The replay ends, at worst with ImudError.
    """
    driver, state = DRIVERS[data[0] % len(DRIVERS) if data else 0], data[1:]
    rest, modules = _rest(driver), set(sys.modules)
    path = states.path_of(driver, 0)
    constants = _constants(path)
    with suppress(StateError):
        load_path(path, state)
    with suppress(StateError):
        load_steady(SteadyTime(), state)
    assert all(constants.get(key, value) is value for key, value in _constants(path).items())
    for table, value in states.objects_of(path):
        assert attribute_names(value) <= table.names
    start = [states.host_record(state), states.device_record(driver), states.path_record(driver, state)]
    with suppress(ImudError):
        states.play([*start, *rest])
    try:
        _, device, _ = states.play([*start[1:], *rest])
        for reason in device.fresh_starts:
            check_printable(reason)
    except ImudError as error:
        check_printable(str(error))
    assert set(sys.modules) == modules


@cache
def _rest(driver: str) -> list[bytes]:
    """Return the samples after the state. This also imports the modules of the driver."""
    states.state_of(driver, SAMPLES)
    return list(states.inputs(driver, SAMPLES, SAMPLES, aided=driver.endswith("uart")))


def _constants(path: Any) -> dict[tuple[int, str], Any]:
    """Return the attributes that a constructor or the daemon sets."""
    return {
        (id(value), name): getattr(value, name, None)
        for table, value in states.objects_of(path)
        for name, reason in table.other.items()
        if reason in ("set by the constructor", "part of the daemon", "from the options of the driver")
    }


def recording_seeds() -> list[bytes]:
    """Return a state of each driver, two states with edges and triggers, and a state of the host clocks."""
    found = [bytes([number]) + states.state_of(driver, SAMPLES) for number, driver in enumerate(DRIVERS)]
    aided = [bytes([number]) + states.state_of(DRIVERS[number], 120, aided=True) for number in (0, 1)]
    return [*found, *aided, b"\0" + states.steady_state(8)]


def change_value(data: bytes, random: Random) -> bytes:
    """Replace one value of a state. If a mutation damaged the MessagePack, use the state of the driver."""
    number = data[0] % len(DRIVERS) if data else 0
    try:
        tree = states.decoded(data[1:])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        tree = states.decoded(_seed_state(DRIVERS[number]))
    place = random.choice(list(states.leaves(tree)))
    try:
        state = msgspec.msgpack.encode(states.replaced(tree, place, random.choice(states.BAD_VALUES)))
    except (OverflowError, TypeError, ValueError):
        return data
    return bytes([number]) + state


@cache
def _seed_state(driver: str) -> bytes:
    return states.state_of(driver, SAMPLES)
