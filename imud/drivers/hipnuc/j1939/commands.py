"""Request scripts of a HiPNUC module on J1939: registers behind PGN EF00. Manual "IMU配置手冊" V1.5.9, section 6.2.

    0CEFddss   | register u16 | command u8 | status u8 | value u32 |    dd the module, ss imud; little-endian
    0CEFssdd   | the same     | the same   | reserved  | value     |    the module's reply

Command 6 writes and 3 reads. A reply is matched by its sender, its register and its command. It comes to the sender of
the request, or, in firmware that knows only one host, to 0x55. A status other than 0 in it means that the module
refused.

Departures from the manual's table: FF4A's interval row prints command 0x60, which is 0x06 as in all others; the value
of a read is reserved there, and 1 here, as in the vendor's own programs; register 0x0096 (send a message once) stands
in these, that its value is the PGN is assumed; so is that the PGNs of newer firmware have their intervals where the
others have them. It has no reply: the message is the answer. Registers 0x70 to 0x78 are those of Modbus; that a value
has two characters of the name, the first in the higher byte, is a guess, so a name that is no text is left out.

Settings are lost at a restart unless saved. What can be read is read back after it was written; zero, save and factory
reset cannot. Where a module is after its address was written, or after a restart, is in `moves.py`.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import Final, Literal, get_args

from msgspec.structs import replace as with_fields

from imud.contracts.driver import Identity
from imud.contracts.script import Message, Outcome, Rejection, Reply, ReplyFrame, Request, RequestScript, Silence, never
from imud.contracts.setting import Written
from imud.drivers.hipnuc.j1939.codec import (
    CONFIGURE,
    FACTORY_ADDRESS,
    PGNS,
    PRIORITY,
    HipnucJ1939Options,
    J1939Node,
)
from imud.formats.can import CanFilter, pack_frame
from imud.formats.j1939 import ADDRESS_MAX, WITHOUT_PRIORITY, J1939Id, filter_of, join, split
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.model.units import NS_PER_MS, NS_PER_S

LAYOUT: Final = struct.Struct("<HBBI")
"""register, command, status, value."""
HEAD: Final = struct.Struct("<HB")
STATUS_AT: Final = 3
READ: Final = 0x03
WRITE: Final = 0x06

CONTROL: Final = 0x0000
ONCE: Final = 0x0096
BITRATE: Final = 0x009A
ADDRESS: Final = 0x009C
X_SIGN: Final = 0x009E
Y_SIGN: Final = 0x009F
ZERO: Final = 0x00A5
PRODUCT_NAME: Final = tuple(range(0x70, 0x78))
VERSION: Final = 0x78
READ_VALUE: Final = 1
"""Value in a read: reserved by the manual, 1 in the vendor's programs, which suits both readings."""
REQUEST: Final = 0xEA00
"""PGN that asks for another one (J1939-21)."""
REQUEST_PRIORITY: Final = 6
CLAIMED: Final = 0xEE00
"""PGN Address Claimed (J1939-81), to all."""
INTERVALS: Final = {pgn: 0x0100 | pgn & 0xFF for pgn in PGNS}
"""Register of the interval of each message, ms."""

SAVE, FACTORY, RESTART = 0x00, 0x01, 0xFF
"""Values of CONTROL."""
BitRate = Literal[1_000_000, 800_000, 500_000, 250_000, 125_000]
BITRATES: Final[tuple[BitRate, ...]] = get_args(BitRate)
"""In bit/s, by their code in BITRATE."""
MODULE_ADDRESS_MIN, MODULE_ADDRESS_MAX = 1, 128
INTERVAL_MIN_MS, INTERVAL_MAX_MS = 5, 1000

REPLY_TIMEOUT_NS: Final = 500 * NS_PER_MS  # the manual gives none; J1939-21 gives a node 200 ms
PRESENT_TIMEOUT_NS: Final = 250 * NS_PER_MS
"""The same where a register may not exist, which is not answered, and many are read."""
FLASH_TIMEOUT_NS: Final = 5 * NS_PER_S // 2
CLAIM_NS: Final = 250 * NS_PER_MS
"""J1939-81: a node claims its address within 250 ms."""
SILENT_MAX: Final = 2
"""Registers in a row without a reply after which a module counts as one that answers no reads."""


class Zero(Enum):
    """Operations on the zero of the angles."""

    HERE = 2
    """The present position is zero."""
    CANCEL = 5
    """Back to the physical angles."""


def exchange(
    peer: J1939Node,
    register: int,
    command: int,
    value: int,
    name: str,
    timeout_ns: int = REPLY_TIMEOUT_NS,
    also: tuple[CanFilter, ...] = (),
) -> Request:
    """Make a request: one frame to the module, and its reply. `also`: replies of a module that is not listened to."""
    ids = peer.reply_ids()
    head = HEAD.pack(register, command)

    def is_reply(message: Message) -> bool:
        return (
            isinstance(message, ReplyFrame)
            and message.frame_id & WITHOUT_PRIORITY in ids
            and len(message.payload) == LAYOUT.size
            and message.payload.startswith(head)
        )

    def accepts(message: Message) -> bool:
        return is_reply(message) and not _status(message)

    def refuses(message: Message) -> bool:
        return is_reply(message) and _status(message) != 0

    can_id = join(J1939Id(PRIORITY, CONFIGURE, peer.host, peer.address))
    frame = pack_frame(can_id, True, LAYOUT.pack(register, command, 0, value))
    return Request(frame, name, accepts, refuses, is_reply, timeout_ns, also=also)


def read(peer: J1939Node, register: int) -> RequestScript[int]:
    """The value of a register. Raises NoReply, Rejected."""
    name = f"read register {register:#06x}"
    outcome = yield exchange(peer, register, READ, READ_VALUE, name)
    if isinstance(outcome, Silence):
        raise NoReply(f"{name} at address {peer.address}: expected a reply, got none; is `options.address` right?")
    _refuse(name, outcome)
    return _value(outcome)


def identify(peer: J1939Node) -> RequestScript[Identity]:
    """Read its address, its name and firmware, and the NAME that it claims its address with. Raises NoReply."""
    address = yield from read(peer, ADDRESS)
    details = {"address": str(address)}
    name = yield from _claimed_name(peer)
    if name is not None:
        details["J1939 NAME"] = f"{name:016X}"
    values = yield from read_values(peer, (VERSION, *PRODUCT_NAME))
    firmware = values.get(VERSION, 0)
    return Identity(_product(values), "", ".".join(str(firmware)) if firmware else "", details)


def read_settings(peer: J1939Node) -> RequestScript[Mapping[str, str]]:
    """Read all that can be read. Registers that do not answer are left out, but for the first. Raises NoReply."""
    settings = {"address": str((yield from read(peer, ADDRESS)))}
    rows = {"bitrate": BITRATE, "x_reversed": X_SIGN, "y_reversed": Y_SIGN}
    rows |= {f"interval_ms_{pgn:04X}": register for pgn, register in INTERVALS.items()}
    values = yield from read_values(peer, tuple(rows.values()))
    for name, register in rows.items():
        if register in values:
            value = values[register]
            in_list = register == BITRATE and value < len(BITRATES)
            settings[name] = str(BITRATES[value] if in_list else value)
    return settings


def read_values(peer: J1939Node, registers: Sequence[int]) -> RequestScript[dict[int, int]]:
    """Read registers; those that do not answer, or refuse, are left out; all, where the first ones do not answer."""
    values: dict[int, int] = {}
    silent = 0
    for register in registers:
        if silent == SILENT_MAX and not values:
            break
        name = f"read register {register:#06x}"
        outcome = yield exchange(peer, register, READ, READ_VALUE, name, PRESENT_TIMEOUT_NS)
        if isinstance(outcome, Reply):
            values[register] = _value(outcome)
        silent += isinstance(outcome, Silence)
    return values


def set_interval(peer: J1939Node, pgn: int, interval_ms: int) -> RequestScript[Written]:
    """Set how often a message is sent, 5 … 1000 ms. Raises NoReply, Rejected, as all of these do."""
    return _write_checked(peer, INTERVALS[pgn], interval_ms, f"interval of {pgn:04X}")


def set_bitrate(peer: J1939Node, bitrate: BitRate) -> RequestScript[Written]:
    """Set the bit rate of the bus; in force after `save` and `restart`."""
    return _write_checked(peer, BITRATE, BITRATES.index(bitrate), "bit rate", pending=True)


def set_address(peer: J1939Node, address: int) -> RequestScript[Written]:
    """Set the address on the bus, 1 … 128; in force after `save` and `restart`."""
    return _write_checked(peer, ADDRESS, address, "address", pending=True)


def set_direction(peer: J1939Node, axis: Literal["X", "Y"], is_reversed: bool) -> RequestScript[Written]:
    """Set the sign of the angle about an axis."""
    return _write_checked(peer, X_SIGN if axis == "X" else Y_SIGN, int(is_reversed), f"direction of {axis}")


def zero(peer: J1939Node, what: Zero) -> RequestScript[None]:
    """Make the present position zero, or undo that."""
    return _write(peer, ZERO, what.value, "zero")


def send_once(peer: J1939Node, pgn: int) -> RequestScript[None]:
    """Have a message sent once, in addition to its interval. The message itself is the answer."""
    name = f"send {pgn:04X} once"
    asked = exchange(peer, ONCE, WRITE, pgn, name)
    wanted = filter_of(pgn, peer.address)

    def is_message(message: Message) -> bool:
        return isinstance(message, ReplyFrame) and wanted.matches(message.frame_id, True)

    outcome = yield replace(asked, is_end=is_message, is_part=never, also=(wanted,))
    if isinstance(outcome, Silence):
        raise NoReply(f"{name}: expected the message from address {peer.address}, got none")
    _refuse(name, outcome)


def save(peer: J1939Node) -> RequestScript[None]:
    """Write all settings to flash."""
    return _write(peer, CONTROL, SAVE, "save", FLASH_TIMEOUT_NS)


def factory_reset(peer: J1939Node) -> RequestScript[None]:
    """Restore the factory settings, address and bit rate included: it may leave the bus before it replies."""
    outcome = yield exchange(peer, CONTROL, WRITE, FACTORY, "factory reset", FLASH_TIMEOUT_NS)
    _refuse("factory reset", outcome)


def restart_request(peer: J1939Node) -> Request:
    """The request for a restart; no reply is stated."""
    return exchange(peer, CONTROL, WRITE, RESTART, "restart")


def verify(peer: J1939Node, register: int, value: int, name: str, *, pending: bool = False) -> RequestScript[Written]:
    """Read back what was written. Raises Rejected where something else stands there."""
    try:
        now = yield from read(peer, register)
    except (NoReply, Rejected):
        return Written.UNVERIFIED_PENDING if pending else Written.UNVERIFIED
    if now != value:
        raise Rejected(f"{name}: wrote {value}, the module has {now}")
    return Written.PENDING if pending else Written.VERIFIED


def _write(
    peer: J1939Node, register: int, value: int, name: str, timeout_ns: int = REPLY_TIMEOUT_NS
) -> RequestScript[None]:
    outcome = yield exchange(peer, register, WRITE, value, name, timeout_ns)
    if isinstance(outcome, Silence):
        raise NoReply(f"{name}: expected a reply from address {peer.address}, got none")
    _refuse(name, outcome)


def _write_checked(
    peer: J1939Node, register: int, value: int, name: str, *, pending: bool = False
) -> RequestScript[Written]:
    """Write and read back."""
    yield from _write(peer, register, value, name)
    return (yield from verify(peer, register, value, name, pending=pending))


def _claimed_name(peer: J1939Node) -> RequestScript[int | None]:
    """The NAME with which the module claims its address (J1939-81); None where it does not."""
    wanted = filter_of(CLAIMED, peer.address)
    can_id = join(J1939Id(REQUEST_PRIORITY, REQUEST, peer.host, peer.address))
    frame = pack_frame(can_id, True, CLAIMED.to_bytes(3, "little").ljust(LAYOUT.size, b"\0"))

    def is_claim(message: Message) -> bool:
        return isinstance(message, ReplyFrame) and wanted.matches(message.frame_id, True)

    outcome = yield Request(frame, "request for address claimed", is_claim, never, never, CLAIM_NS, also=(wanted,))
    return int.from_bytes(outcome.frames[-1].payload, "little") if isinstance(outcome, Reply) else None


def _product(values: Mapping[int, int]) -> str:
    """The name of the product; empty where it is no text."""
    if any(values.get(register, 0) > 0xFFFF for register in PRODUCT_NAME):
        return ""
    text = b"".join(values.get(register, 0).to_bytes(2, "big") for register in PRODUCT_NAME).rstrip(b"\0 ")
    return text.decode("ascii") if all(byte in range(0x20, 0x7F) for byte in text) else ""


def _status(message: Message) -> int:
    return message.payload[STATUS_AT] if isinstance(message, ReplyFrame) else 0


def _refuse(name: str, outcome: Outcome) -> None:
    """Raises Rejected for an answer with a status."""
    if isinstance(outcome, Rejection):
        raise Rejected(f"{name}: the module refused, with status {_status(outcome.frames[-1])}")


def _value(outcome: Outcome) -> int:
    value: int = LAYOUT.unpack(outcome.frames[-1].payload)[3]
    return value


LISTEN_NS: Final = 1100 * NS_PER_MS
"""A message comes at least once a second (section 6.2.2)."""
BOOT_NS: Final = 3 * NS_PER_S
"""Longest time until an address is claimed after a restart; the manual gives none."""
SOURCE_MASK: Final = 0xFF


def change_address(settings: HipnucJ1939Options, new: int) -> RequestScript[Written]:
    """Give a module another address, 1 … 128, and follow it where that is in force at once.

    Raises BadArgument for an address that is heard on the bus, Rejected, and NoReply for a module that is heard at
    neither address afterwards; it is commanded to go back then.
    """
    peer = settings.peer
    if new == peer.address:
        return (yield from set_address(peer, new))
    if heard := (yield from _heard(settings, new)):
        raise BadArgument(f"address {new} is taken: PGN {split(heard).pgn:04X} comes from it")
    there = J1939Node(new, peer.host)
    first = yield from _write_address(peer, new)
    if (yield from _write_address(peer, new)):
        return (yield from verify(peer, ADDRESS, new, "address", pending=True))
    if (yield from _write_address(there, new)):
        yield _follow(settings, new)
        return (yield from verify(there, ADDRESS, new, "address"))
    back = exchange(there, ADDRESS, WRITE, peer.address, f"back to address {peer.address}")
    yield Request(back.payload, back.name, never, never, never, silent=True)
    confirmed = "confirmed the write and " if first else ""
    raise NoReply(
        f"the module {confirmed}answers neither at address {new} nor at {peer.address}: it was commanded to go back"
    )


def restart(settings: HipnucJ1939Options, bus_bit_s: int) -> RequestScript[str]:
    """Restart, and follow the module to the address that it has then; return what became of it.

    `bus_bit_s` is the rate of the bus, 0 where it is not known. Raises Rejected, and NoReply for a module that is not
    heard afterwards.
    """
    peer = settings.peer
    saved = yield from read_values(peer, (ADDRESS, BITRATE))
    code = saved.get(BITRATE, len(BITRATES))
    rate = BITRATES[code] if code < len(BITRATES) else bus_bit_s
    saved_address = saved.get(ADDRESS, peer.address)
    valid = 0 <= saved_address <= ADDRESS_MAX
    address = saved_address if valid else peer.address  # not an address of a node: it will stay where it is
    places = tuple(dict.fromkeys((peer.address, address)))
    found = yield from _claim(restart_request(peer), (*places, FACTORY_ADDRESS) if saved else None)
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


def factory_reset_and_find(settings: HipnucJ1939Options) -> RequestScript[str]:
    """Restore the factory settings, address 8 and its bit rate included; in force after a restart at the latest.

    Raises BadArgument where another module has address 8, Rejected.
    """
    if settings.address != FACTORY_ADDRESS and (yield from _heard(settings, FACTORY_ADDRESS)):
        raise BadArgument(
            f"address {FACTORY_ADDRESS} is taken: the factory's address is that of another node on the bus"
        )
    yield from factory_reset(settings.peer)
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


def _heard(settings: HipnucJ1939Options, address: int) -> RequestScript[int]:
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


def _follow(settings: HipnucJ1939Options, address: int) -> Request:
    """Listen to the module at another address from now on."""
    moved = with_fields(settings, address=address)
    return Request(b"", f"now at address {address}", never, never, never, silent=True, settings=moved)


def _is_from(address: int) -> Callable[[Message], bool]:
    return lambda message: isinstance(message, ReplyFrame) and split(message.frame_id).source == address
