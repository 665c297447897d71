"""Table of the groups of fuzz targets. The name of a target is `group/name`. DRIVERS contains the drivers."""

from importlib import import_module
from typing import Final, cast

from tests.fuzz.target import Target, TargetGroup

GROUPS: Final = {
    "stream": "tests.fuzz.streams", "can": "tests.fuzz.can", "polled": "tests.fuzz.polled",
    "script": "tests.fuzz.scripts", "config": "tests.fuzz.configuration", "socket": "tests.fuzz.rpc",
    "file": "tests.fuzz.files", "shm": "tests.fuzz.shm", "utc": "tests.fuzz.utc", "http": "tests.fuzz.scrape",
    "mqtt": "tests.fuzz.broker", "fleet": "tests.fuzz.fleet", "command": "tests.fuzz.commands",
    "state": "tests.fuzz.state", "client": "tests.fuzz.answers",
}  # fmt: skip
"""Module of each group. It is imported with its first target, so that only the code of this target is instrumented."""


def group(name: str) -> TargetGroup:
    return cast(TargetGroup, import_module(GROUPS[name]))


def all_names() -> list[str]:
    return [f"{kind}/{name}" for kind in GROUPS for name in group(kind).names()]


def load(name: str) -> Target:
    kind, _, rest = name.partition("/")
    return group(kind).make(rest)
