"""Request scripts of a HiPNUC module on CANopen: identity, settings, and every command of its manual.

Manual "IMU配置手冊" V1.5.9, section 5.4; objects of CiA 301 where it names none. Settings last until power is off
unless `save` follows. TPDO rate and type, inclinometer signs and zero apply at once; node number and bit rate need
`save` and a restart. All raise NoReply and Aborted; ranges of arguments are those of the actions (`actions.py`), and
what no range can express raises BadArgument here.

The manual names no object that can be read. What is written is read back all the same; a node that does not answer
reads, or refuses them, has then taken the value as far as it confirmed the write: `Written.UNVERIFIED`. Where a node is
after its number was written, or after a restart, is in `moves.py`.
"""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Final, Literal

from msgspec.structs import replace

from imud.contracts.driver import Identity
from imud.contracts.script import Message, Reply, ReplyFrame, Request, RequestScript, never
from imud.contracts.setting import Written
from imud.drivers.hipnuc.canopen.cia301 import (
    EMERGENCY,
    FLASH_TIMEOUT_NS,
    FUNCTION_MASK,
    HEARTBEAT,
    NMT,
    NODE_DEFAULT,
    NODE_MASK,
    NODE_MAX,
    SDO_REPLY,
    SDO_REQUEST,
    TIMEOUT_NS,
    TPDO_FUNCTIONS,
    Aborted,
    NmtCommand,
    NmtState,
    TpdoNumber,
    read_frame,
    read_object,
    state_name,
    write_frame,
    write_object,
)
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.formats.can import STANDARD_ID_MAX, CanFilter, pack_frame
from imud.model.errors import BadArgument, DeviceRefused, NoReply
from imud.model.units import NS_PER_MS, NS_PER_S

DEVICE_TYPE: Final = 0x1000
DEVICE_NAME: Final = 0x1008
HEARTBEAT_TIME: Final = 0x1017
IDENTITY: Final = 0x1018
IDENTITY_SUBS: Final = {1: "vendor id", 2: "product code", 3: "revision", 4: "serial number"}
TPDO_OBJECTS: Final = {number: 0x1800 + place for place, number in enumerate(TPDO_FUNCTIONS)}
"""Communication parameters by the TPDO's number: TPDO6 is 0x1804, TPDO7 is 0x1805 (ERRATA B18)."""
TPDO_TYPE: Final = 2
TPDO_TIMER: Final = 5
CONTROL: Final = 0x2000
BIT_RATE: Final = 0x209A
INCLI_SIGN_X: Final = 0x209E
INCLI_SIGN_Y: Final = 0x209F
NODE_ID: Final = 0x20A0
INCLI_ZERO: Final = 0x20A5

BitRate = Literal[1_000_000, 500_000, 250_000, 125_000]
BIT_RATES: Final[Mapping[int, int]] = {1_000_000: 0, 500_000: 2, 250_000: 3, 125_000: 4}
"""Codes of 0x209A by bit/s; 1 is not given."""
BIT_RATE_OF: Final = {code: bit_s for bit_s, code in BIT_RATES.items()}
Place = tuple[int, int]
"""Index and sub-index of an object."""
SETTING_PLACES: Final[tuple[Place, ...]] = (
    *((index, sub) for index in TPDO_OBJECTS.values() for sub in (TPDO_TYPE, TPDO_TIMER)),
    *((index, 0) for index in (NODE_ID, BIT_RATE, INCLI_SIGN_X, INCLI_SIGN_Y, HEARTBEAT_TIME)),
)
"""Objects that can be set and that may be readable."""
PERIOD_MIN_MS, PERIOD_MAX_MS = 5, 1000
"""200 Hz … 1 Hz for each TPDO (section 5.1)."""
SAVE, FACTORY_RESET, RESTART = 0x00, 0x01, 0xFF
HEARTBEAT_WAIT_NS: Final = 3 * NS_PER_S // 2


class Transmission(Enum):
    """Transmission types of a TPDO (sub-index 2 of its parameters)."""

    SYNC = 0x01
    """On each SYNC."""
    TIMER_MANUFACTURER = 0xFE
    """By its own timer (the table of section 5.2)."""
    TIMER = 0xFF
    """By its own timer, as delivered (section 5.4.2)."""


class InclinometerZero(Enum):
    """Operations on the zero of the inclinometer."""

    SET = 2
    """The present position reads 0, 0."""
    CANCEL = 5
    """Back to the true angles."""


# --- reading ----------------------------------------------------------------------------------------------------------


def identify(node: int) -> RequestScript[Identity]:
    """Read the identity of a node (0x1000, 0x1008, 0x1018); missing objects stay empty. Raises NoReply."""
    details: dict[str, str] = {}
    device_type = yield from _try_read(node, DEVICE_TYPE, 0)
    if device_type is not None:
        details["device type"] = f"0x{_number(device_type):08X}"
    name = yield from _try_read(node, DEVICE_NAME, 0)
    for sub, title in IDENTITY_SUBS.items():
        value = yield from _try_read(node, IDENTITY, sub)
        if value is not None:
            details[title] = f"0x{_number(value):08X}"
    state = yield from _heartbeat_state(node)
    if state:
        details["NMT state"] = state
    product = "" if name is None else name.rstrip(b"\0 ").decode("ascii", "replace")
    return Identity(product, details.get("serial number", ""), details.get("revision", ""), details)


def read_settings(node: int) -> RequestScript[Mapping[str, str]]:
    """Ask for all settings by their object and sub-index; those that cannot be read are left out. Raises NoReply."""
    values = yield from read_values(node, SETTING_PLACES)
    return {f"{index:04X}.{sub}": str(value) for (index, sub), value in values.items()}


def read_values(node: int, places: Sequence[Place], *, silent_is_fine: bool = False) -> RequestScript[dict[Place, int]]:
    """Read objects as numbers; those that the node refuses to read are left out.

    Raises NoReply; with `silent_is_fine` what comes after a first missing reply is left out instead.
    """
    values: dict[Place, int] = {}
    for index, sub in places:
        try:
            value = yield from _try_read(node, index, sub)
        except NoReply:
            if silent_is_fine:
                return values
            raise
        if value is not None:
            values[index, sub] = _number(value)
    return values


def _heartbeat_state(node: int) -> RequestScript[str]:
    """State in a node's heartbeat while it sends no TPDOs; empty for one that sends, or is not heard."""
    period = yield from _try_read(node, HEARTBEAT_TIME, 0)
    if period is None or not _number(period):
        return ""
    wait_ns = min(_number(period) * NS_PER_MS * 5 // 4 + TIMEOUT_NS // 5, HEARTBEAT_WAIT_NS)
    outcome = yield Request(b"", f"node {node}, heartbeat", _is_heartbeat(node), never, never, wait_ns)
    return state_name(outcome.frames[-1].payload[0]) if isinstance(outcome, Reply) else ""


# --- setting ----------------------------------------------------------------------------------------------------------


def set_node_id(node: int, new_node: int) -> RequestScript[Written]:
    """Give the node another number, 1 … 127; in force after `save` and a restart."""
    return (yield from _set(node, NODE_ID, 0, new_node, 4, pending=True))


def set_bit_rate(node: int, bit_s: BitRate) -> RequestScript[Written]:
    """Set the rate of the bus in bit/s; in force after `save` and a restart."""
    return (yield from _set(node, BIT_RATE, 0, BIT_RATES[bit_s], 4, pending=True))


def set_tpdo_period(node: int, tpdo: TpdoNumber, period_ms: int) -> RequestScript[Written]:
    """Send a TPDO every 5 … 1000 ms by its timer, or never (0); at once. Raises BadArgument for 1 … 4."""
    check_period(period_ms)
    return (yield from _set(node, TPDO_OBJECTS[tpdo], TPDO_TIMER, period_ms, 2))


def check_period(period_ms: int) -> None:
    """Raises BadArgument for a period between never and the shortest."""
    if 0 < period_ms < PERIOD_MIN_MS:
        raise BadArgument(f"interval_ms: expected 0 or {PERIOD_MIN_MS} … {PERIOD_MAX_MS}, got {period_ms}")


def set_tpdo_type(node: int, tpdo: TpdoNumber, transmission: Transmission) -> RequestScript[Written]:
    """Send a TPDO by its timer, or when SYNC comes; at once."""
    return (yield from _set(node, TPDO_OBJECTS[tpdo], TPDO_TYPE, transmission.value, 1))


def set_inclinometer_sign(node: int, axis: Literal["x", "y"], *, invert: bool) -> RequestScript[Written]:
    """Turn the sign of one axis of the inclinometer around, or leave it as delivered; at once."""
    return (yield from _set(node, INCLI_SIGN_X if axis == "x" else INCLI_SIGN_Y, 0, int(invert), 4))


def set_inclinometer_signs(node: int, *, invert_x: bool, invert_y: bool) -> RequestScript[Written]:
    """Set the signs of both axes; at once."""
    x = yield from set_inclinometer_sign(node, "x", invert=invert_x)
    y = yield from set_inclinometer_sign(node, "y", invert=invert_y)
    return Written.VERIFIED if x is y is Written.VERIFIED else Written.UNVERIFIED


def set_heartbeat(node: int, period_ms: int) -> RequestScript[Written]:
    """Send the heartbeat of CiA 301 every so many ms, or never (0); at once. The manual does not name the object."""
    return (yield from _set(node, HEARTBEAT_TIME, 0, period_ms, 2))


def set_inclinometer_zero(node: int, zero: InclinometerZero) -> RequestScript[None]:
    """Make the present position the inclinometer's zero, or cancel that; at once."""
    yield from write_object(node, INCLI_ZERO, 0, zero.value, 4)


def save(node: int) -> RequestScript[None]:
    """Write all settings to flash."""
    yield from write_object(node, CONTROL, 0, SAVE, 4, timeout_ns=FLASH_TIMEOUT_NS)


def factory_reset(node: int) -> RequestScript[None]:
    """Restore the factory settings, node number and bit rate included; in force after the next power-on."""
    yield from write_object(node, CONTROL, 0, FACTORY_RESET, 4, timeout_ns=FLASH_TIMEOUT_NS)


def restart_request(node: int) -> Request:
    """The request for a restart, as by power-on. Whether it is confirmed is not stated, so no reply is waited for."""
    frame = write_frame(CONTROL, 0, RESTART.to_bytes(4, "little"))
    payload = pack_frame(SDO_REQUEST + node, False, frame)
    return Request(payload, f"node {node}, restart", never, never, never, silent=True)


def nmt(node: int, command: NmtCommand) -> RequestScript[None]:
    """Send an NMT command, which no node confirms. What follows a reset is for `moves.reset`."""
    yield nmt_request(node, command)


def nmt_request(node: int, command: NmtCommand) -> Request:
    """The request of an NMT command."""
    payload = pack_frame(NMT, False, bytes([command.value, node]))
    return Request(payload, f"node {node}, NMT {command.name}", never, never, never, silent=True)


def _set(node: int, index: int, sub: int, value: int, size: int, *, pending: bool = False) -> RequestScript[Written]:
    """Write, and read back where that is possible. Raises DeviceRefused where something else stands there then."""
    yield from write_object(node, index, sub, value, size)
    return (yield from verify(node, index, sub, value, pending=pending))


def verify(node: int, index: int, sub: int, value: int, *, pending: bool = False) -> RequestScript[Written]:
    """Read back what was written. Raises DeviceRefused where something else stands there."""
    try:
        found = yield from _try_read(node, index, sub)
    except NoReply:
        found = None
    if found is None:
        return Written.UNVERIFIED_PENDING if pending else Written.UNVERIFIED
    if _number(found) != value:
        raise DeviceRefused(f"node {node}: expected 0x{index:04X}.{sub} = {value}, reads back {_number(found)}")
    return Written.PENDING if pending else Written.VERIFIED


def _try_read(node: int, index: int, sub: int) -> RequestScript[bytes | None]:
    """Bytes of an object; None where the node has none, or refuses to read it. Raises NoReply."""
    try:
        return (yield from read_object(node, index, sub))
    except Aborted:
        return None


def _number(value: bytes) -> int:
    return int.from_bytes(value, "little")


def _is_heartbeat(node: int) -> Callable[[Message], bool]:
    """A test for heartbeats of a node."""
    can_id = HEARTBEAT + node
    return lambda message: isinstance(message, ReplyFrame) and message.frame_id == can_id


SENT_BY_NODE: Final = frozenset({*TPDO_FUNCTIONS.values(), SDO_REPLY, HEARTBEAT, EMERGENCY})
"""Functions of frames that a node itself sends."""
LISTEN_NS: Final = 1100 * NS_PER_MS
"""A TPDO comes at least once a second (section 5.1)."""
BOOT_NS: Final = 3 * NS_PER_S
"""Longest time to the boot-up message; the manual gives none."""
ALL_BOOTS: Final = (CanFilter(HEARTBEAT, FUNCTION_MASK, False),)


def change_node(settings: HipnucCanopenOptions, new: int) -> RequestScript[Written]:
    """Give a node another number, 1 … 127, and follow it where that is in force at once.

    Raises BadArgument for a number that is heard on the bus, DeviceRefused, Aborted, and NoReply for a node that is
    heard at neither number afterwards; it is commanded to go back then.
    """
    node = settings.node
    if new == node:
        return (yield from set_node_id(node, new))
    if heard := (yield from _heard(new)):
        raise BadArgument(f"node {new} is taken: frame 0x{heard:03X} of it is on the bus")
    first = yield from _write_number(node, new)
    again = yield from _write_number(node, new)
    if again:
        return (yield from verify(node, NODE_ID, 0, new, pending=True))
    if (yield from _write_number(new, new)):
        yield _follow(settings, new)
        return (yield from verify(new, NODE_ID, 0, new))
    yield Request(
        _number_frame(new, node), f"node {new}, back to number {node}", never, never, never, silent=True
    )  # in case it is there and could not answer
    confirmed = "confirmed the write and " if first else ""
    raise NoReply(f"the node {confirmed}answers neither as node {new} nor as node {node}: it was commanded to go back")


def restart(settings: HipnucCanopenOptions, bus_bit_s: int) -> RequestScript[str]:
    """Restart, as by power-on, and follow the node to the number that it has then; return what became of it.

    `bus_bit_s` is the rate of the bus, 0 where it is not known. Raises NoReply for a node that is not heard afterwards.
    """
    return (yield from _reset(settings, bus_bit_s, restart_request(settings.node)))


def reset(settings: HipnucCanopenOptions, bus_bit_s: int, command: NmtCommand) -> RequestScript[str]:
    """The same by an NMT command that resets."""
    return (yield from _reset(settings, bus_bit_s, nmt_request(settings.node, command)))


def factory_reset_and_find(settings: HipnucCanopenOptions) -> RequestScript[str]:
    """Restore the factory settings, in force after a restart: node 8 and 500 kbit/s.

    Raises BadArgument where another node has number 8, Aborted, NoReply.
    """
    if settings.node != NODE_DEFAULT and (yield from _heard(NODE_DEFAULT)):
        raise BadArgument(f"node {NODE_DEFAULT} is taken: the factory's number is that of another node on the bus")
    yield from factory_reset(settings.node)
    return f"restored; it is node {NODE_DEFAULT} at 500 kbit/s after the next restart"


def _reset(settings: HipnucCanopenOptions, bus_bit_s: int, request: Request) -> RequestScript[str]:
    node = settings.node
    saved = yield from read_values(node, ((NODE_ID, 0), (BIT_RATE, 0)), silent_is_fine=True)
    number = saved.get((NODE_ID, 0), node)
    if not 1 <= number <= NODE_MAX:  # no number of a node: it will stay where it is
        number = node
    rate = BIT_RATE_OF.get(saved.get((BIT_RATE, 0), -1), bus_bit_s)
    places = tuple(dict.fromkeys((node, number)))
    booted = yield from _boot(request, (*places, NODE_DEFAULT) if saved else None)
    if booted is None:
        booted = yield from _find(places)
    if booted is None:
        if bus_bit_s and rate != bus_bit_s:
            return f"restarted; it has {rate} bit/s now, which this bus has not"
        words = " or ".join(map(str, places))
        raise NoReply(f"nothing is heard of node {words} after the restart: has it another bit rate now?")
    if booted != node:
        yield _follow(settings, booted)
    return f"restarted, as node {booted}"


def _boot(request: Request, numbers: Sequence[int] | None) -> RequestScript[int | None]:
    """Send a request that restarts the node; return the number in its boot-up message. `numbers`: None for any."""

    def ends(message: Message) -> bool:
        is_boot = isinstance(message, ReplyFrame) and message.payload == bytes([NmtState.BOOT_UP.value])
        return is_boot and _is_of(message, HEARTBEAT) and (numbers is None or _number_of(message) in numbers)

    outcome = yield Request(request.payload, request.name, ends, never, never, BOOT_NS, also=ALL_BOOTS)
    return _number_of(outcome.frames[-1]) if isinstance(outcome, Reply) else None


def _find(numbers: Sequence[int]) -> RequestScript[int | None]:
    """The first of some numbers of which anything is heard."""
    for number in numbers:
        if (yield from _heard(number)):
            return number
    return None


def _heard(node: int) -> RequestScript[int]:
    """Ask a node for its device type, and return the identifier of the first frame that it sends, of any kind; 0 for
    none."""
    also = tuple(CanFilter(function + node, STANDARD_ID_MAX, False) for function in sorted(SENT_BY_NODE))
    payload = pack_frame(SDO_REQUEST + node, False, read_frame(DEVICE_TYPE, 0))
    outcome = yield Request(payload, f"node {node}, is it there", _is_from(node), never, never, LISTEN_NS, also=also)
    return outcome.frames[-1].frame_id if isinstance(outcome, Reply) else 0


def _write_number(node: int, value: int) -> RequestScript[bool]:
    """Write the object of the number, and return whether that node confirmed it. Raises Aborted."""
    also = (CanFilter(SDO_REPLY + node, STANDARD_ID_MAX, False),)
    try:
        yield from write_object(node, NODE_ID, 0, value, 4, also=also)
    except NoReply:
        return False
    return True


def _number_frame(node: int, value: int) -> bytes:
    return pack_frame(SDO_REQUEST + node, False, write_frame(NODE_ID, 0, value.to_bytes(4, "little")))


def _follow(settings: HipnucCanopenOptions, node: int) -> Request:
    """Listen to the node under another number from now on."""
    moved = replace(settings, node=node)
    return Request(b"", f"node {settings.node}, now {node}", never, never, never, silent=True, settings=moved)


def _is_from(node: int) -> Callable[[Message], bool]:
    return lambda message: (
        isinstance(message, ReplyFrame)
        and message.frame_id & NODE_MASK == node
        and message.frame_id & FUNCTION_MASK in SENT_BY_NODE
    )


def _is_of(message: Message, function: int) -> bool:
    return isinstance(message, ReplyFrame) and message.frame_id & FUNCTION_MASK == function


def _number_of(message: Message) -> int:
    return message.frame_id & NODE_MASK if isinstance(message, ReplyFrame) else 0
