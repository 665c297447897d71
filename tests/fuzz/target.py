"""A fuzz target, the table of the groups of targets, and the corpus in the tree.

The name of a target is `group/name`. DRIVERS contains the names of some groups. The corpus contains for each target the
seeds of its encoders, and inputs of earlier findings.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import sha1
from importlib import import_module
from pathlib import Path
from random import Random
from typing import Final

INPUT_BYTES_MAX: Final = 4096
"""Default maximum length of an input, bytes: several frames or requests, and short enough to be fast."""
FRAMES_BYTES_MAX: Final = 2048


def as_it_is(data: bytes, _random: Random) -> bytes:
    return data


@dataclass(frozen=True, slots=True)
class Target:
    run: Callable[[bytes], None]
    """Function that raises an exception for an input that violates an invariant. Each exception is a finding."""
    seeds: Callable[[], Sequence[bytes]]
    """Function that returns valid inputs as a start, made by encoders: a few dozen, the same for each call."""
    mend: Callable[[bytes, Random], bytes] = as_it_is
    """Function that corrects check values after a mutation, so that the fuzzer reaches the code behind them."""
    words: Callable[[], Sequence[bytes]] = tuple
    bytes_max: int = INPUT_BYTES_MAX


def check_printable(text: str) -> None:
    """Raise an exception if the text could forge a log line or control a terminal."""
    assert text.isprintable(), ascii(text)


GROUPS: Final = {
    "stream": "tests.fuzz.streams", "can": "tests.fuzz.can", "polled": "tests.fuzz.polled",
    "script": "tests.fuzz.scripts", "config": "tests.fuzz.configuration", "socket": "tests.fuzz.rpc",
    "file": "tests.fuzz.files", "shm": "tests.fuzz.shm", "utc": "tests.fuzz.utc", "http": "tests.fuzz.scrape",
    "mqtt": "tests.fuzz.broker", "fleet": "tests.fuzz.fleet", "command": "tests.fuzz.commands",
    "ros2": "tests.fuzz.dds", "influx": "tests.fuzz.influx", "state": "tests.fuzz.state",
    "client": "tests.fuzz.answers", "firmware": "tests.fuzz.firmware", "peer": "tests.fuzz.peers",
    "node": "tests.fuzz.nodes", "page": "tests.fuzz.page",
}  # fmt: skip
"""Module of each group. `names` returns the names of its targets. `make` makes a target and imports the tested code, so
that only the code of this target is instrumented."""
CORPUS: Final = Path(__file__).parent / "corpus"
BY_HAND: Final = "finding-"
"""Start of the name of a manually added input. The name of a seed's file is its hash."""


def all_names() -> list[str]:
    return [f"{kind}/{name}" for kind, module in GROUPS.items() for name in import_module(module).names()]


def load(name: str) -> Target:
    kind, _, rest = name.partition("/")
    made: Target = import_module(GROUPS[kind]).make(rest)
    return made


def folder_of(target: str) -> Path:
    return CORPUS / target.replace("/", "-").replace("c-header", "shm-ring")


def inputs_of(target: str) -> list[Path]:
    return sorted(folder_of(target).glob("*"))


def write_all() -> int:
    total = 0
    for target in all_names():
        folder = folder_of(target)
        folder.mkdir(parents=True, exist_ok=True)
        for old in inputs_of(target):
            if not old.name.startswith(BY_HAND):
                old.unlink()
        for seed in load(target).seeds():
            (folder / sha1(seed, usedforsecurity=False).hexdigest()[:16]).write_bytes(seed)
        size = sum(path.stat().st_size for path in inputs_of(target))
        total += size
        print(f"{target:24} {len(inputs_of(target)):4} files {size:8} bytes")
    print(f"total: {total} bytes")
    return 0
