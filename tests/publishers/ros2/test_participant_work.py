"""Work that other participants cause: the most expensive valid inputs against the budget of a turn and of a second.

The CPU clock of these tests advances with each reading, so that the results do not depend on the speed of the host. The
cost of one submessage is the number of executed lines of imud.
"""

import asyncio
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any

import pytest

from imud.formats import rtps
from imud.formats.rtps import Locator
from imud.model.work_budget import EDGE_FACTOR
from imud.publishers.ros2.network import INPUT_LIMITS
from imud.publishers.ros2.participant import READS_PER_TURN, RtpsParticipant
from imud.publishers.ros2.peers import PEER_READERS_MAX, RtpsPeer
from tests.support.rtps import (
    PREFIX,
    READER,
    ROBOT,
    TOPIC,
    TYPE,
    FakeNetwork,
    announcement,
    end_of_reader,
    request,
    subscription,
    subscriptions_heartbeat,
)

S = 1_000_000_000
DATAGRAM_BYTES = 65_000
STEP_NS = 20_000  # CPU time between two readings of the clock, ns: the cost of a cheap submessage
LINES_MAX = 9_000  # maximum cost of one submessage, executed lines: 1 ms at 0.1 us
TOPICS = 100
ALL = range(1, rtps.BITS_MAX + 1)


class SteppingCpu:
    """CPU clock that advances with each reading."""

    def __init__(self) -> None:
        self.time_ns = 0
        self.step_ns = 0

    def __call__(self) -> int:
        self.time_ns += self.step_ns
        return self.time_ns


class CountedParticipant(RtpsParticipant):
    """Participant that counts the processed submessages of known participants and the processed announcements."""

    count = 0

    def _of_peer(self, peer: RtpsPeer, submessage: rtps.Submessage, now_ns: int) -> None:
        self.count += 1
        super()._of_peer(peer, submessage, now_ns)

    def _participant(self, prefix: bytes, received: rtps.ReceivedData, source: str, now_ns: int) -> None:
        self.count += 1
        super()._participant(prefix, received, source, now_ns)


class CountedReader(rtps.RtpsReader):
    """Reader that counts the submessages that it reads."""

    count = 0

    def read(self, datagram: bytes) -> tuple[bytes, Iterator[rtps.Submessage | None]]:
        prefix, submessages = super().read(datagram)
        return prefix, map(self._count, submessages)

    def _count(self, submessage: rtps.Submessage | None) -> rtps.Submessage | None:
        CountedReader.count += 1
        return submessage


class Bench:
    """A participant with 100 topics, 256 readers of a robot, and full tables of other participants."""

    def __init__(self) -> None:
        self.cpu = SteppingCpu()
        self.network = FakeNetwork(self.cpu)
        self.participant = CountedParticipant(0, None, "imud", lambda: 0, network=self.network)
        self.writers = [self.participant.add(f"{TOPIC}{number}", TYPE, "RIHS01_0") for number in range(TOPICS)]
        for number in range(127):
            prefix = b"other" + number.to_bytes(7, "big")
            self.receive(announcement(prefix))
        for number in range(200):
            where = Locator(f"192.0.2.{20 + number}", 7411)
            self.receive(announcement(b"third" + number.to_bytes(7, "big"), [where]), where.address)
        self.receive(announcement())
        for number in range(PEER_READERS_MAX):
            topic = f"{TOPIC}{number % TOPICS}"
            self.receive(rtps.header(PREFIX) + subscription(entity(number), number + 1, topic=topic))
        self.receive(rtps.header(PREFIX) + request(rtps.PUBLICATIONS_WRITER, 1, [], rtps.PUBLICATIONS_READER))
        for writer in self.writers:
            for _ in range(20):
                writer.write(bytes(300), 0)
        assert sum(len(writer.readers) for writer in self.writers) == PEER_READERS_MAX
        self.network.take()

    def receive(self, datagram: bytes, source: str = ROBOT.address, now_ns: int = 0) -> None:
        self.participant.received(datagram, source, now_ns)


def entity(number: int) -> bytes:
    return number.to_bytes(3, "big") + READER[3:]


def move(number: int) -> bytes:
    """Return the announcement of another port: imud must change the destination of all readers."""
    return announcement(locators=[Locator(ROBOT.address, 8000 + number % 2)])[rtps.HEADER_BYTES :]


def many_parameters(number: int) -> bytes:
    payload = rtps.PL_CDR_LE + rtps.parameters([(rtps.P_UNICAST, rtps.locator(ROBOT))] * 250)
    return rtps.data(rtps.SUBSCRIPTIONS_WRITER, number + 1, payload, key=PREFIX + READER)


def new_reader(number: int) -> bytes:
    return subscription(entity(5000 + number), number + 1, topic=f"{TOPIC}0")


def changed_reader(number: int) -> bytes:
    return subscription(entity(1), number + 1, topic=f"{TOPIC}{number % TOPICS}")


def gap_of_descriptions(number: int) -> bytes:
    numbers = [2 * index + 1 + number for index in range(rtps.BITS_MAX // 2)]
    return rtps.gap(rtps.SUBSCRIPTIONS_WRITER, rtps.SUBSCRIPTIONS_READER, numbers)


def end_of_participant(_number: int) -> bytes:
    return announcement(ended=True)[rtps.HEADER_BYTES :]


INPUTS: dict[str, Callable[[int], bytes]] = {
    "ACKNACK of 256 samples": lambda _: request(b"\0\0\1\3", 1, list(ALL), entity(0)),
    "ACKNACK without samples": lambda _: request(b"\0\0\1\3", 1, [], entity(0)),
    "ACKNACK of 256 descriptions": lambda _: request(rtps.PUBLICATIONS_WRITER, 1, list(ALL), rtps.PUBLICATIONS_READER),
    "ACKNACK of other readers": lambda number: request(
        (number % TOPICS + 1).to_bytes(3, "big") + b"\3", 1, list(ALL), entity(number % PEER_READERS_MAX)
    ),
    "HEARTBEAT": lambda _: subscriptions_heartbeat(1, 10_000),
    "GAP": gap_of_descriptions,
    "end of an unknown reader": lambda _: end_of_reader(b"zzzz"),
    "end of known readers": lambda number: end_of_reader(entity(number % PEER_READERS_MAX)),
    "new readers": new_reader,
    "changed reader": changed_reader,
    "many parameters": many_parameters,
    "announcements of another port": move,
    "end of the participant": end_of_participant,
    "empty submessages": lambda _: b"\x01\x01\0\0",
}


def filled(make: Callable[[int], bytes]) -> bytes:
    """Return a datagram that is full of submessages."""
    message = rtps.header(PREFIX)
    number = 0
    while len(message) < DATAGRAM_BYTES:
        message += make(number)
        number += 1
    return message


@pytest.fixture(scope="module")
def datagrams() -> dict[str, bytes]:
    return {name: filled(make) for name, make in INPUTS.items()}


@contextmanager
def counted_lines() -> Iterator[list[int]]:
    """Count the executed lines of imud."""
    count = [0]

    def trace(frame: FrameType, event: str, _argument: Any) -> Any:
        if event == "line":
            count[0] += 1
        return trace if "/imud/" in frame.f_code.co_filename else None

    previous = sys.gettrace()
    sys.settrace(trace)
    try:
        yield count
    finally:
        sys.settrace(previous)


@pytest.mark.parametrize("name", INPUTS)
def test_a_datagram_has_the_budget_of_a_turn(
    monkeypatch: pytest.MonkeyPatch, name: str, datagrams: dict[str, bytes]
) -> None:
    """Each reading of the CPU clock is a submessage: 1 ms permits 50. A datagram has up to 16,000 submessages."""
    monkeypatch.setattr(rtps, "RtpsReader", CountedReader)
    bench = Bench()
    CountedReader.count = 0
    bench.cpu.step_ns = STEP_NS
    bench.receive(datagrams[name], now_ns=S)
    assert 1 <= CountedReader.count <= INPUT_LIMITS.turn_cpu_ns // STEP_NS
    assert len(bench.network.sent) <= INPUT_LIMITS.turn_replies
    assert bench.participant.discarded >= 1
    assert ROBOT.address in bench.participant.problem


@pytest.mark.parametrize("name", INPUTS)
def test_a_submessage_is_cheap(name: str) -> None:
    """The state is as large as the limits permit. The limit belongs to the line count, not to the time."""
    bench = Bench()
    message = rtps.header(PREFIX) + INPUTS[name](0)
    with counted_lines() as count:
        bench.receive(message, now_ns=S)
    assert count[0] <= LINES_MAX, f"{count[0]} lines"


def test_a_new_participant_in_a_full_table_is_cheap() -> None:
    bench = Bench()
    with counted_lines() as count:
        bench.receive(announcement(b"new one12345"))
    assert count[0] <= LINES_MAX, f"{count[0]} lines"


def test_requests_of_a_second_have_a_budget(datagrams: dict[str, bytes]) -> None:
    """One host sends requests in 10,000 turns of one second: replies and CPU time of one second, not more."""
    bench = Bench()
    bench.cpu.step_ns = STEP_NS
    bench.participant.count = 0
    for turn in range(10_000):
        bench.receive(datagrams["ACKNACK of other readers"][:1000], now_ns=S + turn * S // 10_000)
    assert 0 < bench.participant.count <= 2 * INPUT_LIMITS.second_cpu_ns // STEP_NS, (
        "the budget of a second, and its refill"
    )
    assert len(bench.network.sent) <= 2 * INPUT_LIMITS.second_replies


def test_many_false_sources_share_the_budget_of_the_edge() -> None:
    """Each datagram has another source in the network."""
    bench = Bench()
    bench.cpu.step_ns = STEP_NS
    bench.participant.count = 0
    for number in range(20_000):
        source = f"192.0.2.{10 + number % 240}"
        bench.receive(announcement(number.to_bytes(12, "big"), [Locator(source, 9)]), source, S)
    assert 0 < bench.participant.count <= EDGE_FACTOR * INPUT_LIMITS.second_cpu_ns // STEP_NS
    assert len(bench.network.sent) <= EDGE_FACTOR * INPUT_LIMITS.second_replies


def test_a_flood_leaves_datagrams_in_the_kernel(monkeypatch: pytest.MonkeyPatch, datagrams: dict[str, bytes]) -> None:
    """A turn reads until its CPU time ends, at most 32 datagrams. If the budget of all peers is spent, imud reads again
    at the next tick."""
    readers: dict[int, Callable[[], None]] = {}

    class Loop:
        def add_reader(self, descriptor: int, callback: Callable[..., None], *arguments: Any) -> None:
            readers[descriptor] = partial(callback, *arguments)

        def remove_reader(self, descriptor: int) -> None:
            readers.pop(descriptor, None)

    monkeypatch.setattr(asyncio, "get_running_loop", Loop)
    bench = Bench()
    bench.participant.open()
    (read,) = readers.values()
    flooded = bench.network.socket
    flooded.flood = datagrams["ACKNACK of 256 samples"]
    read()
    assert flooded.reads == READS_PER_TURN, "without CPU time"
    bench.cpu.step_ns = STEP_NS
    turns = 0
    while readers:
        turns += 1
        read()
    budget = EDGE_FACTOR * INPUT_LIMITS.second_cpu_ns
    assert flooded.reads <= READS_PER_TURN + budget // STEP_NS
    assert turns <= budget // STEP_NS
    bench.participant.tick(S)
    assert list(readers.values()), "imud reads again"
    flooded.flood = b""
    bench.participant.close()
    assert not readers
