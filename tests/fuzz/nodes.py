"""The complete node of the output `nmea2000`, with any frames of other nodes and virtual time.

An input is the first address, then steps. A step is: its kind, the time since the previous step in steps of STEP_NS, an
argument, the number of data bytes, and the data. The node never raises an exception. The frames that it sends in a
second and its stored state have limits.
"""

from collections import deque
from collections.abc import Sequence
from random import Random
from typing import Final

from imud.formats import nmea2000
from imud.formats.can import DATA_BYTES_MAX
from imud.formats.j1939 import (
    ACKNOWLEDGEMENT,
    CLAIMED,
    GLOBAL,
    NULL_ADDRESS,
    PDU2_MIN,
    REQUEST,
    TRANSPORT_CONTROL,
    TRANSPORT_DATA,
    split,
)
from imud.formats.nmea2000 import ADDRESS_LAST, HEADING
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.model.work_budget import EDGE_FACTOR
from imud.publishers.nmea2000.address import Message, NodeFrame
from imud.publishers.nmea2000.node import FRAME_PAUSE_NS, LIMITS, Node, NodeIdentity
from tests.fuzz.target import FRAMES_BYTES_MAX, Target

STEP_NS: Final = 250_000  # 250 us: about one frame at 250 kbit/s
TICK_NS: Final = 100 * NS_PER_MS
PGNS: Final = (CLAIMED, REQUEST, TRANSPORT_CONTROL, TRANSPORT_DATA, ACKNOWLEDGEMENT, HEADING)
# Kinds of steps above the indexes of PGNS
ECHO, PUBLISH, WAIT, OWN_CLAIM = range(len(PGNS), len(PGNS) + 4)
KINDS: Final = OWN_CLAIM + 1
NAME: Final = nmea2000.pack_name(1000)
IDENTITY: Final = NodeIdentity(NAME, nmea2000.pack_product("imud", "1", "1"), b"C" * 10, (HEADING,))
ECHOED_FRAMES_MAX: Final = 32
# Maximum number of sent frames in one second. Each PGN that imud sends on request has a pause of FRAME_PAUSE_NS for
# each frame, and at most 20 frames before its first pause. Claims without a pause have the budget of all nodes, which
# is full at the start of the second.
REPLY_PGNS: Final = 7
FRAMES_PER_SECOND_MAX: Final = REPLY_PGNS * (NS_PER_S // FRAME_PAUSE_NS + 20) + 2 * EDGE_FACTOR * LIMITS.second_replies


def names() -> Sequence[str]:
    return ["nmea2000"]


def make(_name: str) -> Target:
    return Target(run, seeds, bytes_max=FRAMES_BYTES_MAX)


class _Bench:
    """A node with virtual time. It checks all sent frames."""

    def __init__(self, first_address: int) -> None:
        self.node = Node(IDENTITY, first_address % (ADDRESS_LAST + 1), random=Random(1))
        self.now_ns = 0
        self.tick_ns = 0
        self.echoes: deque[NodeFrame] = deque(maxlen=ECHOED_FRAMES_MAX)
        self._sent_ns: deque[int] = deque()
        self.send(self.node.start(self.now_ns))

    def send(self, messages: Sequence[Message]) -> None:
        for message in messages:
            for frame in message:
                source = split(frame.can_id).source
                assert source <= ADDRESS_LAST or source == NULL_ADDRESS
                assert len(frame.data) <= DATA_BYTES_MAX
                self.echoes.append(frame)
                self._sent_ns.append(self.now_ns)
        while self._sent_ns and self.now_ns - self._sent_ns[0] >= NS_PER_S:
            self._sent_ns.popleft()
        assert len(self._sent_ns) <= FRAMES_PER_SECOND_MAX

    def advance(self, duration_ns: int) -> None:
        end_ns = self.now_ns + duration_ns
        while self.tick_ns <= end_ns:
            self.now_ns = max(self.now_ns, self.tick_ns)
            self.tick_ns += TICK_NS
            self.send(self.node.tick(self.now_ns))
        self.now_ns = end_ns

    def receive(self, can_id: int, data: bytes) -> None:
        self.send(self.node.receive(can_id, data, self.now_ns))
        self.node.end_turn()

    def check_state(self) -> None:
        node = self.node
        address = node._address
        assert len(address._owners) <= ADDRESS_LAST + 1
        assert len(address._sent_ns) <= ADDRESS_LAST + 2
        assert len(node._budget._uses) <= LIMITS.peers
        assert len(node._replied_ns) <= REPLY_PGNS
        assert node.problem.isprintable()
        assert node.peer_problem(self.now_ns).isprintable()
        assert (node.claimed is None) <= bool(node.problem)


def run(data: bytes) -> None:
    if not data:
        return
    bench = _Bench(data[0])
    offset = 1
    while offset + 4 <= len(data):
        kind, steps, argument, size = data[offset : offset + 4]
        payload = data[offset + 4 : offset + 4 + min(size, DATA_BYTES_MAX)]
        offset += 4 + len(payload)
        bench.advance(steps * STEP_NS)
        _take_step(bench, kind % KINDS, argument, payload)
    bench.check_state()
    bench.advance(2 * NS_PER_S)
    bench.check_state()


def _take_step(bench: _Bench, kind: int, argument: int, payload: bytes) -> None:
    claimed = bench.node.claimed if bench.node.claimed is not None else NULL_ADDRESS
    if kind == ECHO:
        for frame in [*bench.echoes][: argument % (ECHOED_FRAMES_MAX + 1)]:
            bench.receive(*frame)
    elif kind == PUBLISH:
        message = bench.node.message(HEADING, 2, payload.ljust(DATA_BYTES_MAX, b"\xff"), bench.now_ns)
        bench.send([message] if message else [])
        bench._sent_ns.clear()  # imud decides how often it publishes
    elif kind == WAIT:
        bench.advance(argument * TICK_NS)
    elif kind == OWN_CLAIM:
        source = claimed if argument & 1 else argument
        bench.receive(6 << 26 | (CLAIMED | GLOBAL) << 8 | source, NAME.to_bytes(8, "little"))
    else:
        pgn = PGNS[kind]
        destination = claimed if argument & 1 else GLOBAL
        source = claimed if argument & 2 else argument
        group = pgn if pgn >> 8 & 0xFF >= PDU2_MIN else pgn | destination
        bench.receive(6 << 26 | group << 8 | source, payload)


def _step(kind: int, steps: int, argument: int, payload: bytes = b"") -> bytes:
    return bytes((kind, steps, argument, len(payload))) + payload


def seeds() -> list[bytes]:
    """Return the usual life of a node, and each attack for about one second."""
    weaker, stronger = (name.to_bytes(8, "little") for name in (NAME + 1, NAME - 1))
    own = NAME.to_bytes(8, "little")
    requests = [
        _step(1, 4, 9, pgn.to_bytes(3, "little")) for pgn in (CLAIMED, 126996, 126998, 126464, 126993, HEADING, 1)
    ]
    command = [
        _step(2, 4, 9, bytes.fromhex("20 0900 02 ff d8fe00")),
        _step(3, 4, 9, b"\1" + own[:7]),
        _step(3, 4, 9, b"\2" + own[7:] + bytes((40,)) + b"\xff" * 5),
    ]
    settle = _step(WAIT, 0, 4)
    rows: list[list[bytes]] = [
        [settle, *requests, *command, _step(PUBLISH, 9, 0, b"12345678"), *requests],
        [settle, *(_step(ECHO, 4, 1) for _ in range(60)), _step(WAIT, 0, 100)],
        [settle, *(_step(OWN_CLAIM, 40, 1) for _ in range(60))],
        [settle, *(_step(OWN_CLAIM, 40, 60 + 2 * count) for count in range(60))],
        [settle, *(_step(0, 4, 3, weaker) for _ in range(120))],
        [settle, *(_step(0, 4, 3, stronger) for _ in range(120))],
        [settle, *requests * 30],
        [settle, *command * 30],
        [_step(0, 1, source & ~3, source.to_bytes(8, "little")) for source in range(252)],
        [_step(PUBLISH, 1, 0), _step(4, 1, 3, b"x"), _step(5, 1, 1), _step(0, 1, 9, b"short"), _step(1, 1, 9, b"x")],
    ]
    return [bytes((128,)) + b"".join(row)[: FRAMES_BYTES_MAX - 1] for row in rows]
