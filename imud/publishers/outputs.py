"""The running outputs of the daemon: start, restart after a failure, end.

An exception in an output never stops the devices and the other outputs. imud closes the failed output and starts it
again after a pause, which doubles with each failure.
"""

import logging
from collections.abc import Callable, Iterator, Mapping
from typing import Final, NamedTuple

from imud.contracts.publisher import Batch, Publisher, PublisherContext
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


class Outputs:
    """Outputs of the daemon by their name. Synchronization: the loop's thread only.

    `extra` contains outputs of the calling program in addition to the configured outputs. Their exceptions are not
    caught: the program wants to know them.
    """

    def __init__(self, context: PublisherContext, extra: Mapping[str, Publisher]) -> None:
        self._context = context
        self._extra = extra
        self._options: dict[str, Options] = {}
        self._running: dict[str, Publisher] = {}
        # name and `publish` of all outputs that process samples
        self._with_samples: tuple[tuple[str, Callable[[Batch], None]], ...] = ()
        self._ticked: tuple[tuple[str, Publisher], ...] = ()  # running outputs
        self._devices: dict[str, int] = {}  # numbers of the present devices
        self._failures: dict[str, _Failure] = {}

    # --- life ------------------------------------------------------------------------------------------------------

    def start(self, options: Mapping[str, Options]) -> None:
        """Start the outputs that `options` enable, and the extra outputs. Raises ServerError for a required output."""
        self._options = dict(options)
        for name in options:
            try:
                self._start(name)
            except Exception as error:
                if PUBLISHERS[name].required:
                    raise
                self._fail(name, error)
        for name, publisher in self._extra.items():
            self._run(name, publisher)
            self._context.latencies.ask(name, 0)

    def change_to(self, name: str, options: Options) -> str:
        """Restart an output with new options, or with its old options if it fails. Return the problem, or empty."""
        old, self._options[name] = self._options[name], options
        self._failures.pop(name, None)
        self._end(name)
        try:
            self._start(name)
        except Exception as error:
            problem = f"{name} keeps its old options: {_words(error)}"
            log.error("%s", problem, exc_info=_unexpected(error))
            self._options[name] = old
            self._start_or_fail(name)
            return problem
        return ""

    def close(self) -> BaseException | None:
        """Let each output send its last data, and release everything. Return the first exception."""
        first: BaseException | None = None
        for name, publisher in list(self._running.items()):
            try:
                publisher.tick(self._context.clock.now_ns())
            except Exception as error:
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
        for output in list(self._running):
            self._guard(output, lambda publisher: publisher.add_device(name, device_id))

    def remove_device(self, name: str) -> None:
        self._devices.pop(name, None)
        for output in list(self._running):
            self._guard(output, lambda publisher: publisher.remove_device(name))

    def publish(self, batch: Batch) -> None:
        """Pass samples of a device to the outputs."""
        for name, publish in self._with_samples:
            try:
                publish(batch)
            except Exception as error:  # noqa: BLE001 - an internal error of one output
                self._fail(name, error)

    def send_event(self, event: Event) -> None:
        """Pass an event to the outputs."""
        for name, publisher in self._ticked:
            # the failure of another output can end this output
            if publisher.event is not None and self._running.get(name) is publisher:
                try:
                    publisher.event(event)
                except Exception as error:  # noqa: BLE001 - an internal error of one output
                    self._fail(name, error)

    def tick(self, now_ns: int) -> None:
        """Call `tick` of the outputs. Start failed outputs after their pause."""
        has_failed = False
        for name, publisher in self._ticked:
            try:
                # the failure of another output can end this output
                if not has_failed or self._running.get(name) is publisher:
                    publisher.tick(now_ns)
            except Exception as error:  # noqa: BLE001 - an internal error of one output
                has_failed = True
                self._fail(name, error)
        if self._failures:
            for name, failure in list(self._failures.items()):
                if name not in self._running and now_ns >= failure.due_ns:
                    self._start_or_fail(name)

    # --- failures ----------------------------------------------------------------------------------------------------

    def take_error(self, error: BaseException) -> bool:
        """Restart the output that caused an error in a callback of the event loop. Return False if none caused it."""
        modules = set(modules_of(error))
        for name, publisher in self._running.items():
            if name not in self._extra and any(_belongs(module, type(publisher).__module__) for module in modules):
                self._fail(name, error)
                return True
        return False

    def _fail(self, name: str, error: BaseException) -> None:
        """Close a failed output, and start it again after a pause."""
        if name in self._extra:
            raise error
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

    def _guard(self, name: str, step: Callable[[Publisher], None]) -> None:
        """Call a method of an output that may have ended. An exception restarts the output."""
        publisher = self._running.get(name)
        if publisher is None:
            return
        try:
            step(publisher)
        except Exception as error:  # noqa: BLE001 - an internal error of one output
            self._fail(name, error)

    # --- start and end -----------------------------------------------------------------------------------------------

    def _start_or_fail(self, name: str) -> None:
        try:
            self._start(name)
        except Exception as error:  # noqa: BLE001 - an internal error of one output
            self._fail(name, error)
        else:
            if name in self._running:
                log.info("%s: started", name)

    def _start(self, name: str) -> None:
        options = self._options[name]
        self._context.outputs.failed.pop(name, None)
        if PUBLISHERS[name].wanted(options):
            self._run(name, PUBLISHERS[name].make(options, self._context))

    def _run(self, name: str, publisher: Publisher) -> None:
        try:
            for device, device_id in self._devices.items():
                publisher.add_device(device, device_id)
            publisher.start()
        except Exception:
            self._close(name, publisher)  # the first exception is the reason
            raise
        self._running[name] = publisher
        self._note_running()

    def _end(self, name: str) -> BaseException | None:
        """End a running output. Return the exception that it raised."""
        publisher = self._running.pop(name, None)
        self._note_running()
        return self._close(name, publisher) if publisher is not None else None

    @staticmethod
    def _close(name: str, publisher: Publisher) -> BaseException | None:
        """Close an output. Log and return the exception that it raised."""
        try:
            publisher.close()
        except Exception as error:
            log.exception("%s: the end failed", name)
            return error
        return None

    def _note_running(self) -> None:
        found = [(name, publisher.publish) for name, publisher in self._running.items()]
        self._with_samples = tuple((name, publish) for name, publish in found if publish is not None)
        self._ticked = tuple(self._running.items())


def _words(error: BaseException) -> str:
    """Return the reason of a failure for users."""
    return str(error) if isinstance(error, ServerError) else f"internal error {type(error).__name__}: {error}"


def _unexpected(error: BaseException) -> BaseException | None:
    """Return an exception whose traceback belongs into the log."""
    return None if isinstance(error, ServerError) else error


def modules_of(error: BaseException) -> Iterator[str]:
    """Yield the names of the modules whose functions an exception passed."""
    trace = error.__traceback__
    while trace is not None:
        yield trace.tb_frame.f_globals.get("__name__", "")
        trace = trace.tb_next


def _belongs(module: str, output: str) -> bool:
    """Return whether a module is the module of an output or in the package of the output."""
    package = output.rpartition(".")[0]
    return module == output or (package != __package__ and module.startswith(f"{package}."))
