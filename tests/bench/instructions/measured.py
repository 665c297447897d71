"""The program under callgrind: `python -m tests.bench.instructions.measured DIRECTORY [WORD …]`.

Each stage runs in a process of its own, forked after all imports. Otherwise, an earlier stage would change the
specialized instructions of the interpreter. `mark` is a system call that no other code here uses. Before each such
call, callgrind starts a new dump of the process (`--dump-before`). A stage has three dumps: before n operations, before
2 n operations, and after them. The program prints the process id, n and the name of each stage in order.
"""

import gc
import os
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from tests.bench.instructions import virtual_time

MARK = "getpgid"  # system call that imud does not use
MARKS = 3  # dumps per stage
INTERPRETER = "interpreter: a loop without imud"
"""The stage that does not use imud. It shows differences between two builds of Python."""


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
        gc.freeze()  # like the daemon: collections skip the existing objects
        mark()
        operate(stage.count)
        mark()
        operate(2 * stage.count)
        mark()
        status = 0
    finally:
        if status:
            traceback.print_exc()
        os._exit(status)  # a normal exit would take seconds under callgrind


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
