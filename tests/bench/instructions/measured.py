"""The program that runs under callgrind: `python -m tests.bench.instructions.measured DIRECTORY [WORD …]`.

Each stage has a process of its own, forked after all imports: what ran before would change how the interpreter has
specialised its instructions. `mark` is a system call that nothing else here makes; callgrind begins a new dump of the
process before each (`--dump-before`). A stage has three: before n operations, before 2 n, and after them. Process, n
and name of each stage go to standard output, in order.
"""

import gc
import os
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from tests.bench.instructions import virtual_time

MARK = "getpgid"
MARKS = 3


def mark() -> None:
    os.getpgid(0)


def main(directory: str, words: Sequence[str]) -> int:
    virtual_time.install()
    stages = import_module("tests.bench.instructions.stages")
    for number, stage in enumerate(stages.STAGES):
        if words and not any(word in stage.name for word in words):
            continue
        pid = os.fork()
        if not pid:
            run(stage, f"{directory}/{number}")
        _, status = os.waitpid(pid, 0)
        if status:
            print(f"{stage.name} failed", file=sys.stderr)
            return 1
        print(f"{pid} {stage.count * stage.per} {stage.name}", flush=True)
    return 0


def run(stage: Any, directory: str) -> None:
    status = 1
    try:
        os.mkdir(directory)
        operate = stage.make(stage.total, directory)
        operate(stage.warm)
        gc.collect()
        gc.freeze()  # as the daemon does: collections need not look at what is there
        mark()
        operate(stage.count)
        mark()
        operate(2 * stage.count)
        mark()
        status = 0
    finally:
        if status:
            traceback.print_exc()
        os._exit(status)  # callgrind would count the end for seconds


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
