"""Contract of an observer: `imud.sampling` reports to it each input of a device, and `imud.recording` records them."""

from collections.abc import Sequence
from typing import Protocol

from imud.contracts.codec import Reading
from imud.contracts.lines import Edge
from imud.formats.can import CanFrame


class InputObserver(Protocol):
    """Observer of the input of one path and its clock. Only `imud.recording` has one, and `sampling` may not import it.

    The path calls it after each input, so that the clock readings and edges that the input needed are reported before.
    """

    def data(self, data: bytes, t_rx_ns: int, waited_ns: int) -> None:
        """Report bytes, and the maximum time in the kernel's buffer before the read, ns; -1: `StreamPath.on_data`."""
        ...

    def frames(self, frames: Sequence[CanFrame]) -> None:
        """Report the CAN frames of one read."""
        ...

    def readings(self, readings: Sequence[Reading]) -> None:
        """Report the readings of a polled device."""
        ...

    def edges(self, line: str, edges: Sequence[Edge]) -> None:
        """Report edges of a GPIO line, named as its key in the configuration."""
        ...

    def overruns(self, count: int) -> None:
        """Report the overruns that the kernel counted, at each loss of samples."""
        ...

    def call(self, target: str, method: str, *arguments: object, **keywords: object) -> None:
        """Report a call of another method of `target`: `path`, `clock`, `aiding`, `loss`, `edges` or `ledger`."""
        ...
