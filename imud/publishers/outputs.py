"""The running outputs of the daemon: start, restart after a failure, end.

Each output runs in a scope (`imud.host.scope`): an exception of any class, in a method, a callback, a task or a thread
of an output, never stops the devices and the other outputs. imud closes the failed output and starts it again after a
pause, which doubles with each failure.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NamedTuple

from imud.contracts.publisher import Batch, Publisher, PublisherContext
from imud.host.scope import INNERMOST, Scope, ThreadScopes, words_of
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.model.options import Options
from imud.model.units import NS_PER_S
from imud.publishers import PUBLISHERS

log = logging.getLogger(__name__)

RETRY_FIRST_NS: Final = NS_PER_S
"""First pause before imud starts a failed output again, ns. The pause doubles up to RETRY_MOST_NS."""
RETRY_MOST_NS: Final = 60 * NS_PER_S  # maximum pause before imud starts a failed output again, ns
FORGOTTEN_NS: Final = 600 * NS_PER_S  # time of a run without a failure after which the pause is RETRY_FIRST_NS again


class _Failure(NamedTuple):
    """Last failure of an output."""

    due_ns: int  # CLOCK_MONOTONIC of the next start
    pause_ns: int
    words: str  # reason for the log, the status and the event


class _Running(NamedTuple):
    """A running output."""

    publisher: Publisher
    scope: Scope
    publish: Callable[[Batch], None] | None  # None: the output does not process samples


class Outputs:
    """Outputs of the daemon by their name. Synchronization: the loop's thread only.

    `extra` contains outputs of the calling program in addition to the configured outputs. Their exceptions are failures
    of the program and end imud.
    """

    def __init__(self, context: PublisherContext, extra: Mapping[str, Publisher], threads: ThreadScopes) -> None:
        """`threads` notes the threads of each output."""
        self._context = context
        self._extra = extra
        self._threads = threads
        self._options: dict[str, Options] = {}
        self._running: dict[str, _Running] = {}
        self._ticked: tuple[_Running, ...] = ()  # running outputs
        # scope and `publish` of all outputs that process samples
        self._with_samples: tuple[tuple[Scope, Callable[[Batch], None]], ...] = ()
        self._devices: dict[str, int] = {}  # numbers of the present devices
        self._failures: dict[str, _Failure] = {}

    # --- life ------------------------------------------------------------------------------------------------------

    def start(self, options: Mapping[str, Options]) -> None:
        """Start the outputs that `options` enable, and the extra outputs. Raises ServerError for a required output."""
        self._options = dict(options)
        for name in options:
            try:
                self._start(name)
            except BaseException as error:
                if PUBLISHERS[name].required:
                    raise
                self._fail(name, error)
        for name, publisher in self._extra.items():
            self._run(name, partial(_same, publisher))
            self._context.latencies.ask(name, 0)

    def change_to(self, name: str, options: Options) -> str:
        """Restart an output with new options, or with its old options if it fails. Return the problem, or empty."""
        old, self._options[name] = self._options[name], options
        self._failures.pop(name, None)
        self._end(name)
        try:
            self._start(name)
        except BaseException as error:
            problem = f"{name} keeps its old options: {_words(error)}"
            log.error("%s", problem, exc_info=_unexpected(error))
            self._options[name] = old
            self._start_or_fail(name)
            return problem
        return ""

    def close(self) -> BaseException | None:
        """Let each output send its last data, and release everything. Return the first exception."""
        first: BaseException | None = None
        for name, running in list(self._running.items()):
            try:
                running.scope.run(running.publisher.tick, self._context.clock.now_ns())
            except BaseException as error:
                log.exception("%s: the end failed", name)
                first = first or error
            error_at_end = self._end(name)
            first = first or error_at_end
        return first

    @property
    def options(self) -> Mapping[str, Options]:
        """Present options of all outputs."""
        return dict(self._options)

    def summary(self) -> str:
        """Return the outputs for the log."""
        missing = [name for name in self._failures if name not in self._running]
        return (", ".join(self._running) or "none") + (f" (not yet: {', '.join(missing)})" if missing else "")

    # --- data ------------------------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        """Prepare all outputs for a device."""
        self._devices[name] = device_id
        for running in list(self._running.values()):
            if not running.scope.is_closed:
                running.scope.call(running.publisher.add_device, name, device_id)

    def remove_device(self, name: str) -> None:
        self._devices.pop(name, None)
        for running in list(self._running.values()):
            if not running.scope.is_closed:
                running.scope.call(running.publisher.remove_device, name)

    def publish(self, batch: Batch) -> None:
        """Pass samples of a device to the outputs."""
        outer = INNERMOST.scope
        try:
            for scope, publish in self._with_samples:
                INNERMOST.scope = scope  # `scope.call` would cost a call for each output and batch
                try:
                    publish(batch)
                except BaseException as error:  # noqa: BLE001 - an internal error of one output
                    scope.fail(error)
        finally:
            INNERMOST.scope = outer

    def send_event(self, event: Event) -> None:
        """Pass an event to the outputs."""
        for running in self._ticked:
            # the failure of another output can end this output
            if not running.scope.is_closed:
                running.scope.call(_send_event, running.publisher, event)

    def tick(self, now_ns: int) -> None:
        """Call `tick` of the outputs. Start failed outputs after their pause."""
        outer = INNERMOST.scope
        try:
            for publisher, scope, _ in self._ticked:
                if not scope.is_closed:
                    INNERMOST.scope = scope  # as in `publish`
                    try:
                        publisher.tick(now_ns)
                    except BaseException as error:  # noqa: BLE001 - an internal error of one output
                        scope.fail(error)
        finally:
            INNERMOST.scope = outer
        if self._failures:
            for name, failure in list(self._failures.items()):
                if name not in self._running and now_ns >= failure.due_ns:
                    self._start_or_fail(name)

    # --- failures ----------------------------------------------------------------------------------------------------

    def _fail(self, name: str, error: BaseException) -> None:
        """Close a failed output, and start it again after a pause."""
        if name in self._extra:
            self._note_running()  # the output gets no more samples
            self._context.owner.end_with(error)
            return
        now_ns = self._context.clock.now_ns()
        before = self._failures.get(name)
        if before is not None and now_ns - before.due_ns > FORGOTTEN_NS:
            before = None
        pause_ns = RETRY_FIRST_NS if before is None else min(2 * before.pause_ns, RETRY_MOST_NS)
        words = _words(error)
        self._failures[name] = _Failure(now_ns + pause_ns, pause_ns, words)
        self._context.outputs.failed[name] = words
        if name in self._running or before is None or words != before.words:
            log.error(
                "%s: %s; imud continues without this output and tries again",
                name, words, exc_info=_unexpected(error),
            )  # fmt: skip
        if name in self._running:
            self._end(name)
            self.send_event(Event(now_ns, "", EventKind.OUTPUT, f"{name}: {words}; imud starts this output again"))

    # --- start and end -----------------------------------------------------------------------------------------------

    def _start_or_fail(self, name: str) -> None:
        try:
            self._start(name)
        except BaseException as error:  # noqa: BLE001 - an internal error of one output
            self._fail(name, error)
        else:
            if name in self._running:
                log.info("%s: started", name)

    def _start(self, name: str) -> None:
        options = self._options[name]
        facts = self._context.outputs
        facts.failed.pop(name, None)
        facts.configured.discard(name)
        if PUBLISHERS[name].wanted(options):
            facts.configured.add(name)
            self._run(name, partial(PUBLISHERS[name].make, options, self._context))

    def _run(self, name: str, make: Callable[[], Publisher]) -> None:
        """Create and start an output in a scope of its own."""
        scope = Scope(name, partial(self._fail, name))
        publisher: Publisher | None = None
        threads = set(threading.enumerate())
        try:
            publisher = scope.run(make)
            scope.run(self._start_publisher, publisher)
            running = _Running(publisher, scope, publisher.publish)
        except BaseException:
            scope.close()
            if publisher is not None:
                self._close(name, publisher, scope)  # the first exception is the reason
            raise
        self._threads.add(scope, threads)
        self._running[name] = running
        self._note_running()

    def _start_publisher(self, publisher: Publisher) -> None:
        for device, device_id in self._devices.items():
            publisher.add_device(device, device_id)
        publisher.start()

    def _end(self, name: str) -> BaseException | None:
        """End a running output. Return the exception that it raised."""
        running = self._running.pop(name, None)
        self._note_running()
        if running is None:
            return None
        running.scope.close()
        return self._close(name, running.publisher, running.scope)

    @staticmethod
    def _close(name: str, publisher: Publisher, scope: Scope) -> BaseException | None:
        """Close an output. Log and return the exception that it raised."""
        try:
            scope.run(publisher.close)
        except BaseException as error:
            log.exception("%s: the end failed", name)
            return error
        return None

    def _note_running(self) -> None:
        self._ticked = tuple(self._running.values())
        self._with_samples = tuple(
            (running.scope, running.publish)
            for running in self._running.values()
            if running.publish is not None and not running.scope.is_closed
        )


def _same(publisher: Publisher) -> Publisher:
    """Return an output that exists: an output of the calling program."""
    return publisher


def _send_event(publisher: Publisher, event: Event) -> None:
    send = publisher.event
    if send is not None:
        send(event)


def _words(error: BaseException) -> str:
    """Return the reason of a failure for users."""
    return str(error) if isinstance(error, ServerError) else words_of(error)


def _unexpected(error: BaseException) -> BaseException | None:
    """Return an exception whose traceback belongs into the log."""
    return None if isinstance(error, ServerError) else error
