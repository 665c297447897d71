"""Limit of the work that peers outside imud cause in the event loop.

A peer is a host, a bus node, a page, a server or a driver of another package. A limit of datagrams or lines does not
protect the event loop, because one datagram can request thousands of replies. The budget therefore counts the scarce
resources: CPU time and replies.

    start_turn ─▶ admit(peer) ─▶ work ─▶ admit(peer) ─▶ work ─▶ … ─▶ end_turn

Each `admit` charges the CPU time since the previous call to the peer of that call. If `admit` returns False, the caller
discards the input of this peer, or leaves it in the queue of the kernel. The budget counts both.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Final

from imud.model.units import NS_PER_S

SHOWN_NS: Final = 10 * NS_PER_S  # time for which `problem` names a peer after its last refused input, ns
EDGE_FACTOR: Final = 4  # all peers of an edge together have this multiple of the budget of one peer per second


@dataclass(frozen=True, slots=True)
class WorkLimits:
    """Limits of one edge. Each value is at least 1."""

    turn_cpu_ns: int = 2_000_000  # CPU time of all peers in one turn of the event loop, ns
    second_cpu_ns: int = 50_000_000  # CPU time of one peer per second, ns
    turn_replies: int = 64  # replies to all peers in one turn
    second_replies: int = 1_000  # replies to one peer per second
    peers: int = 256  # maximum number of peers whose use is stored


class _Use:
    """CPU time and replies that a peer may still use. Both refill with time, up to the value of one second."""

    __slots__ = ("_limits", "_refill_ns", "_scale", "cpu_ns", "replies")

    def __init__(self, limits: WorkLimits, now_ns: int, scale: int = 1) -> None:
        self._limits = limits
        self._scale = scale
        self._refill_ns = now_ns
        self.cpu_ns = float(limits.second_cpu_ns * scale)
        self.replies = float(limits.second_replies * scale)

    def refill(self, now_ns: int) -> None:
        """Add the budget of the time since the previous call."""
        elapsed_s = max(0, now_ns - self._refill_ns) / NS_PER_S
        self._refill_ns = now_ns
        cpu_per_s = self._limits.second_cpu_ns * self._scale
        replies_per_s = self._limits.second_replies * self._scale
        self.cpu_ns = min(cpu_per_s, self.cpu_ns + elapsed_s * cpu_per_s)
        self.replies = min(replies_per_s, self.replies + elapsed_s * replies_per_s)

    def charge(self, spent_ns: int) -> None:
        """Subtract CPU time. The debt is at most the budget of one second, so that a flood ends with its sender."""
        self.cpu_ns = max(self.cpu_ns - spent_ns, -float(self._limits.second_cpu_ns * self._scale))

    @property
    def is_full(self) -> bool:
        """Whether the whole budget of one second is available: the state of a peer without work."""
        return (
            self.cpu_ns >= self._limits.second_cpu_ns * self._scale
            and self.replies >= self._limits.second_replies * self._scale
        )


class WorkBudget:
    """Budget of one edge and of each of its peers. Synchronization: the event loop's thread only."""

    def __init__(self, limits: WorkLimits, cpu_ns: Callable[[], int]) -> None:
        """`cpu_ns` returns the CPU time of the event loop's thread, ns."""
        self._limits = limits
        self._cpu_ns = cpu_ns
        self._uses: dict[Hashable, _Use] = {}
        self._edge = _Use(limits, 0, EDGE_FACTOR)
        self._now_ns = 0
        self._mark_ns = 0  # CPU time of the last charge
        self._turn_end_ns = 0  # CPU time at which the budget of the turn ends
        self._turn_replies = 0  # replies that the turn still permits
        self._working: _Use | None = None  # use of the peer that works since the last `admit`
        self.refused = 0  # number of inputs and replies above the budget
        self._refused_peer: Hashable = None
        self._refused_ns: int | None = None  # time of the last refusal

    def start_turn(self, now_ns: int) -> None:
        """Start the budget of a turn. `now_ns` is the time of the turn, CLOCK_MONOTONIC."""
        self._now_ns = now_ns
        self._edge.refill(now_ns)
        self._mark_ns = self._cpu_ns()
        self._turn_end_ns = self._mark_ns + self._limits.turn_cpu_ns
        self._turn_replies = self._limits.turn_replies
        self._working = None

    def end_turn(self) -> None:
        """Charge the last work of the turn."""
        self._charge()
        self._working = None

    def admit(self, peer: Hashable) -> bool:
        """Return whether imud processes the next input of `peer` in this turn. Charge the work since the last call."""
        self._charge()
        use = self._use(peer)
        self._working = use
        if self._mark_ns < self._turn_end_ns and use.cpu_ns > 0 and self._edge.cpu_ns > 0:
            return True
        self._refuse(peer)
        return False

    def charge(self, peer: Hashable, spent_ns: int) -> None:
        """Charge CPU time that the caller has measured, for work that no turn contains."""
        self._use(peer).charge(spent_ns)
        self._edge.charge(spent_ns)

    def take_reply(self, peer: Hashable) -> bool:
        """Return whether imud may send one more reply to `peer` in this turn."""
        use = self._use(peer)
        if self._turn_replies >= 1 and use.replies >= 1 and self._edge.replies >= 1:
            self._turn_replies -= 1
            use.replies -= 1
            self._edge.replies -= 1
            return True
        self._refuse(peer)
        return False

    @property
    def is_turn_over(self) -> bool:
        """Whether the CPU time of the turn is spent: leave further inputs in the queue of the kernel."""
        return self._mark_ns >= self._turn_end_ns

    @property
    def is_spent(self) -> bool:
        """Whether all peers together have spent the budget of the edge: do not read inputs until later."""
        return self._edge.cpu_ns <= 0

    def problem(self, now_ns: int) -> str:
        """Return a sentence that names the peer of the last refusal; empty if it is older than 10 s."""
        if self._refused_ns is None or now_ns - self._refused_ns > SHOWN_NS:
            return ""
        return (
            f"{self._refused_peer} sends more than imud processes: {self.refused} inputs ignored or delayed until now"
        )

    def _charge(self) -> None:
        cpu_ns = self._cpu_ns()
        if self._working is not None:
            spent_ns = cpu_ns - self._mark_ns
            self._working.charge(spent_ns)
            self._edge.charge(spent_ns)
        self._mark_ns = cpu_ns

    def _use(self, peer: Hashable) -> _Use:
        use = self._uses.get(peer)
        if use is None:
            if len(self._uses) >= self._limits.peers:
                self._remove_idle()
            use = self._uses[peer] = _Use(self._limits, self._now_ns)
        else:
            use.refill(self._now_ns)
        return use

    def _remove_idle(self) -> None:
        """Forget the peers that have their whole budget, otherwise the peer with the largest remaining budget."""
        for peer, use in list(self._uses.items()):
            use.refill(self._now_ns)
            if use.is_full:
                del self._uses[peer]
        if len(self._uses) >= self._limits.peers:
            del self._uses[max(self._uses, key=lambda peer: self._uses[peer].cpu_ns)]

    def _refuse(self, peer: Hashable) -> None:
        self.refused += 1
        self._refused_peer = peer
        self._refused_ns = self._now_ns
