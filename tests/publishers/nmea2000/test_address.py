"""Claims without end, echoes of own claims, and nodes with the same NAME, with the time as argument."""

from collections.abc import Callable
from itertools import pairwise
from random import Random

import pytest

from imud.formats import nmea2000
from imud.formats.j1939 import CLAIMED, REQUEST, J1939Id, join, split
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.model.work_budget import SHOWN_NS
from imud.publishers.nmea2000.address import CLAIM_NS, CONFLICT_SHOWN_NS, ECHO_NS, PROBES, Message, NodeFrame
from imud.publishers.nmea2000.node import LIMITS, Node, NodeIdentity

NAME = nmea2000.pack_name(1000)
IDENTITY = NodeIdentity(NAME, b"P" * 134, b"C" * 10, (127250,))
SECOND_MS = 1000


def claim(name: int, source: int) -> NodeFrame:
    return NodeFrame(join(J1939Id(6, CLAIMED, source)), name.to_bytes(8, "little"))


def request(pgn: int, destination: int, source: int = 9) -> NodeFrame:
    return NodeFrame(join(J1939Id(6, REQUEST, source, destination)), pgn.to_bytes(3, "little"))


def claims(messages: list[Message]) -> list[int]:
    """Return the sources of the claims."""
    frames = [frame for message in messages for frame in message]
    return [split(frame.can_id).source for frame in frames if split(frame.can_id).pgn == CLAIMED]


class Network:
    """Nodes with equal NAMEs on one bus. Each frame arrives at each other node, and `echo_ms` later at its sender."""

    def __init__(self, count: int, echo_ms: int | None = None) -> None:
        self.nodes = [Node(IDENTITY, 128, random=Random(seed)) for seed in range(count)]
        self.now_ms = SECOND_MS
        self.claims: list[int] = []  # sources of all claims
        self._echo_ms = echo_ms
        self._queue: list[tuple[int, int, NodeFrame]] = []  # arrival time, receiver, frame

    @property
    def now_ns(self) -> int:
        return self.now_ms * NS_PER_MS

    def start(self, index: int) -> None:
        self.send(index, self.nodes[index].start(self.now_ns))

    def send(self, index: int, messages: list[Message]) -> None:
        self.claims += claims(messages)
        for message in messages:
            for frame in message:
                others = [(1, receiver) for receiver in range(len(self.nodes)) if receiver != index]
                echoes = [] if self._echo_ms is None else [(self._echo_ms, index)]
                self._queue += [(self.now_ms + delay_ms, receiver, frame) for delay_ms, receiver in others + echoes]

    def run(self, duration_ms: int, tick_ms: int = 100) -> None:
        for _ in range(duration_ms):
            self.now_ms += 1
            arrived = [entry for entry in self._queue if entry[0] <= self.now_ms]
            self._queue = [entry for entry in self._queue if entry[0] > self.now_ms]
            for _, receiver, frame in arrived:
                self.send(receiver, self.nodes[receiver].receive(*frame, self.now_ns))
            if self.now_ms % tick_ms == 0:
                for index, node in enumerate(self.nodes):
                    if node.claimed is not None:
                        self.send(index, node.tick(self.now_ns))

    def addresses(self) -> list[int | None]:
        return [node.address(self.now_ns) for node in self.nodes]


@pytest.mark.parametrize("echo_ms", [1, 100, 249])
def test_echo_of_claim_keeps_address(echo_ms: int) -> None:
    network = Network(1, echo_ms)
    network.start(0)
    network.run(60 * SECOND_MS)
    node = network.nodes[0]
    assert (network.addresses(), node.problem, network.claims) == ([128], "", [128] * (1 + PROBES))
    assert node.ignored == 1 + PROBES


@pytest.mark.parametrize("echo_ms", [300, 2000])
def test_late_echo_is_reported(echo_ms: int) -> None:
    network = Network(1, echo_ms)
    network.start(0)
    network.run(60 * SECOND_MS)
    assert len(network.claims) <= 10
    assert network.addresses() != [None]
    assert network.nodes[0].problem.startswith(f"another node has the NAME {NAME:016X} of this gateway")


@pytest.mark.parametrize("start_ms", [0, 1, 100, 250, 5000])
def test_two_nodes_with_one_name(start_ms: int) -> None:
    network = Network(2)
    network.start(0)
    network.run(start_ms)
    network.start(1)
    network.run(60 * SECOND_MS)
    first, second = network.addresses()
    assert None not in (first, second)
    assert first != second
    assert all("another node has the NAME" in node.problem for node in network.nodes)
    assert len(network.claims) <= 20


def test_conflict_is_shown_while_other_node_is_present() -> None:
    network = Network(2)
    network.start(0)
    network.run(5 * SECOND_MS)
    network.start(1)
    network.run(CONFLICT_SHOWN_NS // NS_PER_MS + 60 * SECOND_MS)
    assert all(node.problem for node in network.nodes)

    node = network.nodes[0]
    for second in range(CONFLICT_SHOWN_NS // NS_PER_S + 1):
        node.tick(network.now_ns + second * NS_PER_S)
    assert node.problem == ""


def test_replayed_name_changes_address_after_growing_pauses() -> None:
    node = Node(IDENTITY, 128, random=Random(1))
    node.start(0)
    now_ns, changes_ns = 0, list[int]()
    while now_ns < 100 * NS_PER_S:
        now_ns += NS_PER_MS
        assert node.claimed is not None
        if now_ns % ECHO_NS and claims(node.receive(*claim(NAME, node.claimed), now_ns)):
            changes_ns.append(now_ns)
    pauses_s = [round((end - start) / NS_PER_S) for start, end in pairwise(changes_ns)]
    assert pauses_s == [1, 2, 4, 8, 16, 32]
    assert node.address(now_ns) is not None


def _weaker(node: Node, count: int) -> NodeFrame:
    return claim(NAME + 1, 128)


def _stronger(node: Node, count: int) -> NodeFrame:
    return claim(NAME - 1, node.claimed if node.claimed is not None else 128)


def _command(node: Node, count: int) -> NodeFrame:
    data = NAME.to_bytes(8, "little") + bytes((count % 200,))
    rows = (
        NodeFrame(join(J1939Id(7, 60416, 9)), bytes.fromhex("20 0900 02 ff d8fe00")),
        NodeFrame(join(J1939Id(7, 60160, 9)), b"\1" + data[:7]),
        NodeFrame(join(J1939Id(7, 60160, 9)), b"\2" + data[7:].ljust(7, b"\xff")),
    )
    return rows[count % 3]


def _request(node: Node, count: int) -> NodeFrame:
    return request((CLAIMED, 126996, 126464, 127508)[count % 4], node.claimed or 0)


@pytest.mark.parametrize(
    ("attack", "peer"),
    [
        (_weaker, f"the node with NAME {NAME + 1:016X}"),
        (_stronger, f"the node with NAME {NAME - 1:016X}"),
        (_command, "the node with address 9"),
        (_request, "the node with address 9"),
    ],
)
def test_replies_to_one_peer_are_limited(attack: Callable[[Node, int], NodeFrame], peer: str) -> None:
    """1,000 frames in one second: at most the full budget and the budget of this second."""
    node = Node(IDENTITY, 128)
    node.start(0)
    messages = 0
    for count in range(1000):
        now_ns = CLAIM_NS + count * NS_PER_MS
        messages += len(node.receive(*attack(node, count), now_ns))
    assert 1 <= messages <= 2 * LIMITS.second_replies
    now_ns = CLAIM_NS + NS_PER_S
    problems = f"{node.problem} {node.peer_problem(now_ns)}"
    assert peer in problems
    assert node.peer_problem(now_ns + SHOWN_NS) == ""


def test_frames_above_cpu_time_of_turn_are_ignored() -> None:
    """Each frame takes 0.5 ms of CPU time: the fourth frame of a turn is above 2 ms."""
    cpu_ns = iter(range(0, NS_PER_S, NS_PER_MS // 2))
    node = Node(IDENTITY, 128, lambda: next(cpu_ns))
    node.start(0)
    replies = [len(node.receive(*request(CLAIMED, 255, source), CLAIM_NS)) for source in range(20)]
    assert sum(replies) == 1  # the pause permits one reply
    assert node.ignored == 17
    assert node.peer_problem(CLAIM_NS).startswith("the node with address 19 sends more than imud processes")
    node.end_turn()
    assert len(node.receive(*request(CLAIMED, 255, 30), CLAIM_NS + NS_PER_S)) == 1
