"""What a source of RMC sentences is, and how one is configured."""

from collections.abc import Callable
from typing import Annotated, Literal, Protocol

from msgspec import Meta

from imud.contracts.link import StreamLink
from imud.contracts.settings import Settings

OnSentence = Callable[[bytes, int], None]
"""Called with one RMC sentence, its line end included, and CLOCK_MONOTONIC (ns) right after it came."""
MakePort = Callable[[str, int], StreamLink]
"""Makes a closed serial link from a path and a rate in bit/s."""


class RmcSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the sentences that a device is fed come from."""

    source: Literal["gpsd", "nmea", "system"]
    """`gpsd`: a GNSS receiver that gpsd owns. `nmea`: one on a serial port of its own. `system`: the system clock,
    while the kernel says that it is synchronised."""
    rate_hz: Annotated[int, Meta(ge=1, le=10)] = 1
    """Sentences per second at most, for the device."""
    host: Annotated[str, Meta(min_length=1, max_length=253)] = "127.0.0.1"
    """Where gpsd runs."""
    tcp_port: Annotated[int, Meta(ge=1, le=65535)] = 2947
    """Where gpsd listens."""
    gps: Annotated[str, Meta(max_length=256)] = ""
    """The receiver's path as gpsd knows it, where gpsd has several; empty for all."""
    port: str = ""
    """Path of the receiver's serial port, for `nmea`."""
    baud: Annotated[int, Meta(ge=4800, le=921_600)] = 9600
    """Rate of that port in bit/s."""
    error_ms: Annotated[float, Meta(gt=0, le=60)] = 50.0
    """The system clock is used while it is right within so much, one sigma. Sentences say which second it is, no more,
    and are sent 200 ms after it began, so that much can be allowed."""

    def __post_init__(self) -> None:
        if self.source == "nmea" and not self.port:
            raise ValueError("an NMEA source needs the path of its serial port (`port`)")


class RmcSource(Protocol):
    """Gives sentences as they come, good or bad, and comes back by itself. Synchronization: the loop's thread only."""

    title: str
    """The source for people, for example `gpsd at 127.0.0.1:2947`."""
    problem: str
    """Why it gives nothing now, one sentence; empty when all is well."""
    sentences: int
    """Sentences given since it was made."""

    def start(self, on_sentence: OnSentence) -> None:
        """Give sentences from now on. Needs a running loop."""
        ...

    async def close(self) -> None:
        """Stop and let go of everything; may be called twice."""
        ...


MakeSource = Callable[[RmcSettings, MakePort], RmcSource]
"""The row a source file ends with."""
