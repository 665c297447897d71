"""Conversations with a HiPNUC module over CANopen: who it is, how it is set, and every command of its manual.

Manual "IMU配置手冊" V1.5.9, section 5.4; objects of CiA 301 where it names none. Settings last until power is off
unless `save` follows. TPDO rate and type, inclinometer signs and zero apply at once; node number and bit rate need
`save` and a restart. What is written is read back where the node lets it be read. All raise BadArgument, NoReply, and
Aborted.
"""

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Final

from imud.contracts.codec import Message, ReplyFrame
from imud.contracts.driver import Identity
from imud.contracts.session import Reply, Request, RequestScript, never
from imud.devices.arguments import member, one_of
from imud.devices.hipnuc.canopen import sdo
from imud.devices.hipnuc.canopen.cob_ids import (
    HEARTBEAT,
    NMT,
    NODE_MAX,
    SDO_REQUEST,
    TPDO_FUNCTIONS,
    NmtCommand,
    NmtState,
    state_name,
)
from imud.devices.hipnuc.canopen.sdo import FLASH_TIMEOUT_NS, TIMEOUT_NS, Aborted
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

BIT_RATES: Final = {1_000_000: 0, 500_000: 2, 250_000: 3, 125_000: 4}
"""Codes of 0x209A by bit/s; 1 is not given."""
PERIOD_MIN_MS, PERIOD_MAX_MS = 5, 1000
"""200 Hz … 1 Hz for each TPDO (section 5.1)."""
SAVE, FACTORY_RESET, RESTART = 0x00, 0x01, 0xFF
BOOT_NS: Final = 3 * NS_PER_S
"""Longest time to the boot-up message; the manual gives none."""
HEARTBEAT_WAIT_NS: Final = 3 * NS_PER_S // 2


class Transmission(Enum):
    """When a TPDO is sent (sub-index 2 of its parameters)."""

    SYNC = 0x01
    """When SYNC comes."""
    TIMER_MANUFACTURER = 0xFE
    """By its own timer (the table of section 5.2)."""
    TIMER = 0xFF
    """By its own timer, as delivered (section 5.4.2)."""


class InclinometerZero(Enum):
    """What to do with the zero of the inclinometer."""

    SET = 2
    """The present position reads 0, 0."""
    CANCEL = 5
    """Back to the true angles."""


# --- asking -----------------------------------------------------------------------------------------------------------


def identify(node: int) -> RequestScript[Identity]:
    """Ask a node what it is (0x1000, 0x1008, 0x1018); what it does not know stays empty. Raises NoReply."""
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
    """The state that a node's heartbeat tells while it sends no TPDOs; empty for one that sends, or is not heard."""
    period = yield from _try_read(node, HEARTBEAT_TIME, 0)
    if period is None or not _number(period):
        return ""
    wait_ns = min(_number(period) * NS_PER_MS * 5 // 4 + TIMEOUT_NS // 5, HEARTBEAT_WAIT_NS)
    outcome = yield Request(b"", f"node {node}, heartbeat", _is_heartbeat(node), never, never, wait_ns)
    return state_name(outcome.frames[-1].payload[0]) if isinstance(outcome, Reply) else ""


# --- setting ----------------------------------------------------------------------------------------------------------


def set_node_id(node: int, new_node: int) -> RequestScript[None]:
    """Give the node another number, 1 … 127; in force after `save` and a restart."""
    if isinstance(new_node, bool) or not isinstance(new_node, int) or not 1 <= new_node <= NODE_MAX:
        raise BadArgument(f"node: expected 1 … {NODE_MAX}, got {new_node!r}")
    yield from _set(node, NODE_ID, 0, new_node, 4)


def set_bit_rate(node: int, bit_s: int) -> RequestScript[None]:
    """Set the rate of the bus in bit/s; in force after `save` and a restart."""
    yield from _set(node, BIT_RATE, 0, BIT_RATES[one_of("bit rate", bit_s, BIT_RATES)], 4)


def set_tpdo_period(node: int, tpdo: int, period_ms: int) -> RequestScript[None]:
    """Send a TPDO every 5 … 1000 ms by its timer, or never (0); at once."""
    index = TPDO_OBJECTS[one_of("TPDO", tpdo, TPDO_OBJECTS)]
    valid = isinstance(period_ms, int) and not isinstance(period_ms, bool)
    if not valid or not (period_ms == 0 or PERIOD_MIN_MS <= period_ms <= PERIOD_MAX_MS):
        raise BadArgument(f"period: expected 0 or {PERIOD_MIN_MS} … {PERIOD_MAX_MS} ms, got {period_ms!r}")
    yield from _set(node, index, TPDO_TIMER, period_ms, 2)


def set_tpdo_type(node: int, tpdo: int, transmission: Transmission) -> RequestScript[None]:
    """Send a TPDO by its timer, or when SYNC comes; at once."""
    index = TPDO_OBJECTS[one_of("TPDO", tpdo, TPDO_OBJECTS)]
    yield from _set(node, index, TPDO_TYPE, member("transmission", transmission, Transmission).value, 1)


def set_inclinometer_signs(node: int, *, invert_x: bool, invert_y: bool) -> RequestScript[None]:
    """Turn the signs of the inclinometer around, or leave them as delivered; at once."""
    yield from _set(node, INCLI_SIGN_X, 0, int(_flag("invert_x", invert_x)), 4)
    yield from _set(node, INCLI_SIGN_Y, 0, int(_flag("invert_y", invert_y)), 4)


def set_inclinometer_zero(node: int, zero: InclinometerZero) -> RequestScript[None]:
    """Make the present position the inclinometer's zero, or cancel that; at once."""
    yield from sdo.write(node, INCLI_ZERO, 0, member("zero", zero, InclinometerZero).value, 4)


def save(node: int) -> RequestScript[None]:
    """Write all settings to flash."""
    yield from sdo.write(node, CONTROL, 0, SAVE, 4, timeout_ns=FLASH_TIMEOUT_NS)


def factory_reset(node: int) -> RequestScript[None]:
    """Everything as delivered, node number and bit rate included; in force when power comes back."""
    yield from sdo.write(node, CONTROL, 0, FACTORY_RESET, 4, timeout_ns=FLASH_TIMEOUT_NS)


def restart(node: int) -> RequestScript[None]:
    """Restart, as by power-on. Whether it is confirmed is not stated, so no reply is waited for."""
    frame = sdo.write_frame(CONTROL, 0, RESTART.to_bytes(4, "little"))
    payload = pack_frame(SDO_REQUEST + node, False, frame)
    yield Request(payload, f"node {node}, restart", never, never, never, silent=True)


def nmt(node: int, command: NmtCommand) -> RequestScript[bool]:
    """Give a node an NMT command, which it never confirms; for a reset, whether its boot-up message came."""
    code = member("command", command, NmtCommand).value
    resets = command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)
    ends = _is_heartbeat(node, NmtState.BOOT_UP) if resets else never
    payload = pack_frame(NMT, False, bytes([code, node]))
    outcome = yield Request(payload, f"node {node}, NMT {command.name}", ends, never, never, BOOT_NS, silent=not resets)
    return resets and isinstance(outcome, Reply)


def _set(node: int, index: int, sub: int, value: int, size: int) -> RequestScript[None]:
    """Write, and read back where that is possible. Raises DeviceRefused where something else stands there then."""
    yield from sdo.write(node, index, sub, value, size)
    found = yield from _try_read(node, index, sub)
    if found is not None and _number(found) != value:
        raise DeviceRefused(f"node {node}: expected 0x{index:04X}.{sub} = {value}, reads back {_number(found)}")


def _try_read(node: int, index: int, sub: int) -> RequestScript[bytes | None]:
    """An object's bytes; None where the node has none, or does not give it here. Raises NoReply."""
    try:
        return (yield from sdo.read(node, index, sub))
    except Aborted:
        return None


def _number(value: bytes) -> int:
    return int.from_bytes(value, "little")


def _flag(name: str, value: bool) -> bool:
    if not isinstance(value, bool):
        raise BadArgument(f"{name}: expected true or false, got {value!r}")
    return value


def _is_heartbeat(node: int, state: NmtState | None = None) -> Callable[[Message], bool]:
    """What holds for a heartbeat of a node, of one state if that is given."""
    can_id = HEARTBEAT + node

    def holds(message: Message) -> bool:
        if not isinstance(message, ReplyFrame) or message.frame_id != can_id:
            return False
        return state is None or message.payload == bytes([state.value])

    return holds
