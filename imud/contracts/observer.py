"""Contract of an observer: `imud.sampling` reports to it each input of a device, and `imud.recording` records them."""

from collections.abc import Sequence
from typing import Protocol

from imud.contracts.codec import Reading
from imud.contracts.lines import Edge
from imud.formats.can import CanFrame


class InputObserver(Protocol):
    """Observer of the input of one path and its clock.

    `imud.recording` implements it, and `imud.sampling` may not import that part. The path calls it after each input. It
    has therefore reported the clock readings and edges of this input before.
    """

    def data(self, data: bytes, t_rx_ns: int, waited_ns: int) -> None:
        """Report the bytes of one read. `waited_ns` is their maximum time in the kernel's buffer for
        `StreamPath.gather`, and -1 for `on_data`."""
        ...

    def frames(self, frames: Sequence[CanFrame]) -> None:
        """Report the CAN frames of one read."""
        ...

    def readings(self, readings: Sequence[Reading]) -> None:
        """Report the readings of a polled device."""
        ...

    def edges(self, line: str, edges: Sequence[Edge]) -> None:
        """Report edges of a GPIO line. `line` is its key in the configuration."""
        ...

    def overruns(self, count: int) -> None:
        """Report the number of overruns that the kernel counted. The path calls this method at each loss of samples."""
        ...

    def call(self, target: str, method: str, *arguments: object, **keywords: object) -> None:
        """Report a call of another method of `target`: `path`, `clock`, `aiding`, `loss`, `edges` or `ledger`."""
        ...
