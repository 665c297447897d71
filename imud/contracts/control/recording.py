"""Contract of what can be recorded: a recorder asks for it by name, and is given records in their order."""

from collections.abc import Callable, Sequence
from socket import socket
from typing import Protocol

PutRecord = Callable[[bytes], None]
"""Takes a whole record (`imud.formats.recording.records`); returns at once. Called in the event loop's thread."""

TakeSnapshot = Callable[[socket], float]
"""Sends what a flight recorder has to a client's socket, a recording, and closes it; returns at once how many seconds
that is. Raises ServerError. Called in the event loop's thread."""


class RecordingSource(Protocol):
    """The devices and the host's clocks of a daemon, as recorders see them. Synchronization: the loop's thread only."""

    def names(self) -> Sequence[str]:
        """Names of the devices there are."""
        ...

    def begin_host(self, put: PutRecord) -> None:
        """Describe the host's clocks, and pass on their readings from now on; again for one that listens already."""
        ...

    def begin(self, device: str, put: PutRecord) -> None:
        """Describe a device, and pass on all that it delivers; again for one that listens already. No-op if absent."""
        ...

    def check(self, device: str, put: PutRecord) -> None:
        """Pass on the newest sample and the ledger of a device as a record. No-op if absent."""
        ...

    def end(self, put: PutRecord) -> None:
        """Pass on nothing of any device any more, nor of the host."""
        ...


class NothingRecorded:
    """Where nothing can be recorded."""

    def names(self) -> Sequence[str]:
        """None."""
        return ()

    def begin_host(self, put: PutRecord) -> None:
        """Ignore it."""

    def begin(self, device: str, put: PutRecord) -> None:
        """Ignore it."""

    def check(self, device: str, put: PutRecord) -> None:
        """Ignore it."""

    def end(self, put: PutRecord) -> None:
        """Ignore it."""
