"""CANopen by CiA 301: identifiers, network management (NMT), and expedited SDO of a client.

An identifier is a function (upper four bits) plus the node number. NMT and SYNC are functions of the complete bus.
Manual "IMU配置手冊" V1.5.9, section 5.2:

    NMT 0x000   SYNC 0x080   EMCY 0x080+n   SDO reply 0x580+n   SDO request 0x600+n   heartbeat 0x700+n
    TPDO1 0x180+n   TPDO2 0x280+n   TPDO3 0x380+n   TPDO4 0x480+n   TPDO6 0x680+n   TPDO7 0x780+n

The vendor chose the identifiers of TPDO6 and TPDO7. They do not collide with the identifiers of CiA 301.

Expedited SDO: CiA 301, section 7.2.4.3, and manual section 5.4.1.

    ┌─────────┬───────────┬──────────┬───────────────┐    request  0x600 + node
    │ command │ index u16 │ sub u8   │ data, 4 bytes │    reply    0x580 + node
    └─────────┴───────────┴──────────┴───────────────┘    little-endian

    write 1, 2, 3, 4 bytes   0x2F 0x2B 0x27 0x23   →   0x60
    read                     0x40                  →   0x4F 0x4B 0x47 0x43 (1, 2, 3, 4 bytes), 0x42 (no length given)
    abort, both ways         0x80, data: u32 code

A node sends a longer value in segments (0x41, 0x40). imud aborts such a transfer and treats the value as unreadable.
"""

from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from typing import Final, Literal

from imud.contracts.script import Message, Outcome, Rejection, ReplyFrame, Request, RequestScript, Silence, never
from imud.formats.can import CanFilter, pack_frame
from imud.model.errors import NoReply, Rejected
from imud.model.units import NS_PER_S

TpdoNumber = Literal[1, 2, 3, 4, 6, 7]
NODE_MAX: Final = 127
NODE_DEFAULT: Final = 8
NODE_MASK: Final = 0x7F
FUNCTION_MASK: Final = 0x780

NMT: Final = 0x000
SYNC: Final = 0x080
EMERGENCY: Final = 0x080
SDO_REPLY: Final = 0x580
SDO_REQUEST: Final = 0x600
HEARTBEAT: Final = 0x700
# Function of each TPDO, by its number
TPDO_FUNCTIONS: Final = {1: 0x180, 2: 0x280, 3: 0x380, 4: 0x480, 6: 0x680, 7: 0x780}


class NmtCommand(Enum):
    """Commands of the network management: one byte, followed by the node number (CiA 301, 7.2.8.2)."""

    START = 0x01  # operational: the node sends TPDOs
    STOP = 0x02  # only NMT and heartbeat work
    PRE_OPERATIONAL = 0x80  # SDO works, TPDOs do not
    RESET_NODE = 0x81  # restart, as after power-on
    RESET_COMMUNICATION = 0x82  # restart of the communication with the saved values


class NmtState(Enum):
    """States in a heartbeat (CiA 301, 7.2.8.3.2.2)."""

    BOOT_UP = 0x00  # sent once after a restart
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def state_name(code: int) -> str:
    """Return the name of a state, for example `pre-operational`; the number of an unknown state."""
    try:
        return NmtState(code).name.lower().replace("_", "-")
    except ValueError:
        return f"unknown (0x{code:02X})"


SDO_BYTES: Final = 8
DEVICE_TYPE: Final = 0x1000  # index of the object that every node has
READ: Final = 0x40
WRITE: Final = {1: 0x2F, 2: 0x2B, 3: 0x27, 4: 0x23}
WRITTEN: Final = 0x60
READ_SIZES: Final = {0x4F: 1, 0x4B: 2, 0x47: 3, 0x43: 4, 0x42: 4}
READ_SEGMENTED: Final = (0x40, 0x41)
ABORT: Final = 0x80
TIMEOUT_NS: Final = NS_PER_S // 2
FLASH_TIMEOUT_NS: Final = (
    2 * NS_PER_S
)  # longer than a reply because the node erases a flash page; the manual states no time
ABORT_UNSUPPORTED: Final = 0x0504_0001

# Meanings of the SDO abort codes (CiA 301, table 22)
ABORT_TEXTS: Final = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO protocol timed out",
    0x0504_0001: "command specifier not valid or unknown",
    0x0504_0002: "invalid block size",
    0x0504_0003: "invalid sequence number",
    0x0504_0004: "CRC error",
    0x0504_0005: "out of memory",
    0x0601_0000: "unsupported access to an object",
    0x0601_0001: "attempt to read a write-only object",
    0x0601_0002: "attempt to write a read-only object",
    0x0602_0000: "object does not exist in the object dictionary",
    0x0604_0041: "object cannot be mapped to the PDO",
    0x0604_0042: "number and length of the objects to be mapped would exceed the PDO length",
    0x0604_0043: "general parameter incompatibility",
    0x0604_0047: "general internal incompatibility in the device",
    0x0606_0000: "access failed due to a hardware error",
    0x0607_0010: "data type does not match: length of the parameter does not match",
    0x0607_0012: "data type does not match: parameter too long",
    0x0607_0013: "data type does not match: parameter too short",
    0x0609_0011: "sub-index does not exist",
    0x0609_0030: "invalid value for the parameter",
    0x0609_0031: "value written too high",
    0x0609_0032: "value written too low",
    0x0609_0036: "maximum value is less than minimum value",
    0x060A_0023: "resource not available: SDO connection",
    0x0800_0000: "general error",
    0x0800_0020: "data cannot be transferred or stored to the application",
    0x0800_0021: "data cannot be transferred or stored because of local control",
    0x0800_0022: "data cannot be transferred or stored because of the present device state",
    0x0800_0023: "object dictionary not present, or its generation failed",
    0x0800_0024: "no data available",
}


class Aborted(Rejected):
    """SDO transfer that the node aborted. Example: the object does not exist in its dictionary."""

    def __init__(self, name: str, code: int) -> None:
        super().__init__(f"{name}: the node rejected the request: {abort_text(code)} (0x{code:08X})")
        self.code = code


def abort_text(code: int) -> str:
    """Return the meaning of an abort code."""
    return ABORT_TEXTS.get(code, "unknown abort code")


def write_frame(index: int, sub: int, data: bytes) -> bytes:
    """Return the data of a request that writes 1 … 4 bytes. Raises KeyError for another length."""
    return bytes([WRITE[len(data)]]) + _address(index, sub) + data.ljust(4, b"\0")


def read_frame(index: int, sub: int) -> bytes:
    """Return the data of a read request."""
    return bytes([READ]) + _address(index, sub) + bytes(4)


def abort_frame(index: int, sub: int, code: int) -> bytes:
    """Return the data of a frame that aborts a transfer."""
    return bytes([ABORT]) + _address(index, sub) + code.to_bytes(4, "little")


def value_of(data: bytes) -> bytes | None:
    """Return the value in the reply to a read; None if the node sends it in segments."""
    size = READ_SIZES.get(data[0])
    return None if size is None else data[4 : 4 + size]


def read_object(node: int, index: int, sub: int) -> RequestScript[bytes | None]:
    """Read an object. Return its bytes, or None if it has more than four bytes. Raises Aborted, NoReply."""
    request = _read_request(node, index, sub)
    name = request.name
    data = _reply(name, (yield request))
    value = value_of(data)
    if value is None:
        payload = pack_frame(SDO_REQUEST + node, False, abort_frame(index, sub, ABORT_UNSUPPORTED))
        yield Request(payload, f"{name}, abort", never, never, never, silent=True)
    return value


def write_object(
    node: int,
    index: int,
    sub: int,
    value: int,
    size: int,
    *,
    timeout_ns: int = TIMEOUT_NS,
    also: tuple[CanFilter, ...] = (),
) -> RequestScript[None]:
    """Write an unsigned object of 1 … 4 bytes. `also`: filters for replies of another node. Raises Aborted, NoReply."""
    name = f"node {node}, write 0x{index:04X}.{sub} = {value}"
    ends = answers(node, index, sub, (WRITTEN,))
    frame = write_frame(index, sub, value.to_bytes(size, "little"))
    request = replace(_request(node, name, frame, ends, index, sub), timeout_ns=timeout_ns, also=also)
    _reply(name, (yield request))


def _request(node: int, name: str, frame: bytes, ends: Callable[[Message], bool], index: int, sub: int) -> Request:
    refuses = answers(node, index, sub, (ABORT,))
    reads = frame[0] == READ
    kind = f"node {node}, 0x{index:04X}.{sub}"  # an abort does not contain the direction of the transfer
    payload = pack_frame(SDO_REQUEST + node, False, frame)
    probe = None if (index, sub) == (DEVICE_TYPE, 0) else _read_request(node, DEVICE_TYPE, 0)
    return Request(payload, name, ends, refuses, never, TIMEOUT_NS, kind=kind, repeatable=reads, probe=probe)


def _read_request(node: int, index: int, sub: int) -> Request:
    ends = answers(node, index, sub, (*READ_SIZES, *READ_SEGMENTED))
    return _request(node, f"node {node}, read 0x{index:04X}.{sub}", read_frame(index, sub), ends, index, sub)


def _reply(name: str, outcome: Outcome) -> bytes:
    """Return the data of the reply. Raises Aborted, NoReply."""
    if isinstance(outcome, Silence):
        raise NoReply(f"{name}: expected a reply, got none; check the node number and that the node is not stopped")
    data = outcome.frames[-1].payload
    if isinstance(outcome, Rejection):
        raise Aborted(name, int.from_bytes(data[4:], "little"))
    return data


def answers(node: int, index: int, sub: int, commands: tuple[int, ...]) -> Callable[[Message], bool]:
    """Return a test for replies of this node about this object with one of these commands."""
    can_id, address = SDO_REPLY + node, _address(index, sub)

    def holds(message: Message) -> bool:
        if not isinstance(message, ReplyFrame) or message.frame_id != can_id or len(message.payload) != SDO_BYTES:
            return False
        return message.payload[0] in commands and message.payload[1:4] == address

    return holds


def _address(index: int, sub: int) -> bytes:
    return index.to_bytes(2, "little") + bytes([sub])
