"""A node of an NMEA 2000 network without I/O: address claim, replies to requests, heartbeat.

    start ─▶ claims an address ──250 ms without objection──▶ has an address ─▶ sends messages
                  ▲                                              │
                  └──── a smaller NAME claims the address ───────┘      no free address: "cannot claim", new try later

Every method receives the time and returns the frames to send. A reply takes place only if the previous reply with this
PGN is old enough, so that a node with many requests cannot fill the bus. Each peer has a budget of replies and of CPU
time (`imud.model.work_budget`). All frames that the node receives at one time are one turn of the budget.
`address.py` contains the address. Sources: ISO 11783-5, SAE J1939-81.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

from imud.formats import nmea2000
from imud.formats.can import DATA_BYTES_MAX
from imud.formats.j1939 import (
    ACKNOWLEDGEMENT,
    CLAIMED,
    COMMANDED_ADDRESS,
    GLOBAL,
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
from imud.model.work_budget import WorkBudget, WorkLimits
from imud.publishers.nmea2000.address import PRIORITY, Message, NodeAddress, NodeFrame

# Limits of the other nodes of the bus. A plotter sends at most 10 requests per second. 252 nodes that claim all
# addresses at the same time cause 124 claims. CPU time: a full bus of requests needs about 20 ms per second.
LIMITS: Final = WorkLimits(second_cpu_ns=20 * NS_PER_MS, turn_replies=128, second_replies=32)
HEARTBEAT_NS: Final = 60 * NS_PER_S
# Minimum time between two replies with the same PGN for each frame of the reply, ns: at most 6 % of the bus per PGN
FRAME_PAUSE_NS: Final = 10 * NS_PER_MS
HEARTBEAT_PRIORITY: Final = 7
# PGNs that imud accepts, for the list of received PGNs
RECEIVED: Final = (REQUEST, TRANSPORT_DATA, TRANSPORT_CONTROL, CLAIMED, COMMANDED_ADDRESS)
# PGNs that every node of imud sends, for the list of sent PGNs
SENT: Final = (ACKNOWLEDGEMENT, CLAIMED, PGN_LIST, HEARTBEAT, PRODUCT_INFORMATION, CONFIGURATION_INFORMATION)
# PGNs that every node of imud sends on request
INFORMATION: Final = frozenset((PGN_LIST, HEARTBEAT, PRODUCT_INFORMATION, CONFIGURATION_INFORMATION))
NEWEST_NS: Final = 2 * NS_PER_S  # maximum age of a heading, rate or attitude in a reply, ns


def _no_cpu_time() -> int:
    return 0


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """NodeIdentity of a node."""

    name: int  # NAME, 64 bits
    product: bytes  # content of 126996
    configuration: bytes  # content of 126998
    sent: Sequence[int]  # PGNs that the node sends periodically


class Node:
    """State of a node. Synchronization: one thread."""

    def __init__(
        self,
        identity: NodeIdentity,
        preferred: int,
        cpu_ns: Callable[[], int] = _no_cpu_time,
        random: Random | None = None,
    ) -> None:
        """`preferred`: first address to claim. `cpu_ns` returns the CPU time of the thread, ns. `random`: default is a
        generator with a random seed, so that two nodes with one NAME behave differently."""
        self._identity = identity
        self._name = identity.name.to_bytes(NAME_BYTES, "little")
        self._budget = WorkBudget(LIMITS, cpu_ns)
        self._turn_ns: int | None = None  # time of the present turn of the budget; None between two turns
        self._address = NodeAddress(identity.name, preferred, self._budget, random or Random())
        self._replied_ns: dict[int, int] = {}  # time of the end of the pause by PGN of the reply
        self._counters: dict[int, int] = {}  # counter of fast packets by PGN
        self._commands = BroadcastReader(COMMANDED_ADDRESS, NAME_BYTES + 1)
        self._heartbeat_ns: int | None = None  # time of the next heartbeat; None before the first
        self._heartbeats = 0
        self._newest: dict[int, tuple[Message, int]] = {}  # newest broadcast and its time by PGN, for requests
        self.refused = 0  # number of requests without a reply, because the previous reply is too new
        self.malformed = 0  # number of received frames with an invalid length

    def address(self, now_ns: int) -> int | None:
        """Return the address for messages; None during a claim, or without an address."""
        return self._address.address(now_ns)

    @property
    def preferred(self) -> int:
        """Last claimed address."""
        return self._address.preferred

    @property
    def claimed(self) -> int | None:
        """Claimed address, also before the end of the claim; None without an address."""
        return self._address.claimed

    @property
    def claims_lost(self) -> int:
        """Number of addresses that other nodes took."""
        return self._address.claims_lost

    @property
    def ignored(self) -> int:
        """Number of received frames that imud ignored: invalid lengths, own claims, and inputs above the budget."""
        return self.malformed + self._address.echoes + self._address.conflicts + self._budget.refused

    @property
    def problem(self) -> str:
        """Return why the node has no address, or that another node has its NAME; empty without a problem."""
        return self._address.problem

    def peer_problem(self, now_ns: int) -> str:
        """Return the sentence about a node that sends more than imud processes; empty without such a node."""
        return self._budget.problem(now_ns)

    def start(self, now_ns: int) -> list[Message]:
        """Claim the preferred address. Forget the other nodes."""
        self._heartbeat_ns = None
        return self._address.start(now_ns)

    def tick(self, now_ns: int) -> list[Message]:
        """Return the due messages."""
        messages = self._address.tick(now_ns)
        address = self.address(now_ns)
        if address is None or (self._heartbeat_ns is not None and now_ns < self._heartbeat_ns):
            return messages
        self._heartbeat_ns = now_ns + HEARTBEAT_NS
        messages.append(self._heartbeat(address))
        other = self._address.conflict_source
        if other is not None and other <= ADDRESS_LAST and other != address:
            messages.append(self._request_claim(address, other))
        return messages

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
        if now_ns != self._turn_ns:
            self._turn_ns = now_ns
            self._budget.start_turn(now_ns)
        if not self._budget.admit(_peer(source)):
            return []
        if destination not in (GLOBAL, self._address.claimed):
            return []
        if pgn == CLAIMED:
            return self._receive_claim(source, data, now_ns)
        if pgn == REQUEST:
            return self._reply(source, destination, data, now_ns)
        if pgn == TRANSPORT_CONTROL:
            self._commands.announce(source, data, now_ns)
        elif pgn == TRANSPORT_DATA:
            command = self._commands.add(source, data, now_ns)
            if command is not None:
                return self._move(command, source, now_ns)
        return []

    def end_turn(self) -> None:
        """Charge the CPU time since the last frame to its sender: the caller has sent the replies."""
        self._budget.end_turn()
        self._turn_ns = None

    # --- address ----------------------------------------------------------------------------------------------------

    def _receive_claim(self, source: int, data: bytes, now_ns: int) -> list[Message]:
        if len(data) != NAME_BYTES:
            self.malformed += 1
            return []
        return self._address.receive(source, int.from_bytes(data, "little"), now_ns)

    def _move(self, command: bytes, source: int, now_ns: int) -> list[Message]:
        """Claim the address of a commanded address message for this NAME."""
        if command[:NAME_BYTES] != self._name or not self._budget.take_reply(_peer(source)):
            return []
        return self._address.move(command[NAME_BYTES], now_ns)

    def _request_claim(self, address: int, destination: int) -> Message:
        """Return a request for the claim of another node. Its reply shows that the node is still on the network."""
        can_id = join(J1939Id(PRIORITY, REQUEST, address, destination))
        return [NodeFrame(can_id, CLAIMED.to_bytes(PGN_BYTES, "little"))]

    # --- replies ----------------------------------------------------------------------------------------------------

    def _reply(self, source: int, destination: int, data: bytes, now_ns: int) -> list[Message]:
        if len(data) < PGN_BYTES or len(data) > DATA_BYTES_MAX:
            self.malformed += 1
            return []
        pgn = int.from_bytes(data[:PGN_BYTES], "little")
        address = self.address(now_ns)
        if pgn == CLAIMED:
            return self._reply_claim(source, now_ns)
        if address is None:
            return []
        broadcast = self._newest_broadcast(pgn, address, now_ns)
        if broadcast is None and pgn not in INFORMATION:
            return self._reject(pgn, source, destination, now_ns)
        if not self._may_reply(pgn, source, now_ns):
            return []
        return self._paused(pgn, [broadcast] if broadcast else self._information(pgn, address), now_ns)

    def _reply_claim(self, source: int, now_ns: int) -> list[Message]:
        """Return the claim, also before its end; "cannot claim" without an address."""
        if not self._may_reply(CLAIMED, source, now_ns):
            return []
        return self._paused(CLAIMED, [self._address.message(now_ns)], now_ns)

    def _reject(self, pgn: int, source: int, destination: int, now_ns: int) -> list[Message]:
        """Return the negative reply to a request for an unsupported PGN, or for a PGN without a new sample."""
        if destination == GLOBAL or source > ADDRESS_LAST:
            return []  # a request to all nodes gets no negative reply
        if not self._may_reply(ACKNOWLEDGEMENT, source, now_ns):
            return []
        nack = NodeFrame(join(J1939Id(PRIORITY, ACKNOWLEDGEMENT, destination)), nmea2000.pack_nack(source, pgn))
        return self._paused(ACKNOWLEDGEMENT, [[nack]], now_ns)

    def _newest_broadcast(self, pgn: int, address: int, now_ns: int) -> Message | None:
        """Return the newest broadcast with this PGN; None if it is too old, or from another address."""
        message, t_ns = self._newest.get(pgn, ([], 0))
        is_new = bool(message) and now_ns - t_ns < NEWEST_NS
        return message if is_new and message[0].can_id & 0xFF == address else None

    def _information(self, pgn: int, address: int) -> list[Message]:
        """Return the reply to a request for one of the PGNs INFORMATION."""
        identity = self._identity
        if pgn == PRODUCT_INFORMATION:
            return [self._fast(pgn, identity.product, address)]
        if pgn == CONFIGURATION_INFORMATION:
            return [self._fast(pgn, identity.configuration, address)]
        if pgn == HEARTBEAT:
            return [self._heartbeat(address)]
        lists = (False, (*SENT, *identity.sent)), (True, RECEIVED)
        return [self._fast(pgn, nmea2000.pack_pgn_list(*arguments), address) for arguments in lists]

    def _heartbeat(self, address: int) -> Message:
        data = nmea2000.pack_heartbeat(HEARTBEAT_NS, self._heartbeats % (SID_MOST + 1))
        self._heartbeats += 1
        return [NodeFrame(join(J1939Id(HEARTBEAT_PRIORITY, HEARTBEAT, address)), data)]

    def _fast(self, pgn: int, data: bytes, address: int) -> Message:
        counter = self._counters[pgn] = (self._counters.get(pgn, -1) + 1) % 8
        can_id = join(J1939Id(PRIORITY, pgn, address))
        return [NodeFrame(can_id, frame) for frame in nmea2000.fast_packet(counter, data)]

    def _may_reply(self, pgn: int, source: int, now_ns: int) -> bool:
        """Return whether imud may reply with this PGN now: the node has a budget, and the last pause has ended."""
        if not self._budget.take_reply(_peer(source)):
            return False
        if now_ns < self._replied_ns.get(pgn, 0):
            self.refused += 1
            return False
        return True

    def _paused(self, pgn: int, replies: list[Message], now_ns: int) -> list[Message]:
        """Return the replies. Start the pause before the next reply with this PGN."""
        self._replied_ns[pgn] = now_ns + sum(map(len, replies)) * FRAME_PAUSE_NS
        return replies


def _peer(source: int) -> str:
    """Return the name of a node for the budget."""
    return f"the node with address {source}"
