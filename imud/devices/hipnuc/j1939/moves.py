"""Request scripts after which a module can have another address: address written, restart, factory settings.

The manual (section 6.2.2) says of the bit rate that it needs saving and restarting, and of the address nothing. So both
are dealt with: after a write the same write is sent again, to the old and then to the new address, and who confirms
it is where the module is. After a restart a module claims its address (J1939-81); one that does not is looked for by
whatever it sends. A module is followed by `Request.settings`. One that is heard nowhere is commanded to go back, and
that is an error.
"""

from collections.abc import Callable, Sequence
from typing import Final

from msgspec.structs import replace as with_fields

from imud.contracts.codec import Message, ReplyFrame
from imud.contracts.device_settings import Written
from imud.contracts.session import Rejection, Reply, Request, RequestScript, never
from imud.devices.hipnuc.j1939 import session
from imud.devices.hipnuc.j1939.codec import FACTORY_ADDRESS, HipnucJ1939Settings
from imud.devices.hipnuc.j1939.session import ADDRESS, CLAIMED, READ, READ_VALUE, WRITE, J1939Node, exchange
from imud.errors import BadArgument, NoReply, Rejected
from imud.formats.can import CanFilter
from imud.formats.j1939 import ADDRESS_MAX, filter_of, split
from imud.units import NS_PER_MS, NS_PER_S

LISTEN_NS: Final = 1100 * NS_PER_MS
"""A message comes at least once a second (section 6.2.2)."""
BOOT_NS: Final = 3 * NS_PER_S
"""Longest time until an address is claimed after a restart; the manual gives none."""
SOURCE_MASK: Final = 0xFF


def change_address(settings: HipnucJ1939Settings, new: int) -> RequestScript[Written]:
    """Give a module another address, 1 … 128, and follow it where that is in force at once.

    Raises BadArgument for an address that is heard on the bus, Rejected, and NoReply for a module that is heard at
    neither address afterwards; it is commanded to go back then.
    """
    peer = settings.peer
    if new == peer.address:
        return (yield from session.set_address(peer, new))
    if heard := (yield from _heard(settings, new)):
        raise BadArgument(f"address {new} is taken: PGN {split(heard).pgn:04X} comes from it")
    there = J1939Node(new, peer.host)
    first = yield from _write_address(peer, new)
    if (yield from _write_address(peer, new)):
        return (yield from session.verify(peer, ADDRESS, new, "address", pending=True))
    if (yield from _write_address(there, new)):
        yield _follow(settings, new)
        return (yield from session.verify(there, ADDRESS, new, "address"))
    back = exchange(there, ADDRESS, WRITE, peer.address, f"back to address {peer.address}")
    yield Request(back.payload, back.name, never, never, never, silent=True)
    confirmed = "confirmed the write and " if first else ""
    raise NoReply(
        f"the module {confirmed}answers neither at address {new} nor at {peer.address}: it was commanded to go back"
    )


def restart(settings: HipnucJ1939Settings, bus_bit_s: int) -> RequestScript[str]:
    """Restart, and follow the module to the address that it has then; return what became of it.

    `bus_bit_s` is the rate of the bus, 0 where it is not known. Raises Rejected, and NoReply for a module that is not
    heard afterwards.
    """
    peer = settings.peer
    saved = yield from session.read_values(peer, (ADDRESS, session.BITRATE))
    code = saved.get(session.BITRATE, len(session.BITRATES))
    rate = session.BITRATES[code] if code < len(session.BITRATES) else bus_bit_s
    saved_address = saved.get(ADDRESS, peer.address)
    valid = 0 <= saved_address <= ADDRESS_MAX
    address = saved_address if valid else peer.address  # not an address of a node: it will stay where it is
    places = tuple(dict.fromkeys((peer.address, address)))
    found = yield from _claim(session.restart_request(peer), (*places, FACTORY_ADDRESS) if saved else None)
    for place in places if found is None else ():
        if (yield from _heard(settings, place)):
            found = place
            break
    if found is None:
        if bus_bit_s and rate != bus_bit_s:
            return f"restarted; it has {rate} bit/s now, which this bus has not"
        words = " or ".join(map(str, places))
        raise NoReply(f"nothing is heard of address {words} after the restart: has it another bit rate now?")
    if found != peer.address:
        yield _follow(settings, found)
    return f"restarted, at address {found}"


def factory_reset_and_find(settings: HipnucJ1939Settings) -> RequestScript[str]:
    """Restore the factory settings, address 8 and its bit rate included; in force after a restart at the latest.

    Raises BadArgument where another module has address 8, Rejected.
    """
    if settings.address != FACTORY_ADDRESS and (yield from _heard(settings, FACTORY_ADDRESS)):
        raise BadArgument(
            f"address {FACTORY_ADDRESS} is taken: the factory's address is that of another node on the bus"
        )
    yield from session.factory_reset(settings.peer)
    if settings.address != FACTORY_ADDRESS and (yield from _heard(settings, FACTORY_ADDRESS)):
        yield _follow(settings, FACTORY_ADDRESS)
        return f"restored, at address {FACTORY_ADDRESS}"
    return f"restored; it has address {FACTORY_ADDRESS} after the next restart at the latest"


def _claim(request: Request, places: Sequence[int] | None) -> RequestScript[int | None]:
    """Send the request for a restart; return the address that is claimed then. `places`: None for any."""

    def ends(message: Message) -> bool:
        if not isinstance(message, ReplyFrame) or split(message.frame_id).pgn != CLAIMED:
            return False
        return places is None or split(message.frame_id).source in places

    claims = (filter_of(CLAIMED, None),)
    outcome = yield Request(request.payload, request.name, ends, request.is_rejection, never, BOOT_NS, also=claims)
    if isinstance(outcome, Rejection):
        raise Rejected("restart: the module refused")
    return split(outcome.frames[-1].frame_id).source if isinstance(outcome, Reply) else None


def _heard(settings: HipnucJ1939Settings, address: int) -> RequestScript[int]:
    """Ask a module for its address; return the identifier of the first frame from there, of any kind, 0 for none."""
    asked = exchange(J1939Node(address, settings.host_address), ADDRESS, READ, READ_VALUE, f"address {address}")
    also = (CanFilter(address, SOURCE_MASK, True),)
    outcome = yield Request(asked.payload, asked.name, _is_from(address), never, never, LISTEN_NS, also=also)
    return outcome.frames[-1].frame_id if isinstance(outcome, Reply) else 0


def _write_address(peer: J1939Node, value: int) -> RequestScript[bool]:
    """Write the register of the address; return whether that module confirmed it. Raises Rejected."""
    also = tuple(CanFilter(one, 0x03FF_FFFF, True) for one in sorted(peer.reply_ids()))
    outcome = yield exchange(peer, ADDRESS, WRITE, value, f"address {value}", also=also)
    if isinstance(outcome, Rejection):
        raise Rejected(f"address {value}: the module refused, with status {outcome.frames[-1].payload[3]}")
    return isinstance(outcome, Reply)


def _follow(settings: HipnucJ1939Settings, address: int) -> Request:
    """Listen to the module at another address from now on."""
    moved = with_fields(settings, address=address)
    return Request(b"", f"now at address {address}", never, never, never, silent=True, settings=moved)


def _is_from(address: int) -> Callable[[Message], bool]:
    return lambda message: isinstance(message, ReplyFrame) and split(message.frame_id).source == address
