"""A failure of any class belongs to the owner of the callback or task, and the loop continues."""

import asyncio
import os
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from imud.host import event_loop
from imud.host.event_loop import Alarm, SampleLoop
from imud.host.scope import INHERITED, INNERMOST, Scope, ThreadScopes, words_of


class OwnError(BaseException):
    """Exception of another package that is not an `Exception`."""


class UnprintableError(Exception):
    """Exception whose message fails."""

    def __str__(self) -> str:
        raise SystemExit(5)


ERRORS: list[BaseException] = [
    RuntimeError("boom"), SystemExit(0), KeyboardInterrupt(), GeneratorExit(), asyncio.CancelledError(), OwnError(),
    ExceptionGroup("several", [ValueError()]), BaseExceptionGroup("several", [KeyboardInterrupt()]), StopIteration(),
    RecursionError(), MemoryError(), UnprintableError(),
]  # fmt: skip


class Rig:
    """A scope in a running loop. The handler of the loop must not receive a failure of the scope."""

    def __init__(self, error: BaseException) -> None:
        self.error = error
        self.failed = asyncio.Event()
        self.failures: list[BaseException] = []
        self.reports: list[dict[str, Any]] = []
        self.loop = asyncio.get_running_loop()
        self.loop.set_exception_handler(lambda _loop, report: self.reports.append(report))
        self.scope = Scope("ex", self._on_failure)
        self.reader, self.writer = os.pipe()

    def _on_failure(self, error: BaseException) -> None:
        self.failures.append(error)
        self.failed.set()

    def fail(self, *_: object) -> None:
        raise self.error

    async def fail_later(self) -> None:
        await asyncio.sleep(0)
        raise self.error

    def close(self) -> None:
        self.loop.remove_reader(self.reader)
        self.loop.remove_writer(self.writer)
        os.close(self.reader)
        os.close(self.writer)


class Ring:
    """Owner of an alarm that fails."""

    def __init__(self, rig: Rig) -> None:
        self.on_alarm = rig.fail


def _reader(rig: Rig, callback: Callable[[], object]) -> None:
    rig.loop.add_reader(rig.reader, callback)
    os.write(rig.writer, b"x")


def _from_reader(rig: Rig) -> None:
    """A reader of the scope schedules the callback that fails."""
    _reader(rig, lambda: (rig.loop.remove_reader(rig.reader), rig.loop.call_soon(rig.fail)))


async def _by_library(rig: Rig) -> None:
    """Schedule a callback in a task, as libraries do."""
    await asyncio.sleep(0)
    rig.scope.context.run(asyncio.sleep, 0).close()
    rig.loop.call_soon(rig.fail)


class FailingProtocol(asyncio.Protocol):
    """Protocol of a library."""

    def __init__(self, rig: Rig) -> None:
        self.connection_made = rig.fail  # type: ignore[method-assign,assignment]


async def _transport(rig: Rig) -> None:
    await rig.loop.connect_read_pipe(lambda: FailingProtocol(rig), os.fdopen(os.dup(rig.reader), "rb"))


PLACES: dict[str, Callable[[Rig], object]] = {
    "call": lambda rig: rig.scope.call(rig.fail),
    "task": lambda rig: rig.scope.task(rig.fail_later(), "ex"),
    "call_soon": lambda rig: rig.scope.run(rig.loop.call_soon, rig.fail),
    "call_later": lambda rig: rig.scope.run(rig.loop.call_later, 0, rig.fail),
    "reader": lambda rig: rig.scope.run(_reader, rig, rig.fail),
    "reader that calls later": lambda rig: rig.scope.run(_from_reader, rig),
    "writer": lambda rig: rig.scope.run(rig.loop.add_writer, rig.writer, rig.fail),
    "alarm": lambda rig: rig.scope.run(Alarm, Ring(rig)).set(0),
    "task of a library": lambda rig: rig.scope.task(_by_library(rig), "ex"),
    "protocol of a library": lambda rig: rig.scope.task(_transport(rig), "ex"),
}


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("place", PLACES)
def test_failure_belongs_to_the_owner(place: str, error: BaseException) -> None:
    async def body() -> None:
        rig = Rig(error)
        PLACES[place](rig)
        await rig.failed.wait()
        for _ in range(3):
            await asyncio.sleep(0)
        rig.close()
        assert len(rig.failures) == 1
        # a coroutine cannot raise StopIteration: Python makes a RuntimeError of it
        if not (isinstance(error, StopIteration) and place == "task"):
            assert type(rig.failures[0]) is type(error)
        assert rig.reports == []
        assert INNERMOST.scope is None

    with asyncio.Runner(loop_factory=SampleLoop) as runner:
        runner.run(asyncio.wait_for(body(), 60))


def test_cancelled_task_is_a_failure_only_without_a_request() -> None:
    async def body() -> None:
        rig = Rig(asyncio.CancelledError())
        task = rig.scope.task(asyncio.sleep(3600), "ex")
        await asyncio.sleep(0)
        task.cancel()
        for _ in range(3):
            await asyncio.sleep(0)
        assert rig.failures == []
        rig.scope.task(rig.fail_later(), "ex")
        await rig.failed.wait()
        assert isinstance(rig.failures[0], asyncio.CancelledError)
        rig.close()

    event_loop.run(body())


def test_unread_exception_of_a_task_belongs_to_the_scope() -> None:
    async def body() -> None:
        rig = Rig(ValueError("unread"))
        task: asyncio.Task[None] | None = rig.scope.run(rig.loop.create_task, rig.fail_later())
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert task is not None
        assert task.done()
        del task
        assert [str(error) for error in rig.failures] == ["unread"]
        rig.close()

    event_loop.run(body())


def _raise(error: BaseException) -> None:
    raise error


def test_error_without_scope_reaches_the_loop() -> None:
    async def body(error: BaseException) -> None:
        asyncio.get_running_loop().call_soon(partial(_raise, error))
        await asyncio.sleep(0.01)

    with pytest.raises(SystemExit):
        event_loop.run(body(SystemExit(3)))


def test_only_the_first_failure_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    failures: list[BaseException] = []
    scope = Scope("ex", failures.append)
    scope.fail(ValueError("first"))
    scope.fail(ValueError("second"))
    assert [str(error) for error in failures] == ["first"]
    assert "ex: an error after its end: internal error ValueError: second" in caplog.text


def test_inner_scope_has_priority() -> None:
    async def body() -> None:
        failures: list[str] = []
        outer = Scope("outer", lambda _error: failures.append("outer"))
        inner = Scope("inner", lambda _error: failures.append("inner"))
        loop = asyncio.get_running_loop()
        rig = Rig(ValueError())
        outer.call(lambda: (inner.call(lambda: loop.call_soon(rig.fail)), loop.call_soon(rig.fail)))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert failures == ["inner", "outer"]
        assert INHERITED.get() is None
        rig.close()

    event_loop.run(body())


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_thread_belongs_to_the_scope_that_started_it(error: BaseException) -> None:
    async def body() -> None:
        rig = Rig(error)
        threads = ThreadScopes()
        threads.install(rig.loop)
        earlier = set(threading.enumerate())
        may_end = threading.Event()

        def run() -> None:
            may_end.wait()
            raise error

        thread = threading.Thread(target=run)
        thread.start()
        threads.add(rig.scope, earlier)
        may_end.set()
        await rig.failed.wait()
        thread.join()
        threads.remove()
        assert rig.failures == [error]
        rig.close()

    event_loop.run(asyncio.wait_for(body(), 60))


def test_thread_without_scope_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    threads = ThreadScopes()
    thread = threading.Thread(name="worker")
    threads.report(threading.ExceptHookArgs((ValueError, ValueError("lost"), None, thread)))
    assert "the thread worker ended: internal error ValueError: lost" in caplog.text


def test_words_of_an_error() -> None:
    assert words_of(ValueError("wrong")) == "internal error ValueError: wrong"
    assert words_of(MemoryError()) == "internal error MemoryError"
    assert words_of(UnprintableError()) == "internal error UnprintableError: its message cannot be read"
