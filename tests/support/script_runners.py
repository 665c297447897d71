"""Script runners without a device: tests give them the messages and the time."""

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
    return ScriptRunner(ListPort(), ledger, HostClock())
