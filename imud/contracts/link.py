"""Contract of a link, the owner of one port: it delivers received data with arrival times, and reports its end."""

from collections.abc import Callable, Mapping, Sequence
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
    """Use of a port or bus, or of one address on it, by one device."""

    place: str
    """The port or bus: a path, or the name of an interface."""
    key: str
    """Key of the settings that names it."""
    shared: bool = False
    """Whether several devices can use the place, each with a part of its own."""
    part: int | None = None
    """The part of a shared place, for example a Modbus address; None while it is not known (`auto`)."""
    part_key: str = ""
    """Key of the settings that names the part."""
    terms: Mapping[str, object] = field(default_factory=dict)
    """Options on which all devices of a shared place must agree, by key."""


class Conflict(NamedTuple):
    """Why two devices cannot have what they claim."""

    key: str
    """Key of the settings that has to change."""
    message: str
    """What was expected, what came, and who has it."""


def conflict_of(mine: Claim, other: Claim, owner: str) -> Conflict | None:
    """Return why a device cannot have what `owner` has already, None if it can. Both claim the same place."""
    if not (mine.shared and other.shared):
        return Conflict(mine.key, f"expected a {mine.key} of its own, got {mine.place}, which {owner} has")
    for key in differing_terms(mine.terms, other.terms):
        value, have = shown(mine.terms[key]), shown(other.terms[key])
        message = f"expected the same {key} for all devices of {mine.place}, got {value}; {owner} has {have}"
        return Conflict(key, message)
    if mine.part is not None and mine.part == other.part:
        part = f"{mine.part_key} of its own on {mine.place}, got {mine.part}, which {owner} has"
        return Conflict(mine.part_key, f"expected {'an' if part[0] in 'aeiou' else 'a'} {part}")
    return None


def differing_terms(mine: Mapping[str, object], other: Mapping[str, object]) -> list[str]:
    """List the keys in which two devices of a shared place differ."""
    return [key for key in mine if key in other and mine[key] != other[key]]


@dataclass(frozen=True)
class CanUse:
    """Frames of a CAN bus that one device needs."""

    bus: str
    filters: Sequence[CanFilter]
    """The frames that the device sends."""
    cyclic: Sequence[CyclicFrame]
    """The frames that imud must send for it."""

    @cached_property
    def _exact(self) -> frozenset[tuple[int, bool]]:
        return frozenset((one.can_id & one.mask, one.extended) for one in self.filters)

    @cached_property
    def _mask(self) -> int:
        """Mask of all filters, MIXED for several: filters of the same mask overlap only where they are equal."""
        masks = {one.mask for one in self.filters}
        return masks.pop() if len(masks) == 1 else MIXED

    def receives(self, can_id: int, extended: bool) -> bool:
        """Whether the device sends frames of this identifier (of 29 bits or not)."""
        return any(wanted.matches(can_id, extended) for wanted in self.filters)

    def both_receive(self, other: "CanUse") -> str:
        """Return an identifier whose frames both take for their device's own; empty if there is none."""
        if self.bus != other.bus or (self._mask == other._mask != MIXED and self._exact.isdisjoint(other._exact)):
            return ""
        pairs = ((mine, theirs) for mine in self.filters for theirs in other.filters if mine.overlaps(theirs))
        return next((id_text(mine.can_id | theirs.can_id, mine.extended) for mine, theirs in pairs), "")

    def both_send(self, other: "CanUse") -> str:
        """Return an identifier that imud would send for both; empty if there is none."""
        theirs = {(frame.can_id, frame.extended) for frame in other.cyclic} if self.bus == other.bus else set()
        return next((id_text(*key) for frame in self.cyclic if (key := (frame.can_id, frame.extended)) in theirs), "")


def id_text(can_id: int, extended: bool) -> str:
    """Format an identifier: eight hexadecimal digits where it has 29 bits, three where it has 11."""
    return f"0x{can_id:08X}" if extended else f"0x{can_id:03X}"


S = TypeVar("S", bound=Options)

OnData = Callable[[bytes, int], None]
"""Called with bytes as read and CLOCK_MONOTONIC (ns) right after the read."""
OnEnd = Callable[[LinkError | None], None]
"""Called once when the link ends by itself: with the error, or None for the regular end of a replay."""
OnFrames = Callable[[Sequence[CanFrame]], None]
"""Called with frames of a CAN bus, oldest first."""
OnBusNews = Callable[[str, str], None]
"""Called when the state of a bus changes: the change, one sentence, and the present problem (empty: none)."""


class Link(Protocol):
    """Methods of every link. Synchronization: the loop's thread only.

    Order of calls: `wait_present`, `open`, `start` (of its kind), then the others in any order, `close`. The same
    object may then be used again from the beginning.
    """

    title: str
    """The link in messages, for example `/dev/ttyUSB0`."""
    writable: bool
    """Whether a device listens at the far end (a replay has none)."""

    def absence(self) -> str:
        """Return why `wait_present` would wait now, one sentence; empty when it would not. Raises LinkError."""
        ...

    async def wait_present(self) -> None:
        """Return when the port is there; at once if it is. Waits on the kernel's events, never polls busily."""
        ...

    def open(self) -> None:
        """Open and set up the port. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes, on CAN whole `struct can_frame`; queued (bounded) when the port is full. Raises LinkError."""
        ...

    def kernel_counters(self) -> KernelCounters:
        """Errors the kernel counted since `open`."""
        ...

    def close(self) -> None:
        """Release the port; may be called twice. `on_end` is not called."""
        ...


class StreamLink(Link, Protocol):
    """A source of bytes, opened exclusively, driven by the asyncio loop."""

    baud: int
    """Present rate in bit/s; 0 for links without one."""
    auto_baud: bool
    """Whether detection is to find the rate."""
    hold_ns: int
    """Longest time that the adapter holds bytes back (USB latency timer), ns; 0 for none."""
    waiting_bytes: int
    """So many bytes may wait unread while the link is paused, without any being lost; 0: it cannot be paused."""

    def pause(self) -> None:
        """Deliver nothing until `resume`: bytes wait in the kernel. For links with `waiting_bytes` only."""
        ...

    def take(self) -> bytes:
        """Return all bytes that wait, of a paused link; its end is reported by `on_end`."""
        ...

    def resume(self) -> None:
        """Deliver again as bytes come; no-op for a link that ended or is closed."""
        ...

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        """Deliver bytes from now on. Needs a running loop and an open port."""
        ...

    def set_baud(self, baud: int) -> None:
        """Change the rate and discard bytes received at the old one. Raises LinkError."""
        ...


class CanLink(Link, Protocol):
    """A CAN bus for one device; several devices share a bus, each by a link of its own."""

    bus: str
    """Name of the bus: links of the same bus receive the same frames."""
    filters: Sequence[CanFilter]
    """Frames to deliver, effective when set. Other frames may be delivered as well."""
    bitrate: int
    """Rate of the bus in bit/s, known once open; 0 where there is none (virtual buses) or it is unknown."""
    gather_ns: int
    """Time for which frames may gather before they are delivered together, ns, effective when set; 0: at once.
    Their times of arrival stay those of each frame. A link that cannot have frames gather ignores it."""

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Deliver frames from now on. Needs a running loop and an open bus."""
        ...

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Send these frames, in place of earlier ones, at their periods until `close`. Needs what `start` needs.

        Raises LinkError.
        """
        ...


class PolledLink(Link, Protocol):
    """A polled bus for one device; the bus's thread makes the transfers of all its devices.

    The bus's thread calls `select`, `transfer` and `close` once the device has joined the bus, the loop's thread the
    rest. `write` raises LinkError: all bytes are sent in transfers.
    """

    bus: str
    """Name of the bus: links of the same bus are served by one thread."""
    target: int | None
    """Address or mode as configured; None for `auto`."""
    shared: bool
    """Whether targets distinguish the devices of one bus (I2C), so that each may be used once only."""
    rate_hz: float
    """Polls per second."""
    bit_rate: int
    """Rate of the line in bit/s; 0 for buses whose clock the host makes."""

    def select(self, target: int) -> None:
        """Use this address, or this mode, in all transfers from now on. Raises LinkError."""
        ...

    def place(self, target: int) -> str:
        """A target in messages, for example `address 0x18`."""
        ...

    def transfer(self, transfer: Transfer) -> bytes:
        """Make a transfer and return all bytes read. Raises TransferError; LinkMissing and LinkError for the bus."""
        ...

    def serial_line(self) -> SerialLineCounters | None:
        """Bytes other than replies since `open`; None for buses with a clock, where the host alone sends."""
        ...


def _no_bus(_settings: Options) -> str:
    return ""


def _no_bytes(_settings: Options) -> StreamLink:
    raise LinkError("expected a link of bytes, got one without")


def _no_frames(_settings: Options) -> CanLink:
    raise LinkError("expected a link to a CAN bus, got one that is none")


def _no_transfers(_settings: Options) -> PolledLink:
    raise LinkError("expected a link to a bus that is polled, got one that is none")


def _claims_nothing(_settings: Options) -> Sequence[Claim]:
    return ()


def _knows_no_problem(_settings: Options, _frames: bool) -> str:
    return ""


@dataclass(frozen=True, slots=True)
class LinkType(Generic[S]):
    """Row of a link. Its factories decide which kinds of drivers can use it."""

    name: str
    """The key under a device in the configuration."""
    settings: type[S]
    make: Callable[[S], StreamLink] = _no_bytes
    """Makes a closed link of bytes from its settings."""
    make_can: Callable[[S], CanLink] = _no_frames
    """Makes a closed link to a CAN bus from its settings."""
    make_polled: Callable[[S], PolledLink] = _no_transfers
    """Makes a closed link to a polled bus from its settings."""
    bus_of: Callable[[S], str] = _no_bus
    """Returns the name of the bus that its settings name, which devices share; empty for links without one."""
    claims: Callable[[S], Sequence[Claim]] = _claims_nothing
    """What a link with these settings uses, which no other device may use as well."""
    problem: Callable[[S, bool], str] = _knows_no_problem
    """Why `open` would refuse these settings, as far as that shows without opening a port; empty for nothing known.

    The second argument says whether the link is to deliver frames of a CAN bus."""

    @property
    def polled(self) -> bool:
        """Whether it serves polled drivers: devices on it reply and never send unasked."""
        return self.make_polled is not _no_transfers

    @property
    def searchable(self) -> bool:
        """Whether detection (`driver: auto`) works on it."""
        return self.make is not _no_bytes or self.polled or self.frames_only

    @property
    def frames_only(self) -> bool:
        """Whether it serves drivers of CAN frames only."""
        return self.make_can is not _no_frames and self.make is _no_bytes

    def fits(self, driver: Driver) -> bool:
        """Whether a driver can use such a link."""
        if isinstance(driver, StreamDriver):
            return self.make is not _no_bytes
        if isinstance(driver, PolledDriver):
            return driver.link == self.name
        return isinstance(driver, CanDriver) and self.make_can is not _no_frames
