"""Address claim, contention, requests and commands of a node, with the time as argument."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import nmea2000
from imud.formats.j1939 import J1939Id, join, split
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.nmea2000 import node as module
from imud.publishers.nmea2000.address import Message
from imud.publishers.nmea2000.node import Node, NodeIdentity

NAME = nmea2000.pack_name(1000)
LOWER, HIGHER = NAME - 1, NAME + 1
CLAIM_NS = 250 * NS_PER_MS
IDENTITY = NodeIdentity(NAME, b"P" * 134, b"C" * 10, (127250,))


def claim(name: int, source: int) -> tuple[int, bytes]:
    return join(J1939Id(6, 60928, source)), name.to_bytes(8, "little")


def request(pgn: int, destination: int, source: int = 9) -> tuple[int, bytes]:
    return join(J1939Id(6, 59904, source, destination)), pgn.to_bytes(3, "little")


def sources(messages: list[Message]) -> list[tuple[int, int]]:
    """Return PGN and source of the first frame of each message."""
    return [(split(one[0].can_id).pgn, split(one[0].can_id).source) for one in messages]


class Rig:
    def __init__(self, preferred: int = 128) -> None:
        self.node = Node(IDENTITY, preferred)
        self.now_ns = NS_PER_S
        assert self.node.start(self.now_ns) == [[claim(NAME, preferred)]]

    def settle(self) -> "Rig":
        self.now_ns += CLAIM_NS
        self.node.tick(self.now_ns)
        return self

    def hear(self, frame: tuple[int, bytes]) -> list[Message]:
        return self.node.receive(*frame, self.now_ns)

    @property
    def address(self) -> int | None:
        return self.node.address(self.now_ns)


def test_an_address_without_objection_is_used_after_250_ms() -> None:
    rig = Rig()
    rig.now_ns += CLAIM_NS - 1
    assert (rig.address, rig.node.message(127250, 2, b"12345678", rig.now_ns)) == (None, None)
    rig.now_ns += 1
    assert rig.address == 128
    assert rig.node.message(127250, 2, b"12345678", rig.now_ns) == [(0x09F11280, b"12345678")]
    heard = [rig.node.tick(rig.now_ns + n * NS_PER_S) for n in range(121)]
    beats = [(n, messages[0][0]) for n, messages in enumerate(heard) if messages]
    assert [(n, frame.can_id, frame.data.hex()) for n, frame in beats] == [
        (n * 60, 0x1DF01180, f"7017{n:02x}ccffffffff") for n in range(3)
    ]


@pytest.mark.parametrize("settled", [False, True])
@pytest.mark.parametrize(("name", "address"), [(HIGHER, 128), (LOWER, 129)])
def test_the_smaller_name_keeps_the_address(name: int, address: int, settled: bool) -> None:
    rig = Rig().settle() if settled else Rig()
    assert rig.hear(claim(name, 128)) == [[claim(NAME, address)]]
    assert rig.address == (128 if settled and address == 128 else None)
    assert (rig.settle().address, rig.node.preferred, rig.node.claims_lost) == (address, address, address - 128)


def test_used_addresses_are_skipped_up_to_the_last() -> None:
    rig = Rig(preferred=250)
    for name, source in ((1, 251), (2, 0), (3, 1), (4, 252), (5, 254)):
        assert rig.hear(claim(name, source)) == []
    assert rig.hear(claim(3, 7)) == []  # this node left address 1
    assert rig.hear(claim(9, 250)) == [[claim(NAME, 1)]]


def test_without_a_free_address_the_node_is_silent_and_tries_again() -> None:
    rig, started_ns = Rig().settle(), None
    for source in range(252):
        assert rig.hear(claim(source, source)) == ([[claim(NAME, 129 + source - 128)]] if 128 <= source < 251 else [])
    assert (rig.address, rig.node.message(127250, 2, bytes(8), rig.now_ns)) == (None, None)
    assert rig.node.problem == "expected a free address on the network, got 252 used addresses; disconnect other nodes"
    assert rig.node.tick(rig.now_ns) == []
    rig.now_ns += 153 * NS_PER_MS
    assert rig.node.tick(rig.now_ns) == [[claim(NAME, 254)]]
    assert rig.node.tick(rig.now_ns) == []
    assert rig.hear(request(60928, 255)) == [[claim(NAME, 254)]]
    started_ns = rig.now_ns
    while not (again := rig.node.tick(rig.now_ns)):
        rig.now_ns += NS_PER_MS * 100
    assert 9 < (rig.now_ns - started_ns) / NS_PER_S < 11
    assert (again, rig.node.problem, rig.settle().address) == ([[claim(NAME, 251)]], "", 251)


def test_requests_to_the_node_and_to_all_nodes() -> None:
    rig = Rig()
    assert rig.hear(request(60928, 255)) == [[claim(NAME, 128)]]  # also before the end of the claim
    assert rig.hear(request(126996, 128)) == []
    rig.settle()
    assert rig.hear(request(126996, 77)) == []  # to another node
    for pgn, destination, frames in (
        (126996, 128, [20]),
        (126998, 255, [2]),
        (126464, 128, [4, 3]),
        (126993, 128, [1]),
    ):
        messages = rig.hear(request(pgn, destination))
        assert ([len(one) for one in messages], {pgn for pgn, _ in sources(messages)}) == (frames, {pgn})
        assert (rig.hear(request(pgn, destination)), rig.node.refused) == ([], 1)  # too soon
        rig.node.refused = 0
        rig.now_ns += NS_PER_S
    assert rig.hear(request(127508, 255)) == []
    assert rig.hear(request(127508, 128)) == [[(0x18E8FF80, bytes.fromhex("01ffffff0914f201"))]]
    newest = rig.node.message(127250, 2, b"12345678", rig.now_ns)
    assert rig.hear(request(127250, 128)) == [newest]
    rig.now_ns += module.NEWEST_NS
    assert sources(rig.hear(request(127250, 128))) == [(59392, 128)]  # without a new sample


@pytest.mark.parametrize(
    ("name", "address", "wrong", "moved"),
    [(NAME, 40, "", True), (NAME, 252, "", False), (NAME, 128, "", False), (HIGHER, 40, "", False),
     (NAME, 40, "order", False), (NAME, 40, "late", False), (NAME, 40, "source", False), (NAME, 40, "short", False)],
)  # fmt: skip
def test_a_commanded_address(name: int, address: int, wrong: str, moved: bool) -> None:
    rig, data = Rig().settle(), name.to_bytes(8, "little") + bytes((address,))
    control, transport = join(J1939Id(7, 60416, 9)), join(J1939Id(7, 60160, 10 if wrong == "source" else 9))
    assert rig.hear((control, bytes.fromhex("20 0900 02 ff d8fe00"))) == []
    first = bytes((1 + (wrong == "order"),)) + data[:7]
    assert rig.hear((transport, first[: 7 if wrong == "short" else 8])) == []
    rig.now_ns += NS_PER_S if wrong == "late" else 0
    answer = rig.hear((transport, b"\2" + data[7:].ljust(7, b"\xff")))
    assert (answer, rig.settle().address) == (([[claim(NAME, 40)]], 40) if moved else ([], 128))


PGNS = st.sampled_from((59904, 60928, 60416, 60160, 59392, 127250))
FRAMES = st.tuples(
    PGNS, st.integers(0, 255), st.sampled_from((128, 129, 255)), st.integers(0, 300), st.binary(max_size=8)
)


@given(st.lists(FRAMES, max_size=60))
def test_hostile_frames_have_bounded_replies(frames: list[tuple[int, int, int, int, bytes]]) -> None:
    rig = Rig()
    for pgn, source, destination, wait_ms, data in frames:
        rig.now_ns += wait_ms * NS_PER_MS
        can_id = 6 << 26 | pgn << 8 | source if pgn > 0xF000 else 6 << 26 | pgn << 8 | destination << 8 | source
        messages = [*rig.hear((can_id, data)), *rig.node.tick(rig.now_ns)]
        assert sum(map(len, messages)) <= 22
        assert all(len(frame.data) <= 8 for message in messages for frame in message)
        assert {source for _, source in sources(messages)} <= {*range(252), 254}
