"""Threads of the daemon: waits that end early, descriptors that end them, and the end of a worker."""

import asyncio
import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast
from unittest.mock import Mock, create_autospec

import pytest

from imud.host.threads import (
    BusThread,
    DescriptorWait,
    Job,
    WakeEvent,
    call_in_thread,
    rare_garbage_collection,
)
from tests.support.event_loops import in_loop

LIMIT_S = 60.0
NEVER_NS = 10**12


def unexpected(error: BaseException) -> None:
    raise error


def started(work: Callable[[], object], failed: Callable[[BaseException], None] = unexpected) -> BusThread:
    """Start a worker that calls `work`. If `work` returns None, the worker sleeps until it is woken."""
    job = SimpleNamespace(do_round=lambda: NEVER_NS if (rest := work()) is None else rest, round_failed=failed)
    return BusThread("worker", cast(Job, job))


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


@pytest.mark.parametrize("kind", [WakeEvent, DescriptorWait])
def test_rings_end_one_wait(kind: type[WakeEvent] | type[DescriptorWait]) -> None:
    waiter = kind()
    begun_s = time.monotonic()
    waiter.wait(0.01)
    assert time.monotonic() - begun_s >= 0.009
    for _ in range(2):  # a second ring adds no wait that ends early
        waiter.ring()
    waiter.wait(LIMIT_S)
    assert time.monotonic() - begun_s < LIMIT_S
    begun_s = time.monotonic()
    waiter.wait(0.01)
    assert time.monotonic() - begun_s >= 0.009
    if isinstance(waiter, DescriptorWait):
        waiter.close()


def test_a_descriptor_calls_once_per_arrival(pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = pipe
    waiter, calls = DescriptorWait(), list[int]()
    for number, is_usable in ((1023, True), (1024, False)):  # `select` does not accept larger numbers
        with monkeypatch.context() as patch:
            patch.setattr("imud.host.threads.select.epoll", Mock(return_value=Mock(fileno=lambda: number)))  # noqa: B023
            other = DescriptorWait()
        assert other.is_usable == is_usable
        other.close()
    waiter.add(reader, lambda: calls.append(reader))
    for expected in (1, 1, 2):  # the second wait has no new data: the bytes of the first wait are still unread
        if expected > len(calls):
            os.write(writer, b"a")
        waiter.wait(0.001)
        assert len(calls) == expected
    waiter.discard(reader)
    waiter.discard(reader)
    os.write(writer, b"b")
    waiter.wait(0.001)
    assert len(calls) == 2
    waiter.add(reader, lambda: calls.append(-1))  # OSError if the kernel still knew the descriptor
    waiter.wait(LIMIT_S)
    assert calls[2:] == [-1]
    waiter.close()


def test_a_worker_sleeps_until_a_ring_or_a_descriptor(pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    rounds, arrived = threading.Semaphore(0), threading.Event()
    worker = started(rounds.release)
    assert rounds.acquire(timeout=LIMIT_S)
    assert "worker" in [thread.name for thread in threading.enumerate() if thread.daemon]
    worker.ring()
    assert rounds.acquire(timeout=LIMIT_S)
    worker.unwatch(pipe[0])  # no descriptor so far: does nothing
    with monkeypatch.context() as patch:
        patch.setattr("imud.host.threads.SELECT_FDS", 0)
        assert not worker.watch(pipe[0], arrived.set)
    assert worker.watch(pipe[0], arrived.set)
    assert rounds.acquire(timeout=LIMIT_S)  # the worker changes to the wait for descriptors
    os.write(pipe[1], b"a")
    assert arrived.wait(LIMIT_S)
    assert rounds.acquire(timeout=LIMIT_S)
    worker.ring()
    assert rounds.acquire(timeout=LIMIT_S)
    worker.unwatch(pipe[0])
    assert worker.end()
    assert worker.end()
    assert not rounds.acquire(blocking=False)


def test_a_worker_that_does_not_sleep_repeats_its_round_with_an_exact_timer(monkeypatch: pytest.MonkeyPatch) -> None:
    rounds, slack = threading.Semaphore(0), set[str]()
    join = create_autospec(threading.Thread.join, side_effect=threading.Thread.join)
    monkeypatch.setattr(threading.Thread, "join", join)

    def work() -> int:
        slack.add(Path(f"/proc/{threading.get_native_id()}/timerslack_ns").read_text().strip())
        rounds.release()
        return 0

    worker = started(work)
    assert all(rounds.acquire(timeout=LIMIT_S) for _ in range(3))
    assert worker.end()
    assert (slack, join.call_args.args[1:]) == ({"1"}, (5.0,))


def test_an_error_of_a_round_ends_the_worker_and_is_reported() -> None:
    errors, reported = list[BaseException](), threading.Event()

    def fail() -> int:
        raise KeyError("wrong")

    def report(error: BaseException) -> None:
        errors.append(error)
        reported.set()

    worker = started(fail, report)
    assert reported.wait(LIMIT_S)
    assert worker.end()
    assert [str(error) for error in errors] == ["'wrong'"]


def test_a_worker_in_a_transfer_does_not_end_yet(pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.host.threads.END_LIMIT_S", 0.001)
    free, begun = threading.Event(), threading.Event()

    def work() -> int:
        begun.set()
        free.wait(LIMIT_S)
        return 0

    worker = started(work)
    assert begun.wait(LIMIT_S)
    assert worker.watch(pipe[0], begun.clear)
    descriptors = worker._descriptors
    assert descriptors is not None
    assert not worker.end()
    descriptors.ring()  # OSError if `end` had closed the descriptors of a running thread
    free.set()
    worker._thread.join(LIMIT_S)
    assert worker.end()
    descriptors.close()


def test_settings_of_the_interpreter_are_restored() -> None:
    before, switch_s = gc.get_threshold(), sys.getswitchinterval()
    frozen = gc.get_freeze_count()
    with rare_garbage_collection(70_000):
        assert gc.get_threshold()[0] == 70_000
        assert gc.get_freeze_count() > frozen
    assert gc.get_threshold() == before
    assert gc.get_freeze_count() == 0
    try:
        for interval_s, expected_s in ((0.005, 0.0003), (0.0001, 0.0001)):  # a shorter interval stays
            sys.setswitchinterval(interval_s)
            started(lambda: None).end()
            assert sys.getswitchinterval() == pytest.approx(expected_s, abs=2e-6)
    finally:
        sys.setswitchinterval(switch_s)


@in_loop
async def test_call_returns_result_and_exception() -> None:
    def fail() -> None:
        raise SystemExit("no")  # an exception of each class belongs to the caller

    assert await call_in_thread("call", threading.get_ident) != threading.get_ident()
    with pytest.raises(SystemExit, match="no"):
        await call_in_thread("call", fail)


def test_hanging_call_does_not_delay_the_end() -> None:
    release = threading.Event()
    threads: list[threading.Thread] = []

    def hang() -> None:
        threads.append(threading.current_thread())
        release.wait(LIMIT_S)  # a failed assertion must not wait without a limit

    async def cancel() -> None:
        call = call_in_thread("call", hang)
        while not threads:
            await asyncio.sleep(0)
        call.cancel()

    asyncio.run(cancel())  # waits for the executor of the loop
    assert threads[0].daemon
    assert threads[0].is_alive()
    release.set()
    threads[0].join(LIMIT_S)
