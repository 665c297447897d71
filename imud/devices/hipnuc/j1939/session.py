"""Request scripts of a HiPNUC module on J1939: registers behind PGN EF00. Manual "IMU配置手冊" V1.5.9, section 6.2.

    0CEFddss   | register u16 | command u8 | status u8 | value u32 |    dd the module, ss imud; little-endian
    0CEFssdd   | the same     | the same   | reserved  | value     |    the module's reply

Command 6 writes and 3 reads. A reply is matched by its sender, its register and its command. It comes to the sender of
the request, or, in firmware that knows only one host, to 0x55.

Departures from the manual's table: FF4A's interval row prints command 0x60, which is 0x06 as in all others; register
0x0096 (send a message once) stands in the vendor's own programs, that its value is the PGN is assumed; so is that the
PGNs of newer firmware have their intervals where the others have them. Status is reserved and ignored. Settings are
lost at a restart unless saved; address and bit rate are in force after saving and restarting. What can be read is read
back after it was written; zero, save, restart and factory reset cannot.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal, get_args

from imud.contracts.codec import Message, ReplyFrame
from imud.contracts.driver import Identity
from imud.contracts.session import Reply, Request, RequestScript, Silence, never
from imud.devices.hipnuc.j1939.messages import PGNS, PRIORITY
from imud.errors import NoReply, Rejected
from imud.formats.can import pack_frame
from imud.formats.j1939 import WITHOUT_PRIORITY, J1939Id, join
from imud.units import NS_PER_MS, NS_PER_S

CONFIGURE: Final = 0xEF00
"""PGN of requests and replies (proprietary A)."""
LAYOUT: Final = struct.Struct("<HBBI")
"""register, command, status, value."""
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
INTERVALS: Final = {pgn: 0x0100 | pgn & 0xFF for pgn in PGNS}
"""Register of the interval of each message, ms."""

SAVE, FACTORY, RESTART = 0x00, 0x01, 0xFF
"""Values of CONTROL."""
BitRate = Literal[1_000_000, 800_000, 500_000, 250_000, 125_000]
BITRATES: Final[tuple[BitRate, ...]] = get_args(BitRate)
"""In bit/s, by their code in BITRATE."""
ADDRESS_MIN, ADDRESS_MAX = 1, 128
INTERVAL_MIN_MS, INTERVAL_MAX_MS = 5, 1000

REPLY_TIMEOUT_NS: Final = 500 * NS_PER_MS  # the manual gives none; J1939-21 gives a node 200 ms
FLASH_TIMEOUT_NS: Final = 2 * NS_PER_S


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
    peer: J1939Node, register: int, command: int, value: int, name: str, timeout_ns: int = REPLY_TIMEOUT_NS
) -> Request:
    """Make a request: one frame to the module, and its reply."""
    ids = peer.reply_ids()
    head = LAYOUT.pack(register, command, 0, 0)[:3]

    def is_reply(message: Message) -> bool:
        return (
            isinstance(message, ReplyFrame)
            and message.frame_id & WITHOUT_PRIORITY in ids
            and len(message.payload) == LAYOUT.size
            and message.payload.startswith(head)
        )

    can_id = join(J1939Id(PRIORITY, CONFIGURE, peer.host, peer.address))
    frame = pack_frame(can_id, True, LAYOUT.pack(register, command, 0, value))
    return Request(frame, name, is_reply, never, is_reply, timeout_ns)


def read(peer: J1939Node, register: int) -> RequestScript[int]:
    """The value of a register. Raises NoReply."""
    name = f"read register {register:#06x}"
    outcome = yield exchange(peer, register, READ, 0, name)
    if not isinstance(outcome, Reply):
        raise NoReply(f"{name} at address {peer.address}: expected a reply, got none; is `options.address` right?")
    return _value(outcome)


def identify(peer: J1939Node) -> RequestScript[Identity]:
    """Read its address: no register names a module otherwise. Raises NoReply."""
    address = yield from read(peer, ADDRESS)
    return Identity(details={"address": str(address)})


def read_settings(peer: J1939Node) -> RequestScript[Mapping[str, str]]:
    """Read all that can be read. Registers that do not answer are left out, but for the first. Raises NoReply."""
    settings = {"address": str((yield from read(peer, ADDRESS)))}
    rows = {"bitrate": BITRATE, "x_reversed": X_SIGN, "y_reversed": Y_SIGN}
    rows |= {f"interval_ms_{pgn:04X}": register for pgn, register in INTERVALS.items()}
    for name, register in rows.items():
        outcome = yield exchange(peer, register, READ, 0, f"read {name}")
        if isinstance(outcome, Reply):
            value = _value(outcome)
            in_list = register == BITRATE and value < len(BITRATES)
            settings[name] = str(BITRATES[value] if in_list else value)
    return settings


def set_interval(peer: J1939Node, pgn: int, interval_ms: int) -> RequestScript[None]:
    """Set how often a message is sent, 5 … 1000 ms. Raises NoReply, Rejected, as all of these do."""
    return _write_checked(peer, INTERVALS[pgn], interval_ms, f"interval of {pgn:04X}")


def set_bitrate(peer: J1939Node, bitrate: BitRate) -> RequestScript[None]:
    """Set the bit rate of the bus; in force after `save` and `restart`."""
    return _write_checked(peer, BITRATE, BITRATES.index(bitrate), "bit rate")


def set_address(peer: J1939Node, address: int) -> RequestScript[None]:
    """Set the address on the bus, 1 … 128; in force after `save` and `restart`."""
    return _write_checked(peer, ADDRESS, address, "address")


def set_direction(peer: J1939Node, axis: Literal["X", "Y"], is_reversed: bool) -> RequestScript[None]:
    """Set the sign of the angle about an axis."""
    return _write_checked(peer, X_SIGN if axis == "X" else Y_SIGN, int(is_reversed), f"direction of {axis}")


def zero(peer: J1939Node, what: Zero) -> RequestScript[None]:
    """Make the present position zero, or undo that."""
    return _write(peer, ZERO, what.value, "zero")


def send_once(peer: J1939Node, pgn: int) -> RequestScript[None]:
    """Send a message once, in addition to its interval."""
    return _write(peer, ONCE, pgn, f"send {pgn:04X} once")


def save(peer: J1939Node) -> RequestScript[None]:
    """Write all settings to flash."""
    return _write(peer, CONTROL, SAVE, "save", FLASH_TIMEOUT_NS)


def factory_reset(peer: J1939Node) -> RequestScript[None]:
    """Restore the factory settings, address and bit rate included: it may leave the bus before it replies."""
    yield exchange(peer, CONTROL, WRITE, FACTORY, "factory reset", FLASH_TIMEOUT_NS)


def restart(peer: J1939Node) -> RequestScript[None]:
    """Restart; what was not saved is lost. Whether that is replied to is not stated: silence is no failure."""
    yield exchange(peer, CONTROL, WRITE, RESTART, "restart")


def _write(
    peer: J1939Node, register: int, value: int, name: str, timeout_ns: int = REPLY_TIMEOUT_NS
) -> RequestScript[None]:
    outcome = yield exchange(peer, register, WRITE, value, name, timeout_ns)
    if isinstance(outcome, Silence):
        raise NoReply(f"{name}: expected a reply from address {peer.address}, got none")


def _write_checked(peer: J1939Node, register: int, value: int, name: str) -> RequestScript[None]:
    """Write and read back."""
    yield from _write(peer, register, value, name)
    now = yield from read(peer, register)
    if now != value:
        raise Rejected(f"{name}: wrote {value}, the module has {now}")


def _value(outcome: Reply) -> int:
    value: int = LAYOUT.unpack(outcome.frames[-1].payload)[3]
    return value
