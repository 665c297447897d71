"""The process ends with its status, although a thread never returns."""

import subprocess
import sys

import pytest

from imud.host.process_end import EndDeadline, blocking_threads, end_process

HANGING = """
import sys, threading
from imud.host import process_end
process_end.THREADS_LIMIT_S = 0.1
threading.Thread(target=threading.Event().wait, name="hang", daemon={daemon}).start()
print("the last line")
process_end.end_process({status})
sys.exit({status})
"""


@pytest.mark.live
@pytest.mark.parametrize(("daemon", "status"), [(False, 0), (False, 3), (True, 3)])
def test_thread_does_not_keep_the_process(daemon: bool, status: int) -> None:
    program = HANGING.format(daemon=daemon, status=status)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (status, "the last line\n")
    assert ("still running: hang" in done.stderr) is not daemon


def test_nothing_happens_without_other_threads() -> None:
    assert list(blocking_threads()) == []
    end_process(1)
    deadline = EndDeadline(60)
    deadline.start()
    deadline.cancel()
