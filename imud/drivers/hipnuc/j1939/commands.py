"""Request scripts of a HiPNUC device on J1939: registers behind PGN EF00. Manual "IMU配置手冊" V1.5.9, section 6.2.

    0CEFddss   | register u16 | command u8 | status u8 | value u32 |    dd the device, ss imud; little-endian
    0CEFssdd   | the same     | the same   | reserved  | value     |    the device's reply

Command 6 writes, command 3 reads. A reply has the sender, the register and the command of its request. Its destination
is the sender of the request, or 0x55 in firmware that knows only one host. A status other than 0 means rejection.

Differences from the manual's table:
- The interval row of FF4A prints command 0x60 in place of 0x06.
- The value of a read is reserved there, and 1 here, as in the vendor's programs.
- Register 0x0096 (send a message once) is from these programs. imud assumes that its value is the PGN, and that the
  PGNs of newer firmware have their intervals at the same offset. The register has no reply: the message is the reply.
- Registers 0x70 to 0x78 are the Modbus registers. imud assumes two characters of the name per value, the first in the
  high byte. It ignores a name that is not text.

Settings are lost at a restart unless they are saved. imud reads back every written value; zero, save and factory reset
are not readable.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import Final, Literal, get_args

from imud.contracts.command import VerbResult
from imud.contracts.driver import Identity
from imud.contracts.script import Message, Outcome, Rejection, Reply, ReplyFrame, Request, RequestScript, Silence, never
from imud.contracts.setting import Written
from imud.drivers.hipnuc.j1939.codec import (
    CONFIGURE,
    FACTORY_ADDRESS,
    PGNS,
    PRIORITY,
    J1939Node,
    NodeOptions,
)
from imud.drivers.readdressing import LISTEN_NS, Readdressing
from imud.formats.can import CanFilter, pack_frame
from imud.formats.j1939 import ADDRESS_MAX, CLAIMED, REQUEST, WITHOUT_PRIORITY, J1939Id, filter_of, join, split
from imud.model.errors import NoReply, NotApplied, Rejected
from imud.model.units import NS_PER_MS, NS_PER_S

LAYOUT: Final = struct.Struct("<HBBI")  # register, command, status, value
HEAD: Final = struct.Struct("<HB")
STATUS_AT: Final = 3
READ: Final = 0x03
WRITE: Final = 0x06

CONTROL: Final = 0x0000
ONCE: Final = 0x0096
BITRATE: Final = 0x009A
ADDRESS: Final = 0x009C
OUTPUT: Final = 0x009D  # periodic output: 1 on, 0 off (source: a note of a third party; the values are assumed)
X_SIGN: Final = 0x009E
Y_SIGN: Final = 0x009F
ZERO: Final = 0x00A5
PRODUCT_NAME: Final = tuple(range(0x70, 0x78))
VERSION: Final = 0x78
READ_VALUE: Final = 1  # value of a read: reserved in the manual, 1 in the vendor's programs
REQUEST_PRIORITY: Final = 6
INTERVALS: Final = {pgn: 0x0100 | pgn & 0xFF for pgn in PGNS}  # register of the interval of each message, ms

SAVE, FACTORY, RESTART = 0x00, 0x01, 0xFF  # values of CONTROL
BitRate = Literal[1_000_000, 800_000, 500_000, 250_000, 125_000]
BITRATES: Final[tuple[BitRate, ...]] = get_args(BitRate)  # bit rates by their code in BITRATE, bit/s
MODULE_ADDRESS_MIN, MODULE_ADDRESS_MAX = 1, 128
INTERVAL_MIN_MS, INTERVAL_MAX_MS = 5, 1000
NEVER_MS: Final = 0  # interval of a message that newer firmware does not send

REPLY_TIMEOUT_NS: Final = 500 * NS_PER_MS  # the manual states none; J1939-21 gives a node 200 ms
# Timeout of registers that may not exist, ns. Such registers do not reply, and imud reads many of them.
PRESENT_TIMEOUT_NS: Final = 250 * NS_PER_MS
FLASH_TIMEOUT_NS: Final = 5 * NS_PER_S // 2
CLAIM_NS: Final = 250 * NS_PER_MS  # maximum time of an address claim, ns (J1939-81)
SILENT_MAX: Final = 2  # number of registers in a row without reply before imud stops the read


class Zero(Enum):
    """Operations on the zero of the angles."""

    HERE = 2  # the present position is zero
    CANCEL = 5  # back to the physical angles


def exchange(
    peer: J1939Node,
    register: int,
    command: int,
    value: int,
    name: str,
    timeout_ns: int = REPLY_TIMEOUT_NS,
    also: tuple[CanFilter, ...] = (),
) -> Request:
    """Return a request: one frame to the device, and its reply. `also`: filters for replies of another device."""
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
    kind = f"register {register} of {peer.address}, command {command}"
    is_probe = (register, command) == (ADDRESS, READ)
    probe = None if is_probe else exchange(peer, ADDRESS, READ, READ_VALUE, "read the address")
    return Request(
        frame, name, accepts, refuses, is_reply, timeout_ns,
        kind=kind, repeatable=command == READ, probe=probe, also=also,
    )  # fmt: skip


def read(peer: J1939Node, register: int) -> RequestScript[int]:
    """Return the value of a register. Raises NoReply, Rejected."""
    name = f"read register {register:#06x}"
    outcome = yield exchange(peer, register, READ, READ_VALUE, name)
    if isinstance(outcome, Silence):
        raise NoReply(f"{name} at address {peer.address}: expected a reply, got none; check `options.address`")
    _refuse(name, outcome)
    return _value(outcome)


def identify(peer: J1939Node) -> RequestScript[Identity]:
    """Read address, product name, firmware, and the NAME of its address claim. Raises NoReply."""
    address = yield from read(peer, ADDRESS)
    details = {"address": str(address)}
    name = yield from _claimed_name(peer)
    if name is not None:
        details["J1939 NAME"] = f"{name:016X}"
    values = yield from read_values(peer, (VERSION, *PRODUCT_NAME))
    firmware = values.get(VERSION, 0)
    return Identity(_product(values), "", ".".join(str(firmware)) if firmware else "", details)


def read_values(peer: J1939Node, registers: Sequence[int]) -> RequestScript[dict[int, int]]:
    """Read registers. The result does not contain registers without reply; it is empty if the first registers do not
    reply.
    """
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
    """Set the interval of a message, 5 … 1000 ms, or 0: never. Like all functions below, raises NoReply, Rejected."""
    return _write_checked(peer, INTERVALS[pgn], interval_ms, f"interval of {pgn:04X}")


def set_bitrate(peer: J1939Node, bitrate: BitRate) -> RequestScript[Written]:
    """Set the bit rate of the bus; effective after `save` and `restart`."""
    return _write_checked(peer, BITRATE, BITRATES.index(bitrate), "bit rate", pending=True)


def set_address(peer: J1939Node, address: int) -> RequestScript[Written]:
    """Set the address on the bus, 1 … 128; effective after `save` and `restart`."""
    return _write_checked(peer, ADDRESS, address, "address", pending=True)


def set_output(peer: J1939Node, is_on: bool) -> RequestScript[Written]:
    """Switch the periodic output of all messages on or off."""
    return _write_checked(peer, OUTPUT, int(is_on), "periodic output")


def set_direction(peer: J1939Node, axis: Literal["X", "Y"], is_reversed: bool) -> RequestScript[Written]:
    """Set the sign of the angle about an axis."""
    return _write_checked(peer, X_SIGN if axis == "X" else Y_SIGN, int(is_reversed), f"direction of {axis}")


def zero(peer: J1939Node, what: Zero) -> RequestScript[None]:
    """Make the present position zero, or undo it."""
    return _write(peer, ZERO, what.value, "zero")


def send_once(peer: J1939Node, pgn: int) -> RequestScript[VerbResult]:
    """Send a message once, in addition to its interval, and return the evidence. The message is the reply.

    A message that also arrives without the request is not evidence.
    """
    name = f"send {pgn:04X} once"
    asked = exchange(peer, ONCE, WRITE, pgn, name)
    wanted = filter_of(pgn, peer.address)

    def is_message(message: Message) -> bool:
        return isinstance(message, ReplyFrame) and wanted.matches(message.frame_id, True)

    listening = Request(b"", f"{pgn:04X} without a request", is_message, never, never, LISTEN_NS, also=(wanted,))
    is_periodic = isinstance((yield listening), Reply)
    outcome = yield replace(asked, is_end=is_message, is_part=never, also=(wanted,))
    if isinstance(outcome, Silence):
        raise NoReply(f"{name}: expected the message from address {peer.address}, got none")
    _refuse(name, outcome)
    if is_periodic:
        return VerbResult(False, f"the device also sends {pgn:04X} without the request")
    return VerbResult(True, f"{pgn:04X} arrived, and did not arrive before the request")


def save(peer: J1939Node) -> RequestScript[None]:
    """Write all settings to flash."""
    return _write(peer, CONTROL, SAVE, "save", FLASH_TIMEOUT_NS)


def factory_reset(peer: J1939Node) -> RequestScript[None]:
    """Restore the factory settings with address and bit rate. The device may leave the bus before it replies."""
    outcome = yield exchange(peer, CONTROL, WRITE, FACTORY, "factory reset", FLASH_TIMEOUT_NS)
    _refuse("factory reset", outcome)


def restart_request(peer: J1939Node) -> Request:
    """Return the request for a restart, for which the manual states no reply."""
    return exchange(peer, CONTROL, WRITE, RESTART, "restart")


def verify(peer: J1939Node, register: int, value: int, name: str, *, pending: bool) -> RequestScript[Written]:
    """Read back a written value. Raises Rejected if it differs."""
    try:
        now = yield from read(peer, register)
    except (NoReply, Rejected):
        return Written.UNVERIFIED_PENDING if pending else Written.UNVERIFIED
    if now != value:
        raise NotApplied(f"{name}: expected {value} after the write, got {now}")
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
    yield from _write(peer, register, value, name)
    return (yield from verify(peer, register, value, name, pending=pending))


def _claimed_name(peer: J1939Node) -> RequestScript[int | None]:
    """Return the NAME of the device's address claim (J1939-81); None without a claim."""
    wanted = filter_of(CLAIMED, peer.address)
    can_id = join(J1939Id(REQUEST_PRIORITY, REQUEST, peer.host, peer.address))
    frame = pack_frame(can_id, True, CLAIMED.to_bytes(3, "little").ljust(LAYOUT.size, b"\0"))

    def is_claim(message: Message) -> bool:
        return isinstance(message, ReplyFrame) and wanted.matches(message.frame_id, True)

    outcome = yield Request(frame, "request for address claimed", is_claim, never, never, CLAIM_NS, also=(wanted,))
    return int.from_bytes(outcome.frames[-1].payload, "little") if isinstance(outcome, Reply) else None


def _product(values: Mapping[int, int]) -> str:
    """Return the product name; empty if it is not text."""
    if any(values.get(register, 0) > 0xFFFF for register in PRODUCT_NAME):
        return ""
    text = b"".join(values.get(register, 0).to_bytes(2, "big") for register in PRODUCT_NAME).rstrip(b"\0 ")
    return text.decode("ascii") if all(byte in range(0x20, 0x7F) for byte in text) else ""


def _status(message: Message) -> int:
    return message.payload[STATUS_AT] if isinstance(message, ReplyFrame) else 0


def _refuse(name: str, outcome: Outcome) -> None:
    """Raise Rejected if the reply contains a status."""
    if isinstance(outcome, Rejection):
        raise Rejected(f"{name}: the device rejected the request with status {_status(outcome.frames[-1])}")


def _value(outcome: Outcome) -> int:
    value: int = LAYOUT.unpack(outcome.frames[-1].payload)[3]
    return value


def change_address(settings: NodeOptions, new: int) -> RequestScript[Written]:
    """Set the address of a device, 1 … 128, and follow the device (`Readdressing.change`)."""
    return set_address(settings.peer, new) if new == settings.address else _readdressing(settings).change(new)


def restart(settings: NodeOptions, bus_bit_s: int) -> RequestScript[str | VerbResult]:
    """Restart the device and follow it to its address (`Readdressing.restart`)."""
    return _readdressing(settings).restart(restart_request(settings.peer), bus_bit_s)


def factory_reset_and_find(settings: NodeOptions) -> RequestScript[str]:
    """Restore the factory settings with address 8 and its bit rate, effective after a restart at the latest.

    Raises BadArgument if another device has address 8, Rejected.
    """
    device = _readdressing(settings)
    yield from device.check_factory()
    yield from factory_reset(settings.peer)
    if settings.address != FACTORY_ADDRESS and (yield from device.heard(FACTORY_ADDRESS)):
        yield device.move(FACTORY_ADDRESS)
        return f"restored, at address {FACTORY_ADDRESS}"
    return f"restored; the device has address {FACTORY_ADDRESS} after the next restart at the latest"


def _readdressing(settings: NodeOptions) -> Readdressing:
    peer, host = settings.peer, settings.host_address
    return Readdressing(
        options=settings,
        present=peer.address,
        noun="address",
        number="address",
        words="at address",
        lost="the device {confirmed}replied neither at address {new} nor at {present}; imud commanded it back",
        factory=FACTORY_ADDRESS,
        valid=range(ADDRESS_MAX + 1),
        registers=(ADDRESS, BITRATE),
        bit_rates=dict(enumerate(BITRATES)),
        boot=filter_of(CLAIMED, None),
        boot_data=None,
        sender_mask=0xFF,
        frames=lambda at: (CanFilter(at, 0xFF, True),),
        describe=lambda can_id: f"PGN {split(can_id).pgn:04X}",
        query=lambda at: exchange(J1939Node(at, host), ADDRESS, READ, READ_VALUE, "").payload,
        write=lambda at, new: _write_address(J1939Node(at, host), new),
        verify=lambda at, new: verify(J1939Node(at, host), ADDRESS, new, "address", pending=at == peer.address),
        read_saved=lambda: read_values(peer, (ADDRESS, BITRATE)),
    )


def _write_address(peer: J1939Node, value: int) -> RequestScript[bool]:
    """Write the address register. Return whether the device confirmed it. Raises Rejected."""
    also = tuple(CanFilter(one, WITHOUT_PRIORITY, True) for one in sorted(peer.reply_ids()))
    outcome = yield exchange(peer, ADDRESS, WRITE, value, f"address {value}", also=also)
    _refuse(f"address {value}", outcome)
    return isinstance(outcome, Reply)
