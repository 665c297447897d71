"""Options of all tests: the Hypothesis profiles, the time limit of `live` tests, and a check that no other test waits.

A test of logic receives the time as an argument. A `live` test runs a real daemon, server or browser. It waits for a
condition with `wait_until`.
"""

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from tests.support.leaks import open_descriptors

if TYPE_CHECKING:
    from tests.support.rings import Board

LIVE_TIMEOUT_S: Final = 300
"""Time limit of a `live` test: several waits of 60 s."""
WAIT_MAX_S: Final = 0.02
"""Longest sleep in a test of logic. A poll of the kernel or of a thread needs a few milliseconds."""

_sleep = time.sleep


def pytest_configure(config: pytest.Config) -> None:
    """Register the Hypothesis profiles and load `gate`, or the profile of `--hypothesis-profile`."""
    os.environ["IMUD_PLUGINS"] = "off"  # other installed packages do not change the tests and their processes
    if not config.pluginmanager.has_plugin("hypothesispytest"):  # the lab runs without Hypothesis
        return
    from hypothesis import HealthCheck, settings

    slow = [HealthCheck.too_slow]  # a loaded host makes the generation of inputs slow
    settings.register_profile(
        "gate", max_examples=30, derandomize=True, deadline=None, database=None, suppress_health_check=slow
    )
    settings.register_profile("thorough", max_examples=1000, deadline=None, suppress_health_check=slow)
    settings.load_profile(config.getoption("--hypothesis-profile", None) or "gate")


def is_live(item: pytest.Item) -> bool:
    """Return whether a test may wait in real time: it has the marker `live`, or it runs in the lab."""
    return item.get_closest_marker("live") is not None or item.nodeid.startswith("tests/lab/")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give `live` tests their time limit and start them first: the short tests then fill the gaps between them."""
    limit_s = max(LIVE_TIMEOUT_S, config.getoption("--timeout", None) or 0)  # an emulated host needs more
    for item in items:
        if item.get_closest_marker("live"):
            item.add_marker(pytest.mark.timeout(limit_s))
    items.sort(key=lambda item: not is_live(item))


END_MAX_S: Final = 10.0  # maximum time to the end of a thread, s


def _refuse_to_wait(seconds: float) -> None:
    assert seconds <= WAIT_MAX_S, f"a test without the marker `live` waits {seconds} s: pass the time as an argument"
    _sleep(seconds)


@pytest.fixture(autouse=True)
def _no_waiting(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `time.sleep` fail in a test of logic if it waits for a fixed duration."""
    if not is_live(request.node):
        monkeypatch.setattr(time, "sleep", _refuse_to_wait)


@pytest.fixture(autouse=True)
def _signals() -> Iterator[None]:
    """Restore the signal handlers: a daemon that ended in this process leaves them ignored, also for children."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        if signal.getsignal(number) is not handler:
            signal.signal(number, handler)


@pytest.fixture
def board(tmp_path: Path) -> "Iterator[Board]":
    """Yield a publisher of shared memory in a folder of its own."""
    from tests.support.rings import Board

    made = Board(tmp_path)
    yield made
    made.publisher.close()


@pytest.fixture(autouse=True)
def _nothing_left(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail if a test of logic leaves a descriptor open or a thread running."""
    # foxglove-sdk and the servers of the fuzz targets keep their event loop until the process ends
    if is_live(request.node) or request.node.nodeid.startswith(("tests/web/test_foxglove", "tests/fuzz/")):
        yield
        return
    before, threads = open_descriptors(), set(threading.enumerate())
    yield
    left = {number: file for number, file in open_descriptors().items() if number not in before}
    # matplotlib keeps its fonts open, `imud` writes to /dev/null after a broken pipe
    assert not {file for file in left.values() if not file.endswith((".ttf", "/dev/null"))}, left
    running = {thread for thread in threading.enumerate() if thread.daemon} - threads
    for thread in running:  # a thread may end slightly later than its owner
        thread.join(END_MAX_S)
    assert not {thread for thread in running if thread.is_alive()}
