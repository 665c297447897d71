"""A node of an NMEA 2000 network without I/O: address claim, replies to requests, heartbeat.

    start ─▶ claims an address ──250 ms without objection──▶ has an address ─▶ sends messages
                  ▲                                              │
                  └──── a smaller NAME claims the address ───────┘      no free address: "cannot claim", new try later

Every method receives the time and returns the frames to send. A reply takes place only if the previous reply with this
PGN is old enough, so that a node with many requests cannot fill the bus. Sources: ISO 11783-5, SAE J1939-81.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from imud.formats import nmea2000
from imud.formats.can import DATA_BYTES_MAX
from imud.formats.j1939 import (
    ACKNOWLEDGEMENT,
    CLAIMED,
    COMMANDED_ADDRESS,
    GLOBAL,
    NULL_ADDRESS,
    PGN_BYTES,
    REQUEST,
    TRANSPORT_CONTROL,
    TRANSPORT_DATA,
    BroadcastReader,
    J1939Id,
    join,
    split,
)
from imud.formats.nmea2000 import (
    ADDRESS_LAST,
    CONFIGURATION_INFORMATION,
    HEARTBEAT,
    NAME_BYTES,
    PGN_LIST,
    PRODUCT_INFORMATION,
    SID_MOST,
)
from imud.model.units import NS_PER_MS, NS_PER_S

log = logging.getLogger(__name__)

CLAIM_NS: Final = 250 * NS_PER_MS  # time for objections after a claim (J1939-81), ns
CANNOT_DELAY_MS: Final = 153  # maximum delay of "cannot claim", so that nodes do not send it at the same time
HEARTBEAT_NS: Final = 60 * NS_PER_S
RETRY_FIRST_NS: Final = 10 * NS_PER_S  # first pause before a new try without a free address, ns; it doubles
RETRY_MOST_NS: Final = 640 * NS_PER_S
# Minimum time between two replies with the same PGN for each frame of the reply, ns: at most 6 % of the bus per PGN
FRAME_PAUSE_NS: Final = 10 * NS_PER_MS
REPLY_PRIORITY: Final = 6  # default priority of claims, requests, acknowledgements and information
HEARTBEAT_PRIORITY: Final = 7
# PGNs that imud accepts, for the list of received PGNs
RECEIVED: Final = (REQUEST, TRANSPORT_DATA, TRANSPORT_CONTROL, CLAIMED, COMMANDED_ADDRESS)
# PGNs that every node of imud sends, for the list of sent PGNs
SENT: Final = (ACKNOWLEDGEMENT, CLAIMED, PGN_LIST, HEARTBEAT, PRODUCT_INFORMATION, CONFIGURATION_INFORMATION)
NEWEST_NS: Final = 2 * NS_PER_S  # maximum age of a heading, rate or attitude in a reply, ns
_ADDRESSES: Final = ADDRESS_LAST + 1


class NodeFrame(NamedTuple):
    can_id: int
    data: bytes


Message = Sequence[NodeFrame]  # frames of one message, in their order


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """NodeIdentity of a node."""

    name: int  # NAME, 64 bits
    product: bytes  # content of 126996
    configuration: bytes  # content of 126998
    sent: Sequence[int]  # PGNs that the node sends periodically


class Node:
    """State of a node. Synchronization: one thread."""

    def __init__(self, identity: NodeIdentity, preferred: int) -> None:
        """`preferred`: first address to claim."""
        self._identity = identity
        self._name = identity.name.to_bytes(NAME_BYTES, "little")
        self._preferred = preferred
        self._taken: dict[int, int] = {}  # NAME of the owner of each address, from the claims of other nodes
        self._claimed: int | None = None  # claimed address; None if no address is free
        self._since_ns = 0  # time of the claim
        self._cannot_ns: int | None = None  # time to send "cannot claim"; None if nothing is due
        self._retry_ns, self._pause_ns = 0, RETRY_FIRST_NS
        self._replied_ns: dict[int, int] = {}  # time of the end of the pause by PGN of the reply
        self._counters: dict[int, int] = {}  # counter of fast packets by PGN
        self._commands = BroadcastReader(COMMANDED_ADDRESS, NAME_BYTES + 1)
        self._heartbeat_ns: int | None = None  # time of the next heartbeat; None before the first
        self._heartbeats = 0
        self._newest: dict[int, tuple[Message, int]] = {}  # newest broadcast and its time by PGN, for requests
        self.claims_lost = 0  # number of addresses that a node with a higher priority took
        self.refused = 0  # number of requests without a reply, because the previous reply is too new
        self.malformed = 0  # number of received frames with an invalid length

    def address(self, now_ns: int) -> int | None:
        """Return the address for messages; None during a claim, or without an address."""
        return self._claimed if self._claimed is not None and now_ns - self._since_ns >= CLAIM_NS else None

    @property
    def preferred(self) -> int:
        """Last claimed address."""
        return self._preferred

    @property
    def problem(self) -> str:
        """Return why the node has no address; empty if it has or claims one."""
        if self._claimed is not None:
            return ""
        return f"expected a free address on the network, got {len(self._taken)} used addresses; disconnect other nodes"

    def start(self, now_ns: int) -> list[Message]:
        """Claim the preferred address. Forget the other nodes."""
        self._taken.clear()
        self._cannot_ns = self._heartbeat_ns = None
        return self._claim(self._preferred, now_ns)

    def tick(self, now_ns: int) -> list[Message]:
        """Return the due messages."""
        if self._claimed is None:
            if self._cannot_ns is not None and now_ns >= self._cannot_ns:
                self._cannot_ns = None
                return [self._claim_message()]
            # the owner of an address can have left the network without a message
            return self.start(now_ns) if now_ns >= self._retry_ns else []
        address = self.address(now_ns)
        if address is None:
            return []
        self._pause_ns = RETRY_FIRST_NS
        if self._heartbeat_ns is not None and now_ns < self._heartbeat_ns:
            return []
        self._heartbeat_ns = now_ns + HEARTBEAT_NS
        return [self._heartbeat(address)]

    def message(self, pgn: int, priority: int, data: bytes, now_ns: int) -> Message | None:
        """Return a broadcast of eight bytes; None without an address."""
        address = self.address(now_ns)
        if address is None:
            return None
        made = [NodeFrame(join(J1939Id(priority, pgn, address)), data)]
        self._newest[pgn] = made, now_ns
        return made

    def receive(self, can_id: int, data: bytes, now_ns: int) -> list[Message]:
        """Process a frame of another node. Return the replies. Never raises an exception."""
        _, pgn, source, destination = split(can_id)
        if destination not in (GLOBAL, self._claimed):
            return []
        if pgn == CLAIMED:
            return self._add_claim(source, data, now_ns)
        if pgn == REQUEST:
            return self._reply(source, destination, data, now_ns)
        if pgn == TRANSPORT_CONTROL:
            self._commands.announce(source, data, now_ns)
        elif pgn == TRANSPORT_DATA:
            command = self._commands.add(source, data, now_ns)
            if command is not None:
                return self._move(command, now_ns)
        return []

    # --- address ----------------------------------------------------------------------------------------------------

    def _claim(self, address: int, now_ns: int) -> list[Message]:
        self._claimed = self._preferred = address
        self._since_ns = now_ns
        return [self._claim_message()]

    def _claim_message(self) -> Message:
        source = NULL_ADDRESS if self._claimed is None else self._claimed
        return [NodeFrame(join(J1939Id(REPLY_PRIORITY, CLAIMED, source)), self._name)]

    def _add_claim(self, source: int, data: bytes, now_ns: int) -> list[Message]:
        if len(data) != NAME_BYTES:
            self.malformed += 1
            return []
        name = int.from_bytes(data, "little")
        # a node has one address: it left its previous address
        self._taken = {address: owner for address, owner in self._taken.items() if owner != name}
        if source > ADDRESS_LAST:  # "cannot claim", or a reserved address
            return []
        if source != self._claimed:
            self._taken[source] = name
            return []
        if name > self._identity.name:  # the other node has a lower priority: imud keeps the address
            return [self._claim_message()]
        if name == self._identity.name:
            log.warning("nmea2000: another node has the same NAME %016X; set another nmea2000.instance", name)
        self._taken[source] = name
        self.claims_lost += 1
        return self._claim_next(now_ns)

    def _claim_next(self, now_ns: int) -> list[Message]:
        """Claim the next free address. Prepare "cannot claim" if no address is free."""
        first = self._preferred
        for step in range(_ADDRESSES):
            address = (first + step) % _ADDRESSES
            if address not in self._taken:
                return self._claim(address, now_ns)
        self._claimed = None
        self._cannot_ns = now_ns + self._identity.name % (CANNOT_DELAY_MS + 1) * NS_PER_MS
        self._retry_ns, self._pause_ns = now_ns + self._pause_ns, min(2 * self._pause_ns, RETRY_MOST_NS)
        return []

    def _move(self, command: bytes, now_ns: int) -> list[Message]:
        """Claim the address of a commanded address message for this NAME."""
        address = command[NAME_BYTES]
        if command[:NAME_BYTES] != self._name or address > ADDRESS_LAST or address == self._claimed:
            return []
        return self._claim(address, now_ns)

    # --- replies ----------------------------------------------------------------------------------------------------

    def _reply(self, source: int, destination: int, data: bytes, now_ns: int) -> list[Message]:
        if len(data) < PGN_BYTES or len(data) > DATA_BYTES_MAX:
            self.malformed += 1
            return []
        pgn = int.from_bytes(data[:PGN_BYTES], "little")
        if pgn == CLAIMED:
            # a claim also before 250 ms; without an address, the reply is "cannot claim"
            return self._limited(CLAIMED, [self._claim_message()], now_ns)
        address = self.address(now_ns)
        if address is None:
            return []
        replies = self._answers(pgn, address, now_ns)
        if replies:
            return self._limited(pgn, replies, now_ns)
        if destination == GLOBAL or source > ADDRESS_LAST:
            return []  # a request to all nodes gets no negative reply
        nack = NodeFrame(join(J1939Id(REPLY_PRIORITY, ACKNOWLEDGEMENT, address)), nmea2000.pack_nack(source, pgn))
        return self._limited(ACKNOWLEDGEMENT, [[nack]], now_ns)

    def _answers(self, pgn: int, address: int, now_ns: int) -> list[Message]:
        """Return the replies to a request; empty for an unsupported PGN, or without a new sample."""
        identity = self._identity
        if pgn == PRODUCT_INFORMATION:
            return [self._fast(pgn, identity.product, address)]
        if pgn == CONFIGURATION_INFORMATION:
            return [self._fast(pgn, identity.configuration, address)]
        if pgn == PGN_LIST:
            lists = (False, (*SENT, *identity.sent)), (True, RECEIVED)
            return [self._fast(pgn, nmea2000.pack_pgn_list(*one), address) for one in lists]
        if pgn == HEARTBEAT:
            return [self._heartbeat(address)]
        newest, t_ns = self._newest.get(pgn, ([], 0))
        return [newest] if newest and now_ns - t_ns < NEWEST_NS and newest[0].can_id & 0xFF == address else []

    def _heartbeat(self, address: int) -> Message:
        data = nmea2000.pack_heartbeat(HEARTBEAT_NS // NS_PER_MS, self._heartbeats % (SID_MOST + 1))
        self._heartbeats += 1
        return [NodeFrame(join(J1939Id(HEARTBEAT_PRIORITY, HEARTBEAT, address)), data)]

    def _fast(self, pgn: int, data: bytes, address: int) -> Message:
        counter = self._counters[pgn] = (self._counters.get(pgn, -1) + 1) % 8
        can_id = join(J1939Id(REPLY_PRIORITY, pgn, address))
        return [NodeFrame(can_id, frame) for frame in nmea2000.fast_packet(counter, data)]

    def _limited(self, pgn: int, replies: list[Message], now_ns: int) -> list[Message]:
        """Return the replies, or no reply if the pause after the previous replies with this PGN has not ended."""
        if now_ns < self._replied_ns.get(pgn, 0):
            self.refused += 1
            return []
        self._replied_ns[pgn] = now_ns + sum(map(len, replies)) * FRAME_PAUSE_NS
        return replies
