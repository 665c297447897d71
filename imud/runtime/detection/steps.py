"""Contract: the steps of a search that are the same on a line of bytes and on a CAN bus."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Listen:
    """Pass on received data, call `on_time` at `until_ns`. On a line of bytes first set the rate and send `send`."""

    until_ns: int
    baud: int = 0
    """Rate in bit/s; 0 on a CAN bus, whose rate is the system's."""
    send: bytes = b""


@dataclass(frozen=True, slots=True)
class GaveUp:
    """End of a round that found no device, or several."""

    summary: str
    """Observations and advice, for people."""
    wasted_bytes: int = 0
    """Bytes heard on a line of bytes: the ledger's `bytes_skipped`."""
