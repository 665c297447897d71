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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final, Literal, get_args

from imud.contracts.codec import Message, ReplyFrame
from imud.contracts.device_settings import Written
from imud.contracts.driver import Identity
from imud.contracts.session import Outcome, Rejection, Reply, Request, RequestScript, Silence, never
from imud.devices.hipnuc.j1939.messages import PGNS, PRIORITY
from imud.errors import NoReply, Rejected
from imud.formats.can import CanFilter, pack_frame
from imud.formats.j1939 import WITHOUT_PRIORITY, J1939Id, filter_of, join
from imud.units import NS_PER_MS, NS_PER_S

CONFIGURE: Final = 0xEF00
"""PGN of requests and replies (proprietary A)."""
LAYOUT: Final = struct.Struct("<HBBI")
"""register, command, status, value."""
HEAD: Final = struct.Struct("<HB")
STATUS_AT: Final = 3
READ: Final = 0x03
WRITE: Final = 0x06
HOST_ADDRESS: Final = 0x55
"""Source address in the manual's example, and destination of all replies."""

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


@dataclass(frozen=True, slots=True)
class J1939Node:
    """A module and the address under which imud talks to it."""

    address: int
    host: int = HOST_ADDRESS

    def reply_ids(self) -> frozenset[int]:
        """Identifiers of replies, without priority."""
        return frozenset(
            join(J1939Id(0, CONFIGURE, self.address, destination)) for destination in (self.host, HOST_ADDRESS)
        )


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
