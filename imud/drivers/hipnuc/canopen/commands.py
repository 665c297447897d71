"""Request scripts of a HiPNUC device on CANopen: identity, settings, and every command of its manual.

Manual "IMU配置手冊" V1.5.9, section 5.4; otherwise objects of CiA 301. Settings are lost at power-off unless `save`
follows. TPDO rate and type, inclinometer signs and zero take effect immediately; node number and bit rate after `save`
and a restart. All scripts raise NoReply and Aborted. The verbs in `driver.py` check the ranges of arguments; other
rules raise BadArgument here.

The manual names no readable object. imud reads back every written value. If the node does not support the read, the
confirmation of the write is the only evidence: `Written.UNVERIFIED`.
"""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Final, Literal

from imud.contracts.command import VerbResult
from imud.contracts.driver import Identity
from imud.contracts.script import Message, Reply, ReplyFrame, Request, RequestScript, never
from imud.contracts.setting import Written
from imud.drivers.hipnuc.canopen.cia301 import (
    ABORT,
    DEVICE_TYPE,
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
    answers,
    read_frame,
    read_object,
    state_name,
    write_frame,
    write_object,
)
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.readdressing import Readdressing
from imud.formats.can import STANDARD_ID_MAX, CanFilter, pack_frame
from imud.model.errors import BadArgument, NoReply, NotApplied
from imud.model.units import NS_PER_MS, NS_PER_S

DEVICE_NAME: Final = 0x1008
HEARTBEAT_TIME: Final = 0x1017
IDENTITY: Final = 0x1018
IDENTITY_SUBS: Final = {1: "vendor id", 2: "product code", 3: "revision", 4: "serial number"}
# Communication parameters by TPDO number: TPDO6 is 0x1804, TPDO7 is 0x1805 (ERRATA B18)
TPDO_OBJECTS: Final = {number: 0x1800 + place for place, number in enumerate(TPDO_FUNCTIONS)}
TPDO_TYPE: Final = 2
TPDO_TIMER: Final = 5
CONTROL: Final = 0x2000
BIT_RATE: Final = 0x209A
INCLI_SIGN_X: Final = 0x209E
INCLI_SIGN_Y: Final = 0x209F
NODE_ID: Final = 0x20A0
INCLI_ZERO: Final = 0x20A5

BitRate = Literal[1_000_000, 500_000, 250_000, 125_000]
# Code of 0x209A for each bit rate, bit/s; the manual omits code 1
BIT_RATES: Final[Mapping[int, int]] = {1_000_000: 0, 500_000: 2, 250_000: 3, 125_000: 4}
BIT_RATE_OF: Final = {code: bit_s for bit_s, code in BIT_RATES.items()}
Place = tuple[int, int]  # index and sub-index of an object
# Writable objects that may be readable.
SETTING_PLACES: Final[tuple[Place, ...]] = (
    *((index, sub) for index in TPDO_OBJECTS.values() for sub in (TPDO_TYPE, TPDO_TIMER)),
    *((index, 0) for index in (NODE_ID, BIT_RATE, INCLI_SIGN_X, INCLI_SIGN_Y, HEARTBEAT_TIME)),
)
# 200 Hz … 1 Hz for each TPDO (section 5.1)
PERIOD_MIN_MS, PERIOD_MAX_MS = 5, 1000
SAVE, FACTORY_RESET, RESTART = 0x00, 0x01, 0xFF
HEARTBEAT_WAIT_NS: Final = 3 * NS_PER_S // 2


class Transmission(Enum):
    """Transmission types of a TPDO (sub-index 2 of its parameters)."""

    SYNC = 0x01  # at each SYNC
    TIMER_MANUFACTURER = 0xFE  # by its own timer (table of section 5.2)
    TIMER = 0xFF  # by its own timer, factory value (section 5.4.2)


class InclinometerZero(Enum):
    """Operations on the zero of the inclinometer."""

    SET = 2  # the present position reads 0, 0
    CANCEL = 5  # back to the true angles


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


def read_values(node: int, places: Sequence[Place], *, silent_is_fine: bool = False) -> RequestScript[dict[Place, int]]:
    """Read objects as numbers, without objects that the node does not read.

    The result is empty if the node does not reply to the first read: such a node ignores reads. Raises NoReply for
    another missing reply. With `silent_is_fine`, the script ends there and does not raise.
    """
    values: dict[Place, int] = {}
    for index, sub in places:
        try:
            value = yield from _try_read(node, index, sub)
        except NoReply:
            if silent_is_fine or (index, sub) == places[0]:
                return values
            raise
        if value is not None:
            values[index, sub] = _number(value)
    return values


def _heartbeat_state(node: int) -> RequestScript[str]:
    """Return the state in the heartbeat of a node that sends no TPDOs; empty without a heartbeat."""
    period = yield from _try_read(node, HEARTBEAT_TIME, 0)
    if period is None or not _number(period):
        return ""
    wait_ns = min(_number(period) * NS_PER_MS * 5 // 4 + TIMEOUT_NS // 5, HEARTBEAT_WAIT_NS)
    outcome = yield Request(b"", f"node {node}, heartbeat", _is_heartbeat(node), never, never, wait_ns)
    return state_name(outcome.frames[-1].payload[0]) if isinstance(outcome, Reply) else ""


# --- setting ----------------------------------------------------------------------------------------------------------


def set_node_id(node: int, new_node: int) -> RequestScript[Written]:
    """Set the node number, 1 … 127; effective after `save` and a restart."""
    return (yield from _set(node, NODE_ID, 0, new_node, 4, pending=True))


def set_bit_rate(node: int, bit_s: BitRate) -> RequestScript[Written]:
    """Set the bit rate of the bus; effective after `save` and a restart."""
    return (yield from _set(node, BIT_RATE, 0, BIT_RATES[bit_s], 4, pending=True))


def set_tpdo_period(node: int, tpdo: TpdoNumber, period_ms: int) -> RequestScript[Written]:
    """Set the timer of a TPDO, 5 … 1000 ms, or 0: never; effective immediately. Raises BadArgument for 1 … 4."""
    check_period(period_ms)
    return (yield from _set(node, TPDO_OBJECTS[tpdo], TPDO_TIMER, period_ms, 2))


def check_period(period_ms: int) -> None:
    """Raise BadArgument for a period between 0 and the minimum."""
    if 0 < period_ms < PERIOD_MIN_MS:
        raise BadArgument(f"interval_ms: expected 0 or {PERIOD_MIN_MS} … {PERIOD_MAX_MS}, got {period_ms}")


def set_tpdo_type(node: int, tpdo: TpdoNumber, transmission: Transmission) -> RequestScript[Written]:
    """Send a TPDO by its timer, or at each SYNC; effective immediately."""
    return (yield from _set(node, TPDO_OBJECTS[tpdo], TPDO_TYPE, transmission.value, 1))


def set_inclinometer_sign(node: int, axis: Literal["x", "y"], *, invert: bool) -> RequestScript[Written]:
    """Set the sign of one axis of the inclinometer; effective immediately."""
    return (yield from _set(node, INCLI_SIGN_X if axis == "x" else INCLI_SIGN_Y, 0, int(invert), 4))


def set_heartbeat(node: int, period_ms: int) -> RequestScript[Written]:
    """Set the interval of the heartbeat of CiA 301, ms; 0: never; effective immediately. Not in the manual."""
    return (yield from _set(node, HEARTBEAT_TIME, 0, period_ms, 2))


def set_inclinometer_zero(node: int, zero: InclinometerZero) -> RequestScript[None]:
    """Make the present position the zero of the inclinometer, or cancel it; effective immediately."""
    yield from write_object(node, INCLI_ZERO, 0, zero.value, 4)


def save(node: int) -> RequestScript[None]:
    """Write all settings to flash."""
    yield from write_object(node, CONTROL, 0, SAVE, 4, timeout_ns=FLASH_TIMEOUT_NS)


def factory_reset(node: int) -> RequestScript[None]:
    """Restore the factory settings with node number and bit rate; effective after the next power-on."""
    yield from write_object(node, CONTROL, 0, FACTORY_RESET, 4, timeout_ns=FLASH_TIMEOUT_NS)


def restart_request(node: int) -> Request:
    """Return the request for a restart, as after power-on."""
    # silent: the manual does not state whether the node confirms it
    frame = write_frame(CONTROL, 0, RESTART.to_bytes(4, "little"))
    payload = pack_frame(SDO_REQUEST + node, False, frame)
    return Request(payload, f"node {node}, restart", never, answers(node, CONTROL, 0, (ABORT,)), never, silent=True)


def nmt(node: int, command: NmtCommand) -> RequestScript[None]:
    """Send an NMT command, which no node confirms. `reset` follows the node after a reset."""
    yield nmt_request(node, command)


def nmt_request(node: int, command: NmtCommand) -> Request:
    payload = pack_frame(NMT, False, bytes([command.value, node]))
    return Request(payload, f"node {node}, NMT {command.name}", never, never, never, silent=True)


def _set(node: int, index: int, sub: int, value: int, size: int, *, pending: bool = False) -> RequestScript[Written]:
    """Write an object and read it back if possible. Raises DeviceRefused if the value differs."""
    yield from write_object(node, index, sub, value, size)
    return (yield from verify(node, index, sub, value, pending=pending))


def verify(node: int, index: int, sub: int, value: int, *, pending: bool = False) -> RequestScript[Written]:
    """Read back a written value. Raises DeviceRefused if it differs."""
    try:
        found = yield from _try_read(node, index, sub)
    except NoReply:
        found = None
    if found is None:
        return Written.UNVERIFIED_PENDING if pending else Written.UNVERIFIED
    if _number(found) != value:
        raise NotApplied(f"node {node}: expected 0x{index:04X}.{sub} = {value} after the write, got {_number(found)}")
    return Written.PENDING if pending else Written.VERIFIED


def _try_read(node: int, index: int, sub: int) -> RequestScript[bytes | None]:
    """Return the bytes of an object; None if the node lacks it or rejects the read. Raises NoReply."""
    try:
        return (yield from read_object(node, index, sub))
    except Aborted:
        return None


def _number(value: bytes) -> int:
    return int.from_bytes(value, "little")


def _is_heartbeat(node: int) -> Callable[[Message], bool]:
    can_id = HEARTBEAT + node
    return lambda message: isinstance(message, ReplyFrame) and message.frame_id == can_id


# Functions of frames that a node sends
SENT_BY_NODE: Final = (*TPDO_FUNCTIONS.values(), SDO_REPLY, HEARTBEAT, EMERGENCY)


def change_node(settings: HipnucCanopenOptions, new: int) -> RequestScript[Written]:
    """Set the node number, 1 … 127, and follow the node (`Readdressing.change`)."""
    return set_node_id(new, new) if new == settings.node else _readdressing(settings).change(new)


def restart(settings: HipnucCanopenOptions, bus_bit_s: int) -> RequestScript[str | VerbResult]:
    """Restart the node, as after power-on, and follow it to its number (`Readdressing.restart`)."""
    return _readdressing(settings).restart(restart_request(settings.node), bus_bit_s)


def reset(settings: HipnucCanopenOptions, bus_bit_s: int, command: NmtCommand) -> RequestScript[str | VerbResult]:
    """Reset the node by an NMT command and follow it like `restart`."""
    return _readdressing(settings).restart(nmt_request(settings.node, command), bus_bit_s)


def factory_reset_and_find(settings: HipnucCanopenOptions) -> RequestScript[str]:
    """Restore the factory settings, effective after a restart: node 8 and 500 kbit/s.

    Raises BadArgument if another node has number 8, Aborted, NoReply.
    """
    yield from _readdressing(settings).check_factory()
    yield from factory_reset(settings.node)
    return f"restored; the device is node {NODE_DEFAULT} at 500 kbit/s after the next restart"


def _readdressing(settings: HipnucCanopenOptions) -> Readdressing:
    node, registers = settings.node, ((NODE_ID, 0), (BIT_RATE, 0))
    return Readdressing(
        options=settings,
        present=node,
        noun="node",
        number="number",
        words="as node",
        lost="the node {confirmed}replied neither as node {new} nor as node {present}; "
        "imud commanded it back to {present}",
        factory=NODE_DEFAULT,
        valid=range(1, NODE_MAX + 1),
        registers=registers,
        bit_rates=BIT_RATE_OF,
        boot=CanFilter(HEARTBEAT, FUNCTION_MASK, False),
        boot_data=bytes([NmtState.BOOT_UP.value]),
        sender_mask=NODE_MASK,
        frames=lambda at: tuple(CanFilter(function + at, STANDARD_ID_MAX, False) for function in sorted(SENT_BY_NODE)),
        describe=lambda can_id: f"frame 0x{can_id:03X}",
        query=lambda at: pack_frame(SDO_REQUEST + at, False, read_frame(DEVICE_TYPE, 0)),
        write=_write_number,
        verify=lambda at, new: verify(at, NODE_ID, 0, new, pending=at == node),
        read_saved=lambda: read_values(node, registers, silent_is_fine=True),
    )


def _write_number(node: int, value: int) -> RequestScript[bool]:
    """Write the node number. Return whether the node confirmed it. Raises Aborted."""
    also = (CanFilter(SDO_REPLY + node, STANDARD_ID_MAX, False),)
    try:
        yield from write_object(node, NODE_ID, 0, value, 4, also=also)
    except NoReply:
        return False
    return True
