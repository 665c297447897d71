"""The program that runs under callgrind: `python -m tests.bench.instructions.measured [WORD …]`.

`mark` is a system call that nothing else here makes; callgrind begins a new dump before each (`--dump-before`). A stage
has three: before n operations, before 2 n, and after them. The names of the stages go to standard output, in order.
"""

import gc
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from tests.bench.instructions import virtual_time

MARK = "getpgid"
MARKS_PER_STAGE = 3


def mark() -> None:
    """Begin a new dump."""
    os.getpgid(0)


def main(words: Sequence[str]) -> None:
    """Run the stages whose names have one of `words` in them, all without any; print count and name of each."""
    virtual_time.install()
    stages = import_module("tests.bench.instructions.stages")
    for stage in stages.STAGES:
        if words and not any(word in stage.name for word in words):
            continue
        run = stage.make(stage.total)
        run(stages.WARM)
        gc.collect()
        gc.freeze()  # as the daemon does: collections need not look at what is there
        mark()
        run(stage.count)
        mark()
        run(2 * stage.count)
        mark()
        print(f"{stage.count * stage.per} {stage.name}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
