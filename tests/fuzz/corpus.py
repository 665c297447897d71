"""The corpus in the tree: for each target the seeds of its encoders, and inputs of earlier findings.

The name of a seed's file is its hash. The name of a manually added input begins with `finding-`.
"""

from hashlib import sha1
from pathlib import Path
from typing import Final

from tests.fuzz.groups import all_names, load

ROOT: Final = Path(__file__).parent / "corpus"
BY_HAND: Final = "finding-"


def folder_of(target: str) -> Path:
    return ROOT / target.replace("/", "-").replace("c-header", "shm-ring")


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
