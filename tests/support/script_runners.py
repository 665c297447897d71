"""Script runners without a device: tests give them the messages and the time."""

from imud.contracts.script import Request, never, of_text
from imud.device.scripts import RequestPort, ScriptRunner
from imud.host.clock import HostClock
from imud.model.ledger import Ledger


class ListPort(RequestPort):
    """A link that keeps the requests in a list."""

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
