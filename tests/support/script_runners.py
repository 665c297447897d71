"""Script runners without a device: tests give them the messages and the time."""

from collections.abc import Callable, Iterator
from typing import Any

from imud.contracts.script import Message, Request, Silence, never
from imud.device.scripts import RequestPort, ScriptRunner
from imud.host.clock import HostClock
from imud.model.errors import NoReply
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS


def of_text(holds: Callable[[str], bool]) -> Callable[[Message], bool]:
    """Return a predicate that is true for lines of text that match `holds`."""
    return lambda message: isinstance(message, str) and holds(message)


def unanswered_ms(script: Any) -> Iterator[float]:
    """Yield the timeouts of all requests of a script to a device that does not reply, ms."""
    try:
        request = next(script)
        while True:
            yield request.timeout_ns / NS_PER_MS
            request = script.send(Silence(()))
    except (StopIteration, NoReply):
        return


class ListPort(RequestPort):
    def __init__(self) -> None:
        self.written: list[bytes] = []

    def write(self, data: bytes) -> None:
        self.written.append(data)


def offline_runner(ledger: Ledger) -> ScriptRunner:
    """Return a runner for `start`, `on_message`, `on_sample` and `on_time` without an event loop."""
    return of_fast_device(ScriptRunner(ListPort(), ledger, HostClock()))


def of_fast_device(runner: ScriptRunner) -> ScriptRunner:
    """Return a runner after a fast reply: requests have their own timeouts. Before a reply, imud waits longer."""
    runner.start(Request(b"?", "first", of_text(lambda _line: True), never, never), 0)
    runner.on_message("OK", 1)
    return runner
