"""Contract of a link: an open connection to a port. It delivers received data with arrival times and reports its
end.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from imud.contracts.driver import CanDriver, Driver, PolledDriver, StreamDriver
from imud.contracts.script import Transfer
from imud.contracts.status import KernelCounters, SerialLineCounters
from imud.formats.can import CanFilter, CanFrame, CyclicFrame
from imud.model.errors import LinkError
from imud.model.options import Options, shown

MIXED: Final = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """Use of a port or bus, or of one address on a bus, by one device."""

    place: str  # port or bus: a path, or the name of an interface
    key: str  # key of the option with the port or bus
    shared: bool = False  # whether several devices can use this port or bus, each with another `part`
    part: int | None = None  # part of a shared place, for example a Modbus address; None before detection (`auto`)
    part_key: str = ""  # key of the option with the part
    # Options that must be equal for all devices of a shared place, by key
    terms: Mapping[str, object] = field(default_factory=dict)
    advice: str = ""  # next step for the user if another device has the port or bus; empty: choose another one


class Conflict(NamedTuple):
    """Reason why two devices cannot have the same claim."""

    key: str  # key of the option that the user must change
    message: str  # expected value, received value, and the owner of the claim


class HostProblem(NamedTuple):
    """Value of an option that does not fit this host. `imud check` prints it."""

    key: str  # key of the option
    message: str  # expected value, received value, and the next step
    is_error: bool  # whether the value is wrong as long as the named object exists; False for an absent object


def conflict_of(mine: Claim, other: Claim, owner: str) -> Conflict | None:
    """Return the conflict of a claim with the claim of `owner` for the same place; None if both are possible."""
    if not (mine.shared and other.shared):
        advice = f"; {mine.advice}" if mine.advice else ""
        return Conflict(mine.key, f"expected an unused {mine.key}, got {mine.place}; {owner} uses it{advice}")
    for key in differing_terms(mine.terms, other.terms):
        value, have = shown(mine.terms[key]), shown(other.terms[key])
        message = f"expected the same {key} for all devices of {mine.place}, got {value}; {owner} has {have}"
        return Conflict(key, message)
    if mine.part is not None and mine.part == other.part:
        part = f"expected an unused {mine.part_key} on {mine.place}, got {mine.part}; {owner} uses it"
        return Conflict(mine.part_key, part)
    return None


def differing_terms(mine: Mapping[str, object], other: Mapping[str, object]) -> list[str]:
    """Return the keys with different values of two devices at a shared place."""
    return [key for key in mine if key in other and mine[key] != other[key]]


@dataclass(frozen=True)
class CanUse:
    """CAN frames of one device on a bus."""

    bus: str
    filters: Sequence[CanFilter]  # filters for the frames that the device sends
    cyclic: Sequence[CyclicFrame]  # frames that imud must send for the device

    @cached_property
    def _exact(self) -> frozenset[tuple[int, bool]]:
        return frozenset((one.can_id & one.mask, one.extended) for one in self.filters)

    @cached_property
    def _mask(self) -> int:
        masks = {one.mask for one in self.filters}
        # filters with one common mask overlap only if they are equal
        return masks.pop() if len(masks) == 1 else MIXED

    def receives(self, can_id: int, extended: bool) -> bool:
        """Return whether the device sends frames with this identifier."""
        return any(wanted.matches(can_id, extended) for wanted in self.filters)

    def both_receive(self, other: "CanUse") -> str:
        """Return an identifier that matches the filters of both devices; empty if there is none."""
        if self.bus != other.bus or (self._mask == other._mask != MIXED and self._exact.isdisjoint(other._exact)):
            return ""
        pairs = ((mine, theirs) for mine in self.filters for theirs in other.filters if mine.overlaps(theirs))
        return next((id_text(mine.can_id | theirs.can_id, mine.extended) for mine, theirs in pairs), "")

    def both_send(self, other: "CanUse") -> str:
        """Return an identifier that imud would send for both devices; empty if there is none."""
        theirs = {(frame.can_id, frame.extended) for frame in other.cyclic} if self.bus == other.bus else set()
        return next((id_text(*key) for frame in self.cyclic if (key := (frame.can_id, frame.extended)) in theirs), "")


def id_text(can_id: int, extended: bool) -> str:
    """Return an identifier as text: eight hexadecimal digits for 29 bits, three for 11 bits."""
    return f"0x{can_id:08X}" if extended else f"0x{can_id:03X}"


S = TypeVar("S", bound=Options)

OnData = Callable[[bytes, int], None]  # receives bytes and CLOCK_MONOTONIC immediately after the read, ns
# Receives the error that ended the link, or None at the regular end of a replay. Called once.
OnEnd = Callable[[LinkError | None], None]
OnFrames = Callable[[Sequence[CanFrame]], None]  # receives CAN frames, oldest first
# Receives each change of the bus state, one sentence, and the present problem (empty if there is no problem)
OnBusNews = Callable[[str, str], None]


class Link(Protocol):
    """Methods of every link. Synchronization: the thread of the loop only.

    Order of calls: `wait_present`, `open`, `start` (depends on the kind), other methods in any order, `close`. The
    caller may then use the same object again.
    """

    title: str  # name of the link in messages, for example `/dev/ttyUSB0`
    writable: bool  # whether a device can receive data from imud; False for a replay

    def absence(self) -> str:
        """Return why `wait_present` would wait, one sentence; empty if the port is present. Raises LinkError."""
        ...

    async def wait_present(self) -> None:
        """Return when the port is present. Waits for events of the kernel and uses no CPU time."""
        ...

    def open(self) -> None:
        """Open the port and set its parameters. Raises LinkMissing, LinkDenied, LinkBusy or LinkError."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes (CAN: complete `struct can_frame`), or queue a limited number of them. Raises LinkError."""
        ...

    def kernel_counters(self) -> KernelCounters:
        """Return the errors that the kernel counted since `open`."""
        ...

    def close(self) -> None:
        """Release the port. A second call does nothing. The link does not call `on_end`."""
        ...


class DeviceLink(Protocol):
    """Link of one device, for the attachments of the device. `imud.device` implements it; `imud.lines` and `imud.utc`
    cannot import `imud.device`."""

    @property
    def bit_rate(self) -> int:
        """Bit rate of the link, bit/s."""
        ...

    @property
    def is_free(self) -> bool:
        """Whether other parts may send bytes: no request script runs, and no search changes the rate."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes. Raises LinkError."""
        ...

    def on_reset(self) -> None:
        """Prepare for a reset of the device by its line."""
        ...


class StreamLink(Link, Protocol):
    """Source of bytes. It opens the port exclusively and runs in the asyncio loop."""

    baud: int  # present baud rate, bit/s; 0 for links without a baud rate
    auto_baud: bool  # whether detection must find the baud rate
    hold_ns: int  # Latency timer of a USB adapter, ns: maximum delay of received bytes. 0 without a USB adapter.
    # Number of bytes that the kernel can buffer without loss while the link is paused; 0: the link cannot pause
    waiting_bytes: int

    def pause(self) -> None:
        """Deliver no bytes until `resume`; the kernel buffers them. Only for links with `waiting_bytes`."""
        ...

    def take(self) -> bytes:
        """Return all buffered bytes of a paused link. `on_end` reports the end of the link."""
        ...

    def resume(self) -> None:
        """Deliver received bytes again. Do nothing if the link ended or is closed."""
        ...

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        """Start the delivery of bytes. Requires a running loop and an open port."""
        ...

    def deliver_to(self, on_data: OnData) -> None:
        """Deliver the following bytes to another function. Do nothing if the link ended or is closed."""
        ...

    def set_baud(self, baud: int) -> None:
        """Change the baud rate and discard bytes received at the old baud rate. Raises LinkError."""
        ...


class CanLink(Link, Protocol):
    """CAN bus of one device. Several devices share a bus; each has its own link."""

    bus: str  # Name of the bus. Links with the same name receive the same frames.
    # Filters of the frames to deliver, effective when set. The link may deliver other frames too.
    filters: Sequence[CanFilter]
    bitrate: int  # bit rate of the bus, bit/s, known after `open`; 0 for virtual buses or if it is not known
    # Maximum hold of received frames before the link delivers them together, ns, effective when set; 0: no hold. Each
    # frame keeps its own arrival time. A link that cannot hold frames ignores the value.
    gather_ns: int

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Start the delivery of frames. Requires a running loop and an open bus."""
        ...

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Send these frames at their periods until `close`, in place of all earlier frames. Raises LinkError."""
        ...


class PolledLink(Link, Protocol):
    """Polled bus of one device. One thread of the bus makes the transfers of all its devices.

    After the device joined the bus, the thread of the bus calls `select`, `transfer` and `close`. The thread of the
    loop calls all other methods. `write` raises LinkError, because transfers send all bytes.
    """

    bus: str  # Name of the bus. One thread serves all links with the same name.
    target: int | None  # configured address or mode; None for `auto`
    # Whether the target selects one of several devices on the bus (I2C). Then each target can have one device only.
    shared: bool
    rate_hz: float  # polls per second
    bit_rate: int  # baud rate of the bus, bit/s; 0 if the host generates the clock

    def select(self, target: int) -> None:
        """Use this address or mode in all following transfers. Raises LinkError."""
        ...

    def place(self, target: int) -> str:
        """Return the name of a target for messages, for example `address 0x18`."""
        ...

    def transfer(self, transfer: Transfer) -> bytes:
        """Make a transfer. Return all received bytes. Raises TransferError; LinkMissing, LinkError if the bus fails."""
        ...

    def serial_line(self) -> SerialLineCounters | None:
        """Return the counters of unexpected bytes since `open`; None for buses with a clock (I2C, SPI)."""
        ...


def _no_bus(_settings: Options) -> str:
    return ""


def _no_bytes(_settings: Options) -> StreamLink:
    raise LinkError("expected a link with a byte stream, got another link")


def _no_frames(_settings: Options) -> CanLink:
    raise LinkError("expected a link to a CAN bus, got another link")


def _no_transfers(_settings: Options) -> PolledLink:
    raise LinkError("expected a link to a polled bus, got another link")


def _claims_nothing(_settings: Options) -> Sequence[Claim]:
    return ()


def _fits_host(_settings: Options) -> Iterable[HostProblem]:
    return ()


def _knows_no_problem(_settings: Options, _frames: bool) -> str:
    return ""


@dataclass(frozen=True, slots=True)
class LinkType(Generic[S]):
    """Row of a link. Its factories decide which kinds of drivers can use the link."""

    name: str  # key under a device in the configuration
    settings: type[S]
    make: Callable[[S], StreamLink] = _no_bytes  # returns a closed byte link from its options
    make_can: Callable[[S], CanLink] = _no_frames  # returns a closed link to a CAN bus from its options
    make_polled: Callable[[S], PolledLink] = _no_transfers  # returns a closed link to a polled bus from its options
    # Returns the name of the shared bus in the options; empty for links without a bus
    bus_of: Callable[[S], str] = _no_bus
    # Returns the ports, buses and addresses that a link with these options uses
    claims: Callable[[S], Sequence[Claim]] = _claims_nothing
    problem: Callable[[S, bool], str] = _knows_no_problem
    """Returns why `open` would reject these options; empty if no reason is known. It does not open the port.

    The second argument is True if the link must deliver CAN frames."""
    # Returns the values of these options that do not fit this host. It opens nothing.
    host_problems: Callable[[S], Iterable[HostProblem]] = _fits_host

    @property
    def polled(self) -> bool:
        """Whether the link serves polled drivers. Devices on it send only replies."""
        return self.make_polled is not _no_transfers

    @property
    def searchable(self) -> bool:
        """Whether detection (`driver: auto`) supports the link."""
        return self.make is not _no_bytes or self.polled or self.frames_only

    @property
    def frames_only(self) -> bool:
        """Whether the link serves only drivers for CAN frames."""
        return self.make_can is not _no_frames and self.make is _no_bytes

    def fits(self, driver: Driver) -> bool:
        """Return whether a driver can use the link."""
        if isinstance(driver, StreamDriver):
            return self.make is not _no_bytes
        if isinstance(driver, PolledDriver):
            return driver.link == self.name
        return isinstance(driver, CanDriver) and self.make_can is not _no_frames
