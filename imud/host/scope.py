"""Scopes: each callback and each task of the event loop belongs to the device or the output that caused it.

A failure in a scope is a failure of its owner: any exception, also SystemExit, KeyboardInterrupt and a CancelledError
that imud did not cause. `Scope.fail` reports it to the owner. The rest of the daemon continues.

    Scope.call, Scope.task ──▶ code ──call_soon, call_later, create_task, add_reader, add_writer──▶ the same scope
    ReaderSelector: reader ──▶ the scope that added the reader

The event loop (`event_loop.SampleLoop`) determines the present scope when code schedules a callback, not when the
callback runs. A callback of the sample path thus takes no additional instructions.
"""

import asyncio
import logging
import threading
from asyncio.events import Handle
from collections.abc import Callable, Collection, Coroutine, Mapping
from contextlib import suppress
from contextvars import Context, ContextVar, copy_context
from types import FrameType, TracebackType
from typing import Any, Final, TypeVar, TypeVarTuple
from weakref import WeakKeyDictionary

log = logging.getLogger(__name__)

T = TypeVar("T")
Arguments = TypeVarTuple("Arguments")

OnFailure = Callable[[BaseException], None]

INHERITED: Final[ContextVar["Scope | None"]] = ContextVar("INHERITED", default=None)
"""Scope of the running callback or task. asyncio passes it on to all callbacks and tasks that the code starts."""


class _Innermost:
    """Scope of the innermost `Scope.call`. An attribute and no context variable, because each batch of samples sets it
    once per output. Synchronization: the thread of the event loop."""

    __slots__ = ("scope",)

    def __init__(self) -> None:
        self.scope: Scope | None = None


INNERMOST: Final = _Innermost()


class Scope:
    """Code of one owner: a device or an output. Synchronization: the thread of the event loop."""

    __slots__ = ("_on_failure", "context", "is_closed", "owner")

    def __init__(self, owner: str, on_failure: OnFailure) -> None:
        """`owner` names the device or the output for users. `on_failure` receives the first failure."""
        self.owner = owner
        self.is_closed = False
        self._on_failure = on_failure
        self.context: Final = copy_context()  # context of the callbacks that code of this scope schedules
        self.context.run(INHERITED.set, self)

    def fail(self, error: BaseException) -> None:
        """Report a failure to the owner. After a failure and after `close`, only log it."""
        if self.is_closed:
            log.warning("%s: an error after its end: %s", self.owner, words_of(error))
            return
        self.is_closed = True
        self._on_failure(error)

    def close(self) -> None:
        """Report no further failure: the owner has ended the code."""
        self.is_closed = True

    def call(self, function: Callable[[*Arguments], T], *arguments: *Arguments) -> T | None:
        """Call `function` and return its result. Return None after a failure."""
        outer = INNERMOST.scope
        INNERMOST.scope = self
        try:
            return function(*arguments)
        except BaseException as error:  # noqa: BLE001 - foreign code can raise any exception
            self.fail(error)
            return None
        finally:
            INNERMOST.scope = outer

    def run(self, function: Callable[[*Arguments], T], *arguments: *Arguments) -> T:
        """Call `function` and return its result. The caller handles the exceptions."""
        outer = INNERMOST.scope
        INNERMOST.scope = self
        try:
            return function(*arguments)
        finally:
            INNERMOST.scope = outer

    def task(self, body: Coroutine[Any, Any, None], name: str) -> asyncio.Task[None]:
        """Start a task. Its exception is a failure. Its cancellation is a failure without a call of `cancel`."""
        task = asyncio.get_running_loop().create_task(body, name=name, context=self.context.copy())
        task.add_done_callback(self._on_done, context=self.context)
        return task

    def _on_done(self, task: asyncio.Task[None]) -> None:
        if task.cancelled():
            if not task.cancelling():
                self.fail(asyncio.CancelledError(f"the task {task.get_name()} cancelled itself"))
            return
        error = task.exception()
        # the loop has already reported a SystemExit and a KeyboardInterrupt (`scope_of_error`)
        if error is not None and not isinstance(error, SystemExit | KeyboardInterrupt):
            self.fail(error)


class OwnedTask(asyncio.Task[Any]):
    """Task with a scope, so that asyncio can report its unread exception to the owner."""

    __slots__ = ("scope",)

    scope: Scope


class OwnedFuture(asyncio.Future[Any]):
    """Future with a scope, as `OwnedTask`."""

    __slots__ = ("scope",)

    scope: Scope


class ThreadScopes:
    """Scopes of the threads that outputs and devices start. A thread does not inherit a context, so imud notes the
    threads that are new after a start. Synchronization: `add` in the loop's thread, `report` in any thread."""

    def __init__(self) -> None:
        self._scopes: WeakKeyDictionary[threading.Thread, Scope] = WeakKeyDictionary()
        self._previous_hook = threading.excepthook
        self._loop: asyncio.AbstractEventLoop | None = None

    def install(self, loop: asyncio.AbstractEventLoop) -> None:
        """Receive the exceptions that end a thread, until `remove`."""
        self._loop = loop
        self._previous_hook = threading.excepthook
        threading.excepthook = self.report

    def remove(self) -> None:
        """Restore the previous hook."""
        threading.excepthook = self._previous_hook

    def add(self, scope: Scope, earlier: Collection[threading.Thread]) -> None:
        """Note all threads that are not in `earlier`."""
        for thread in threading.enumerate():
            if thread not in earlier:
                self._scopes[thread] = scope

    def report(self, arguments: threading.ExceptHookArgs) -> None:
        """Report the exception that ended a thread to its scope."""
        error = arguments.exc_value or arguments.exc_type()
        thread = arguments.thread
        scope = None if thread is None else self._scopes.get(thread)
        if scope is None or self._loop is None:
            if not isinstance(error, SystemExit):
                name = "a thread" if thread is None else f"the thread {thread.name}"
                log.error("%s ended: %s", name, words_of(error), exc_info=error)
            return
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(scope.fail, error)


def scope_of_report(report: Mapping[str, Any]) -> Scope | None:
    """Return the scope of a report to `loop.call_exception_handler`; None if it belongs to no scope."""
    for name in ("scope", "task", "future", "handle"):
        subject = report.get(name)
        if isinstance(subject, Scope):
            return subject
        if isinstance(subject, OwnedTask | OwnedFuture):
            return getattr(subject, "scope", None)
        if isinstance(subject, Handle):
            return _scope_of_handle(subject)
    return INHERITED.get()


def scope_of_error(error: BaseException) -> Scope | None:
    """Return the scope of the callback that raised an error out of the loop; None if it belongs to no scope."""
    return scope_of_traceback(error.__traceback__)


def scope_of_traceback(trace: TracebackType | None) -> Scope | None:
    """Return the scope of the callback in a traceback. asyncio runs one callback at a time (`Handle._run`)."""
    while trace is not None:
        if trace.tb_frame.f_code is Handle._run.__code__:
            return _scope_of_handle(trace.tb_frame.f_locals["self"])
        trace = trace.tb_next
    return None


def scope_of_frame(frame: FrameType | None) -> Scope | None:
    """Return the scope of the callback that a frame and its callers belong to. Any thread may call it."""
    while frame is not None:
        if frame.f_code is Handle._run.__code__:
            return _scope_of_handle(frame.f_locals["self"])
        frame = frame.f_back
    return None


def _scope_of_handle(handle: Handle) -> Scope | None:
    context: Context = handle._context  # type: ignore[attr-defined]
    return context.get(INHERITED)


def words_of(error: BaseException) -> str:
    """Return the class and the message of an exception for users. The message of a foreign class can fail too."""
    try:
        text = str(error)
    except BaseException:  # noqa: BLE001 - foreign code can raise any exception
        text = "its message cannot be read"
    return f"internal error {type(error).__name__}: {text}" if text else f"internal error {type(error).__name__}"
