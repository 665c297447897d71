"""Request scripts after which a node can have another number: number written, restart, factory settings.

By manual "IMU配置手冊" V1.5.9, section 5.4.1, a new number is in force after saving and restarting. A node that has
it at once, that confirms from the new number, that does not answer reads, or that sends no boot-up message is dealt
with too:

    change    does anything come from the new number? ─ yes ─▶ refused
              write; who confirms the same write again: the old number (pending) or the new one (followed)?
    restart   whose boot-up message comes? else: which of the numbers that it can have is heard?

A node is followed by `Request.settings`. One that is heard nowhere is commanded to go back, and that is an error.
"""

from collections.abc import Callable, Sequence
from typing import Final

from msgspec.structs import replace

from imud.contracts.codec import Message, ReplyFrame
from imud.contracts.device_settings import Written
from imud.contracts.session import Reply, Request, RequestScript, never
from imud.devices.hipnuc.canopen import session
from imud.devices.hipnuc.canopen.cia301 import (
    EMERGENCY,
    FUNCTION_MASK,
    HEARTBEAT,
    NODE_DEFAULT,
    NODE_MASK,
    NODE_MAX,
    SDO_REPLY,
    SDO_REQUEST,
    TPDO_FUNCTIONS,
    NmtCommand,
    NmtState,
    read_frame,
    write_frame,
    write_object,
)
from imud.devices.hipnuc.canopen.codec import HipnucCanopenSettings
from imud.errors import BadArgument, NoReply
from imud.formats.can import STANDARD_ID_MAX, CanFilter, pack_frame
from imud.units import NS_PER_MS, NS_PER_S

SENT_BY_NODE: Final = frozenset({*TPDO_FUNCTIONS.values(), SDO_REPLY, HEARTBEAT, EMERGENCY})
"""Functions of frames that a node itself sends."""
LISTEN_NS: Final = 1100 * NS_PER_MS
"""A TPDO comes at least once a second (section 5.1)."""
BOOT_NS: Final = 3 * NS_PER_S
"""Longest time to the boot-up message; the manual gives none."""
ALL_BOOTS: Final = (CanFilter(HEARTBEAT, FUNCTION_MASK, False),)


def change_node(settings: HipnucCanopenSettings, new: int) -> RequestScript[Written]:
    """Give a node another number, 1 … 127, and follow it where that is in force at once.

    Raises BadArgument for a number that is heard on the bus, DeviceRefused, Aborted, and NoReply for a node that is
    heard at neither number afterwards; it is commanded to go back then.
    """
    node = settings.node
    if new == node:
        return (yield from session.set_node_id(node, new))
    if heard := (yield from _heard(new)):
        raise BadArgument(f"node {new} is taken: frame 0x{heard:03X} of it is on the bus")
    first = yield from _write_number(node, new)
    again = yield from _write_number(node, new)
    if again:
        return (yield from session.verify(node, session.NODE_ID, 0, new, pending=True))
    if (yield from _write_number(new, new)):
        yield _follow(settings, new)
        return (yield from session.verify(new, session.NODE_ID, 0, new))
    yield Request(
        _number_frame(new, node), f"node {new}, back to number {node}", never, never, never, silent=True
    )  # in case it is there and could not answer
    confirmed = "confirmed the write and " if first else ""
    raise NoReply(f"the node {confirmed}answers neither as node {new} nor as node {node}: it was commanded to go back")


def restart(settings: HipnucCanopenSettings, bus_bit_s: int) -> RequestScript[str]:
    """Restart, as by power-on, and follow the node to the number that it has then; return what became of it.

    `bus_bit_s` is the rate of the bus, 0 where it is not known. Raises NoReply for a node that is not heard afterwards.
    """
    return (yield from _reset(settings, bus_bit_s, session.restart_request(settings.node)))


def reset(settings: HipnucCanopenSettings, bus_bit_s: int, command: NmtCommand) -> RequestScript[str]:
    """The same by an NMT command that resets."""
    return (yield from _reset(settings, bus_bit_s, session.nmt_request(settings.node, command)))


def factory_reset_and_find(settings: HipnucCanopenSettings) -> RequestScript[str]:
    """Restore the factory settings, in force after a restart: node 8 and 500 kbit/s.

    Raises BadArgument where another node has number 8, Aborted, NoReply.
    """
    if settings.node != NODE_DEFAULT and (yield from _heard(NODE_DEFAULT)):
        raise BadArgument(f"node {NODE_DEFAULT} is taken: the factory's number is that of another node on the bus")
    yield from session.factory_reset(settings.node)
    return f"restored; it is node {NODE_DEFAULT} at 500 kbit/s after the next restart"


def _reset(settings: HipnucCanopenSettings, bus_bit_s: int, request: Request) -> RequestScript[str]:
    node = settings.node
    saved = yield from session.read_values(node, ((session.NODE_ID, 0), (session.BIT_RATE, 0)), silent_is_fine=True)
    number = saved.get((session.NODE_ID, 0), node)
    if not 1 <= number <= NODE_MAX:  # no number of a node: it will stay where it is
        number = node
    rate = session.BIT_RATE_OF.get(saved.get((session.BIT_RATE, 0), -1), bus_bit_s)
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
    payload = pack_frame(SDO_REQUEST + node, False, read_frame(session.DEVICE_TYPE, 0))
    outcome = yield Request(payload, f"node {node}, is it there", _is_from(node), never, never, LISTEN_NS, also=also)
    return outcome.frames[-1].frame_id if isinstance(outcome, Reply) else 0


def _write_number(node: int, value: int) -> RequestScript[bool]:
    """Write the object of the number, and return whether that node confirmed it. Raises Aborted."""
    also = (CanFilter(SDO_REPLY + node, STANDARD_ID_MAX, False),)
    try:
        yield from write_object(node, session.NODE_ID, 0, value, 4, also=also)
    except NoReply:
        return False
    return True


def _number_frame(node: int, value: int) -> bytes:
    return pack_frame(SDO_REQUEST + node, False, write_frame(session.NODE_ID, 0, value.to_bytes(4, "little")))


def _follow(settings: HipnucCanopenSettings, node: int) -> Request:
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
