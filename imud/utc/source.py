"""Contract of the sources of RMC sentences, and their settings."""

from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple, Protocol

from msgspec import Meta

from imud.contracts.link import StreamLink
from imud.contracts.settings import Settings, is_host, shown

OnSentence = Callable[[bytes, int], None]
"""Called with one RMC sentence, including its line end, and CLOCK_MONOTONIC (ns) right after its arrival."""
MakePort = Callable[[str, int], StreamLink]
"""Makes a closed serial link from a path and a rate in bit/s."""


class RmcSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the source of a device's RMC sentences."""

    source: Literal["gpsd", "nmea", "system"]
    """`gpsd`: a GNSS receiver that gpsd owns. `nmea`: one on a serial port of its own. `system`: the system clock,
    while the kernel says that it is synchronised."""
    rate_hz: Annotated[int, Meta(ge=1, le=10)] = 1
    """Sentences per second at most, for the device."""
    host: Annotated[str, Meta(min_length=1, max_length=253)] = "127.0.0.1"
    """Host on which gpsd runs."""
    tcp_port: Annotated[int, Meta(ge=1, le=65535)] = 2947
    """TCP port of gpsd."""
    gps: Annotated[str, Meta(max_length=256)] = ""
    """Path of the receiver in gpsd, where gpsd has several; empty for all."""
    port: str = ""
    """Path of the receiver's serial port, for `nmea`."""
    baud: Annotated[int, Meta(ge=4800, le=921_600)] = 9600
    """Rate of that port in bit/s."""
    error_ms: Annotated[float, Meta(gt=0, le=60)] = 50.0
    """The system clock is used while its one-sigma error is below this. Sentences only name the second, and are sent
    200 ms after its begin, so that such an error does no harm."""

    def __post_init__(self) -> None:
        if not is_host(self.host):
            raise ValueError(f"host: expected an IP address or a host name, got {shown(self.host)}")
        if self.source == "nmea" and not self.port:
            raise ValueError("expected the key port beside source nmea, the path of the receiver's port, got none")


class RmcSource(Protocol):
    """Source of sentences, valid or not; recovers from failures. Synchronization: the loop's thread only."""

    title: str
    """The source for people, for example `gpsd at 127.0.0.1:2947`."""
    problem: str
    """Why it delivers nothing, one sentence; empty if it does."""
    sentences: int
    """Sentences delivered since the start."""

    def start(self, on_sentence: OnSentence) -> None:
        """Deliver sentences from now on. Needs a running loop."""
        ...

    def close(self) -> None:
        """Deliver nothing more, and release port or connection; may be called twice."""
        ...


class SourceContext(NamedTuple):
    """Services of the host that sources need."""

    make_port: MakePort
    now_ns: Callable[[], int]
    """CLOCK_MONOTONIC."""
    utc_offset_ns: Callable[[], int]
    """CLOCK_REALTIME minus CLOCK_MONOTONIC, now."""


MakeSource = Callable[[RmcSettings, SourceContext], RmcSource]
"""Makes a source; `imud.utc.RMC_SOURCES` has one for each value of `RmcSettings.source`."""
