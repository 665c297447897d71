"""Request scripts of a HiPNUC module on CANopen: identity, settings, and every command of its manual.

Manual "IMU配置手冊" V1.5.9, section 5.4; objects of CiA 301 where it names none. Settings last until power is off
unless `save` follows. TPDO rate and type, inclinometer signs and zero apply at once; node number and bit rate need
`save` and a restart. What is written is read back where the node lets it be read. All raise NoReply and Aborted; ranges
of arguments are those of the actions (`actions.py`), and what no range can express raises BadArgument here.
"""

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Final, Literal

from imud.contracts.codec import Message, ReplyFrame
from imud.contracts.driver import Identity
from imud.contracts.session import Reply, Request, RequestScript, never
from imud.devices.hipnuc.canopen.cia301 import (
    FLASH_TIMEOUT_NS,
    HEARTBEAT,
    NMT,
    SDO_REQUEST,
    TIMEOUT_NS,
    TPDO_FUNCTIONS,
    Aborted,
    NmtCommand,
    NmtState,
    TpdoNumber,
    read_object,
    state_name,
    write_frame,
    write_object,
)
from imud.errors import BadArgument, DeviceRefused
from imud.formats.can import pack_frame
from imud.units import NS_PER_MS, NS_PER_S

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
BIT_RATES: Final = {1_000_000: 0, 500_000: 2, 250_000: 3, 125_000: 4}
"""Codes of 0x209A by bit/s; 1 is not given."""
PERIOD_MIN_MS, PERIOD_MAX_MS = 5, 1000
"""200 Hz … 1 Hz for each TPDO (section 5.1)."""
SAVE, FACTORY_RESET, RESTART = 0x00, 0x01, 0xFF
BOOT_NS: Final = 3 * NS_PER_S
"""Longest time to the boot-up message; the manual gives none."""
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
    places = [(index, sub) for index in TPDO_OBJECTS.values() for sub in (TPDO_TYPE, TPDO_TIMER)]
    places += [(index, 0) for index in (NODE_ID, BIT_RATE, INCLI_SIGN_X, INCLI_SIGN_Y, HEARTBEAT_TIME)]
    settings: dict[str, str] = {}
    for index, sub in places:
        value = yield from _try_read(node, index, sub)
        if value is not None:
            settings[f"{index:04X}.{sub}"] = str(_number(value))
    return settings


def _heartbeat_state(node: int) -> RequestScript[str]:
    """State in a node's heartbeat while it sends no TPDOs; empty for one that sends, or is not heard."""
    period = yield from _try_read(node, HEARTBEAT_TIME, 0)
    if period is None or not _number(period):
        return ""
    wait_ns = min(_number(period) * NS_PER_MS * 5 // 4 + TIMEOUT_NS // 5, HEARTBEAT_WAIT_NS)
    outcome = yield Request(b"", f"node {node}, heartbeat", _is_heartbeat(node), never, never, wait_ns)
    return state_name(outcome.frames[-1].payload[0]) if isinstance(outcome, Reply) else ""


# --- setting ----------------------------------------------------------------------------------------------------------


def set_node_id(node: int, new_node: int) -> RequestScript[None]:
    """Give the node another number, 1 … 127; in force after `save` and a restart."""
    yield from _set(node, NODE_ID, 0, new_node, 4)


def set_bit_rate(node: int, bit_s: BitRate) -> RequestScript[None]:
    """Set the rate of the bus in bit/s; in force after `save` and a restart."""
    yield from _set(node, BIT_RATE, 0, BIT_RATES[bit_s], 4)


def set_tpdo_period(node: int, tpdo: TpdoNumber, period_ms: int) -> RequestScript[None]:
    """Send a TPDO every 5 … 1000 ms by its timer, or never (0); at once. Raises BadArgument for 1 … 4."""
    if 0 < period_ms < PERIOD_MIN_MS:
        raise BadArgument(f"interval_ms: expected 0 or {PERIOD_MIN_MS} … {PERIOD_MAX_MS}, got {period_ms}")
    yield from _set(node, TPDO_OBJECTS[tpdo], TPDO_TIMER, period_ms, 2)


def set_tpdo_type(node: int, tpdo: TpdoNumber, transmission: Transmission) -> RequestScript[None]:
    """Send a TPDO by its timer, or when SYNC comes; at once."""
    yield from _set(node, TPDO_OBJECTS[tpdo], TPDO_TYPE, transmission.value, 1)


def set_inclinometer_signs(node: int, *, invert_x: bool, invert_y: bool) -> RequestScript[None]:
    """Turn the signs of the inclinometer around, or leave them as delivered; at once."""
    yield from _set(node, INCLI_SIGN_X, 0, int(invert_x), 4)
    yield from _set(node, INCLI_SIGN_Y, 0, int(invert_y), 4)


def set_inclinometer_zero(node: int, zero: InclinometerZero) -> RequestScript[None]:
    """Make the present position the inclinometer's zero, or cancel that; at once."""
    yield from write_object(node, INCLI_ZERO, 0, zero.value, 4)


def save(node: int) -> RequestScript[None]:
    """Write all settings to flash."""
    yield from write_object(node, CONTROL, 0, SAVE, 4, timeout_ns=FLASH_TIMEOUT_NS)


def factory_reset(node: int) -> RequestScript[None]:
    """Restore the factory settings, node number and bit rate included; in force after the next power-on."""
    yield from write_object(node, CONTROL, 0, FACTORY_RESET, 4, timeout_ns=FLASH_TIMEOUT_NS)


def restart(node: int) -> RequestScript[None]:
    """Restart, as by power-on. Whether it is confirmed is not stated, so no reply is waited for."""
    frame = write_frame(CONTROL, 0, RESTART.to_bytes(4, "little"))
    payload = pack_frame(SDO_REQUEST + node, False, frame)
    yield Request(payload, f"node {node}, restart", never, never, never, silent=True)


def nmt(node: int, command: NmtCommand) -> RequestScript[bool]:
    """Send an NMT command, which no node confirms; for a reset, return whether the boot-up message came."""
    resets = command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)
    ends = _is_heartbeat(node, NmtState.BOOT_UP) if resets else never
    payload = pack_frame(NMT, False, bytes([command.value, node]))
    outcome = yield Request(payload, f"node {node}, NMT {command.name}", ends, never, never, BOOT_NS, silent=not resets)
    return resets and isinstance(outcome, Reply)


def _set(node: int, index: int, sub: int, value: int, size: int) -> RequestScript[None]:
    """Write, and read back where that is possible. Raises DeviceRefused where something else stands there then."""
    yield from write_object(node, index, sub, value, size)
    found = yield from _try_read(node, index, sub)
    if found is not None and _number(found) != value:
        raise DeviceRefused(f"node {node}: expected 0x{index:04X}.{sub} = {value}, reads back {_number(found)}")


def _try_read(node: int, index: int, sub: int) -> RequestScript[bytes | None]:
    """Bytes of an object; None where the node has none, or refuses to read it. Raises NoReply."""
    try:
        return (yield from read_object(node, index, sub))
    except Aborted:
        return None


def _number(value: bytes) -> int:
    return int.from_bytes(value, "little")


def _is_heartbeat(node: int, state: NmtState | None = None) -> Callable[[Message], bool]:
    """A test for heartbeats of a node, of one state if that is given."""
    can_id = HEARTBEAT + node

    def holds(message: Message) -> bool:
        if not isinstance(message, ReplyFrame) or message.frame_id != can_id:
            return False
        return state is None or message.payload == bytes([state.value])

    return holds
