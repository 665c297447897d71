"""Address of a node without I/O: claim, defence, contention, and nodes with the same NAME.

    other node claims the address of imud    reaction
    larger NAME                              imud claims the address again
    smaller NAME                             imud claims the next free address
    NAME of imud, within ECHO_NS             echo of a claim of imud: imud ignores and counts it
    NAME of imud, later                      conflict: imud claims the next free address, after a pause that grows

An adapter, a bridge or a loop of bridges can echo frames. An echo and the claim of a second node with the same NAME are
equal frames. After the first echo, imud therefore repeats its claim PROBES times after random delays. An echo
follows each repetition. A second node repeats its own claim at another time, and this claim is a conflict.

Every peer has a budget of replies, so that claims without end cause few frames. Sources: ISO 11783-5, SAE J1939-81.
"""

from collections.abc import Sequence
from random import Random
from typing import Final, NamedTuple

from imud.formats.j1939 import CLAIMED, NULL_ADDRESS, J1939Id, join
from imud.formats.nmea2000 import ADDRESS_LAST, NAME_BYTES
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.model.work_budget import WorkBudget

CLAIM_NS: Final = 250 * NS_PER_MS  # time for objections after a claim (J1939-81), ns
CANNOT_DELAY_MS: Final = 153  # maximum delay of "cannot claim", so that nodes do not send it at the same time
RETRY_FIRST_NS: Final = 10 * NS_PER_S  # first pause before a new try without an address, ns; it doubles
RETRY_MAX_NS: Final = 640 * NS_PER_S
ECHO_NS: Final = CLAIM_NS  # maximum time from a claim of imud to its echo, ns: a bridge over a network needs 0.1 s
PROBES: Final = 4  # number of repeated claims; two nodes with one NAME choose similar delays in 1 of 1000 cases
# Range of the random delay of a repeated claim, ns: several times ECHO_NS, so that two nodes rarely choose equal delays
PROBE_MIN_NS: Final = 500 * NS_PER_MS
PROBE_MAX_NS: Final = 3_500 * NS_PER_MS
CONFLICT_FIRST_NS: Final = NS_PER_S  # minimum time between two changes of the address after conflicts, ns; it doubles
CONFLICT_MAX_NS: Final = 640 * NS_PER_S
CONFLICT_SHOWN_NS: Final = 180 * NS_PER_S  # time after which imud forgets another node with its NAME, ns
PRIORITY: Final = 6  # default priority of claims and requests
_ADDRESSES: Final = ADDRESS_LAST + 1


class NodeFrame(NamedTuple):
    can_id: int
    data: bytes


Message = Sequence[NodeFrame]  # frames of one message, in their order


class NodeAddress:
    """Address of one node. Synchronization: one thread."""

    def __init__(self, name: int, preferred: int, budget: WorkBudget, random: Random) -> None:
        """`preferred`: first address to claim. `random` chooses the delays of repeated claims."""
        self._name = name
        self._budget = budget
        self._random = random
        self.preferred = preferred  # last claimed address
        self.claimed: int | None = None  # claimed address; None without an address
        self._since_ns = 0  # time of the first claim of this address
        self._owners: dict[int, int] = {}  # NAME of the owner of each address, from the claims of other nodes
        self._sent_ns: dict[int, int] = {}  # time of the newest claim of imud for each address, for echoes
        self._cannot_ns: int | None = None  # time to send "cannot claim"; None if nothing is due
        self._retry_ns = 0  # time of the next try without an address
        self._retry_pause_ns = RETRY_FIRST_NS
        self._refusal = ""  # reason why the node has no address
        self._probe_ns: int | None = None  # time of the next repeated claim; None without one
        self._probes = 0  # number of repeated claims that remain for this address
        self._conflict_source: int | None = None  # address of the other node with this NAME; None without one
        self._conflict_ns = 0  # time of the newest claim of this node
        self._move_ns = 0  # earliest time of the next change of the address after a conflict
        self._move_pause_ns = CONFLICT_FIRST_NS
        self.claims_lost = 0  # number of addresses that other nodes took
        self.echoes = 0  # number of own claims that imud received again
        self.conflicts = 0  # number of claims of other nodes with this NAME

    def address(self, now_ns: int) -> int | None:
        """Return the address for messages; None during a claim, or without an address."""
        return self.claimed if self.claimed is not None and now_ns - self._since_ns >= CLAIM_NS else None

    @property
    def conflict_source(self) -> int | None:
        """Address of another node with this NAME; None without such a node."""
        return self._conflict_source

    @property
    def problem(self) -> str:
        """Return why the node has no address, or that another node has its NAME; empty without a problem."""
        if self.claimed is None:
            return self._refusal
        if self._conflict_source is None:
            return ""
        return (
            f"another node has the NAME {self._name:016X} of this gateway and claims address {self._conflict_source}; "
            "expected one node with this NAME; set another nmea2000.instance, or remove the bridge that repeats frames"
        )

    def start(self, now_ns: int) -> list[Message]:
        """Claim the preferred address. Forget the other nodes."""
        self._owners.clear()
        self._cannot_ns = None
        return self._claim(self.preferred, now_ns)

    def tick(self, now_ns: int) -> list[Message]:
        """Return the due messages: "cannot claim", a new try without an address, or a repeated claim."""
        if self._conflict_source is not None and now_ns - self._conflict_ns >= CONFLICT_SHOWN_NS:
            self._conflict_source = None
        if self.claimed is None:
            if self._cannot_ns is not None and now_ns >= self._cannot_ns:
                self._cannot_ns = None
                return [self.message(now_ns)]
            # the owner of an address can have left the network without a message
            return self.start(now_ns) if now_ns >= self._retry_ns else []
        if self.address(now_ns) is not None:
            self._retry_pause_ns = RETRY_FIRST_NS
        if self._probe_ns is None or now_ns < self._probe_ns:
            return []
        self._probe_ns = None
        return [self.message(now_ns)]

    def message(self, now_ns: int) -> Message:
        """Return a claim of the address; "cannot claim" without an address."""
        source = NULL_ADDRESS if self.claimed is None else self.claimed
        self._sent_ns[source] = now_ns
        return [NodeFrame(join(J1939Id(PRIORITY, CLAIMED, source)), self._name.to_bytes(NAME_BYTES, "little"))]

    def receive(self, source: int, name: int, now_ns: int) -> list[Message]:
        """Process a claim. Return the replies."""
        if name == self._name:
            return self._receive_own_name(source, now_ns)
        # a node has one address: it left its previous address
        self._owners = {address: owner for address, owner in self._owners.items() if owner != name}
        if source > ADDRESS_LAST:  # "cannot claim", or a reserved address
            return []
        if source != self.claimed:
            self._owners[source] = name
            return []
        has_budget = self._budget.take_reply(f"the node with NAME {name:016X}")
        if name > self._name:  # the other node has a lower priority: imud keeps the address
            return [self.message(now_ns)] if has_budget else []
        self._owners[source] = name
        self.claims_lost += 1
        if has_budget:
            return self._claim_next(now_ns)
        self._wait(
            f"the node with NAME {name:016X} takes each address of imud; expected a node with one address; "
            "disconnect this node",
            now_ns,
        )
        return []

    def move(self, address: int, now_ns: int) -> list[Message]:
        """Claim an address that another node commanded."""
        if address > ADDRESS_LAST or address == self.claimed:
            return []
        return self._claim(address, now_ns)

    def _receive_own_name(self, source: int, now_ns: int) -> list[Message]:
        """Process a claim with the NAME of imud: an echo, or the claim of another node."""
        sent_ns = self._sent_ns.get(source)
        if sent_ns is not None and now_ns - sent_ns < ECHO_NS:
            self.echoes += 1
            self._plan_probe(now_ns)
            return []
        self.conflicts += 1
        self._conflict_source = source
        self._conflict_ns = now_ns
        if source != self.claimed or now_ns < self._move_ns:
            return []
        self.claims_lost += 1
        self._move_ns = now_ns + self._move_pause_ns
        self._move_pause_ns = min(2 * self._move_pause_ns, CONFLICT_MAX_NS)
        self._owners[source] = self._name
        return self._claim_next(now_ns)

    def _plan_probe(self, now_ns: int) -> None:
        if self.claimed is not None and self._probe_ns is None and self._probes > 0:
            self._probes -= 1
            self._probe_ns = now_ns + self._random.randint(PROBE_MIN_NS, PROBE_MAX_NS)

    def _claim(self, address: int, now_ns: int) -> list[Message]:
        self.claimed = address
        self.preferred = address
        self._since_ns = now_ns
        self._probe_ns = None
        self._probes = PROBES
        return [self.message(now_ns)]

    def _claim_next(self, now_ns: int) -> list[Message]:
        """Claim the next free address. Prepare "cannot claim" if no address is free."""
        first = self.preferred
        for step in range(_ADDRESSES):
            address = (first + step) % _ADDRESSES
            if address not in self._owners and address != self._conflict_source:
                return self._claim(address, now_ns)
        self._wait(
            f"expected a free address on the network, got {len(self._owners)} used addresses; disconnect other nodes",
            now_ns,
        )
        return []

    def _wait(self, reason: str, now_ns: int) -> None:
        """Use no address until the next try. Prepare "cannot claim"."""
        self.claimed = None
        self._refusal = reason
        self._cannot_ns = now_ns + self._name % (CANNOT_DELAY_MS + 1) * NS_PER_MS
        self._retry_ns = now_ns + self._retry_pause_ns
        self._retry_pause_ns = min(2 * self._retry_pause_ns, RETRY_MAX_NS)
