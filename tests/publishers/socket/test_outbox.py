"""Slow clients delay no other client. imud drops their oldest samples first and reports the number."""

import asyncio
import json
import os
import random
import socket
import sys
import tracemalloc
from contextlib import suppress

import pytest
from msgspec.json import encode

from imud.formats.jsonrpc import encode_notification
from imud.formats.slot import SLOT_BYTES, decode_slot
from imud.model.event import Event, EventKind
from imud.publishers.socket.client import BYTE, ClientConnection
from imud.publishers.socket.outbox import NO_FD, BinaryEncoding, Delivery, JsonEncoding, Limits, Outbox, Pool
from imud.publishers.socket.server import SocketServer
from tests.support import socket_rig
from tests.support.socket_rig import Peer, batch, in_server, run, until

REPLY_BYTES, SAMPLE_BYTES = 200, 300


async def read_samples(peer: Peer, last: dict[str, int]) -> list[tuple[str, int, dict[str, int]]]:
    """Return device, seq and the reported drops of each sample, up to the last sample of each device."""
    seen: list[tuple[str, int, dict[str, int]]] = []
    reported: dict[str, int] = {}
    left = dict(last)
    while left:
        if peer.framed and len(body := await peer.body()) % SLOT_BYTES == 0:
            device = ("imu0", "imu1")[body[60]]
            seq = decode_slot(body, device).seq
        else:
            message = await peer.message() if not peer.framed else json.loads(body)
            params = message["params"]
            if "dropped" in params:
                assert params["device"] not in reported
                reported[params["device"]] = params["dropped"]
            if message["method"] == "dropped":
                continue
            device, seq = params["device"], params["seq"]
        seen.append((device, seq, reported))
        reported = {}
        if left.get(device) == seq:
            del left[device]
    return seen


def assert_accounted(seen: list[tuple[str, int, dict[str, int]]], devices: tuple[str, ...]) -> dict[str, int]:
    """Assert that each sample arrived in order or was reported as dropped. Return the drops by device."""
    dropped = dict.fromkeys(devices, 0)
    newest = dict.fromkeys(devices, 0)
    for device, seq, reported in seen:
        for name, count in reported.items():
            dropped[name] += count
        assert seq > newest[device]
        newest[device] = seq
    for device in devices:
        assert sum(name == device for name, _, _ in seen) + dropped[device] == newest[device]
    return dropped


@pytest.mark.parametrize("encoding", ["json", "binary"])
@in_server(queue_samples=100)
async def test_a_client_that_does_not_read_loses_its_oldest_samples(server: SocketServer, encoding: str) -> None:
    total = 1000
    slow, fast = await Peer.greeted(server), await Peer.greeted(server)
    for peer in (slow, fast):
        await peer.result("watch", encoding=encoding)
        peer.framed = encoding == "binary"
    for seq in range(1, total + 1, 2):
        server.publish(batch("imu0", seq, 2))
        server.publish(batch("imu1", seq, 2))
        got = [await read_one(fast) for _ in range(4)]
        assert got == [("imu0", seq), ("imu0", seq + 1), ("imu1", seq), ("imu1", seq + 1)]
    first, second = sorted(server.hub.clients(), key=lambda client: client.number)
    assert first.queue_samples == 100
    assert first.queue_bytes < 200_000
    assert first.dropped > total  # of 2 × total samples
    assert (second.dropped, second.sent, second.queue_samples) == (0, 2 * total, 0)
    seen = await read_samples(slow, {"imu0": total, "imu1": total})
    assert sum(assert_accounted(seen, ("imu0", "imu1")).values()) == first.dropped
    assert sum(bool(reported) for _, _, reported in seen) == 1  # one report of all drops
    server.publish(batch("imu0", total + 1))  # the queue is empty, so this sample is sent directly
    assert [await read_one(peer) for peer in (slow, fast)] == [("imu0", total + 1)] * 2


async def read_one(peer: Peer) -> tuple[str, int]:
    if peer.framed:
        body = await peer.body()
        assert len(body) == SLOT_BYTES
        device = ("imu0", "imu1")[body[60]]
        return device, decode_slot(body, device).seq
    params = (await peer.message())["params"]
    assert "dropped" not in params
    return params["device"], params["seq"]


@in_server(queue_bytes=8192)
async def test_the_queue_is_bounded_in_bytes_too(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    await peer.result("watch")
    for seq in range(1, 1001):
        server.publish(batch("imu0", seq))
    (client,) = server.hub.clients()
    assert 0 < client.queue_samples < 40
    # the limit does not include a partly sent message
    assert client.queue_bytes <= 8192 + 1000
    assert_accounted(await read_samples(peer, {"imu0": 1000}), ("imu0",))


@in_server(queue_samples=5)
async def test_replies_keep_their_place_and_are_never_dropped(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    await peer.result("watch")
    seq = 0
    while (queue := server.hub.clients()[0].queue_samples) < 5:
        seq += 1
        server.publish(batch("imu0", seq))
    assert queue == 5
    for number in range(20):
        await peer.send(b'{"jsonrpc":"2.0","id":%d,"method":"unheard-of"}\n' % number)
    (connection,) = server.hub.connections.values()
    await until(lambda: len(connection._replies) == 20)
    for _ in range(20):
        seq += 1
        server.publish(batch("imu0", seq))
    ids: list[int] = []
    seqs: list[int] = []
    dropped = 0
    while not seqs or seqs[-1] != seq:
        message = await peer.message()
        if "id" in message:
            ids.append(message["id"])
        else:
            seqs.append(message["params"]["seq"])
            dropped += message["params"].get("dropped", 0)
    assert ids == list(range(20))
    assert len(seqs) + dropped == seq
    assert seqs[-5:] == list(range(seq - 4, seq + 1))


@in_server()
async def test_a_client_that_requests_without_reading_is_disconnected(server: SocketServer) -> None:
    asking, other = await Peer.greeted(server), await Peer.greeted(server)
    line = b'{"jsonrpc":"2.0","id":1,"method":"schema"}\n'

    async def ask_on() -> None:
        while True:
            await asking.send(line)
            await asyncio.sleep(0)

    with pytest.raises((BrokenPipeError, ConnectionResetError)):
        await ask_on()
    assert server.hub.status().evicted == 1
    assert len(await other.result("devices")) == 2


@in_server()
async def test_a_client_that_leaves_during_publish_does_not_affect_others(server: SocketServer) -> None:
    peers = [await Peer.greeted(server) for _ in range(3)]
    for peer in peers:
        await peer.result("watch")
    await peers[0].result("notify", device="imu0")
    peers[0].close()
    peers[1].close()
    server.publish(batch("imu0", 1))  # the event loop did not run: this send detects the lost client
    server.publish(batch("imu0", 2))
    assert len(server.hub.connections) == 1
    assert [(await peers[2].message())["params"]["seq"] for _ in range(2)] == [1, 2]
    peers[2].close()


@in_server(queue_samples=3)
async def test_a_descriptor_waits_behind_the_queue(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    await peer.result("watch")
    fill(server)
    (connection,) = server.hub.connections.values()
    await peer.send(b'{"jsonrpc":"2.0","id":7,"method":"notify","params":{"device":"imu0"}}\n')
    await until(lambda: bool(connection.wakers))
    server.publish(batch("imu1", 8000, 2))  # queued after the reply
    assert await descriptors(peer, connection) == 1
    await until(lambda: not connection.waiting)
    assert connection.wakers["imu0"].client_end == NO_FD  # sent, so the daemon closed its copy
    data, fds, _flags, _address = socket.recv_fds(peer.sock, 65536, 4)
    assert b'"seq":8001' in data
    assert not fds


READ_BYTES = 64


def fill(server: SocketServer) -> None:
    seq = 0
    while server.hub.clients()[0].queue_samples == 0:
        seq += 1
        server.publish(batch("imu0", seq))


async def descriptors(peer: Peer, connection: ClientConnection) -> int:
    """Read up to the reply with id 7. Return the number of received descriptors."""
    found: list[int] = []
    data = bytearray()
    at = 0
    while b'"id":7' not in data[-4096:]:
        await asyncio.sleep(0)
        try:
            got, fds, _flags, _address = socket.recv_fds(peer.sock, READ_BYTES, 4)
        except BlockingIOError:
            continue
        data += got
        if fds:
            at = len(data)
            found += fds
    assert at - READ_BYTES <= data.index(b'{"jsonrpc":"2.0","id":7,') < at  # at the start of its reply
    assert connection.wake("imu0")
    assert [os.read(fd, 64) for fd in found] == [BYTE]
    for fd in found:
        os.close(fd)
    return len(found)


@in_server()
async def test_large_replies_reach_a_client_that_has_shut_down_its_side(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    (connection,) = server.hub.connections.values()
    note = encode_notification("big", "x" * 500_000)
    connection.post(note)
    peer.sock.shutdown(1)
    await until(lambda: connection.finishing)
    assert await peer.body() == note
    assert await peer.ended()


@pytest.mark.parametrize("method", ["watch", "events", "command", "status"])
@in_server()
async def test_a_client_that_has_shut_down_its_side_gets_its_replies(server: SocketServer, method: str) -> None:
    peer = await Peer.greeted(server)
    (connection,) = server.hub.connections.values()
    parameters = {"device": "imu0", "name": "wait"} if method == "command" else {}
    socket_rig.done_late = asyncio.Event()
    await peer.send(encode({"jsonrpc": "2.0", "id": 1, "method": method, "params": parameters}) + b"\n")
    peer.sock.shutdown(socket.SHUT_WR)
    if method == "command":
        await until(lambda: connection.number in server.hub.running)
        server.tick(0)
        socket_rig.done_late.set()
    assert (await peer.message())["id"] == 1
    for number in range(3 if method in ("watch", "events") else 0):
        server.tick(0)
        server.publish(batch(first=1 + number))
        server.event(Event(1, "imu0", EventKind.UP, "is there"))
        assert (await peer.message())["method"] == {"watch": "sample", "events": "event"}[method]
    if method in ("command", "status"):
        server.tick(0)
        assert await peer.ended()
    peer.close()
    await until(lambda: connection.closed)


@in_server()
async def test_ticks_close_a_lingering_client_that_does_not_read(server: SocketServer) -> None:
    await Peer.greeted(server)
    (connection,) = server.hub.connections.values()
    connection.post(encode_notification("big", "x" * 500_000))
    connection.finish()
    for _ in range(19):
        server.tick(0)
    assert not connection.closed
    server.tick(0)
    assert connection.closed


class Trickle:
    """A socket that accepts a random number of bytes, often none."""

    def __init__(self, sock: socket.socket, rng: random.Random) -> None:
        self.sock = sock
        self.rng = rng

    def fileno(self) -> int:
        return self.sock.fileno()

    def send(self, _fd: int, data: bytes) -> int:
        if self.rng.random() < 0.3:
            raise BlockingIOError
        return self.sock.send(data[: self.rng.choice([1, 3, 10, 1000, 100_000])])


MANY = Limits(4096, 1 << 22)


class TestOutbox(Outbox):
    """An outbox without a connection. The test calls `flush`."""

    __test__ = False

    def __init__(self, sock: object, pool: Pool, uid: int = 0) -> None:
        super().__init__(sock, pool, uid)  # type: ignore[arg-type]  # a part of a socket is enough
        if isinstance(sock, Trickle | Blocked):
            self._send = sock.send

    def on_broken(self, reason: str) -> None:
        pytest.fail(reason)

    def evict(self, reason: str) -> None:
        pytest.fail(reason)

    def on_full(self) -> None: ...

    def on_deferred(self) -> None: ...

    def on_emptied(self) -> None: ...


def drained(sock: socket.socket) -> bytes:
    try:
        return sock.recv(1 << 20)
    except BlockingIOError:
        return b""


@pytest.mark.parametrize("seed", range(3))
def test_messages_stay_whole_wherever_a_send_is_cut(seed: int) -> None:
    rng = random.Random(seed)

    async def body() -> None:
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        theirs.setblocking(False)
        encoding = JsonEncoding(("sync",), framed=False)
        outbox = TestOutbox(Trickle(ours, rng), Pool(1 << 26, Limits(20, 1 << 20)))
        peer = Peer(theirs)
        seq = 0
        seen: list[tuple[str, int, dict[str, int]]] = []
        for number in range(100):
            part = batch("imu0", seq + 1, rng.choice([1, 2, 15]))
            seq += len(part.samples)
            Outbox.put_samples([outbox], encoding.encode(part), part, encoding)
            if number % 10 == 0:
                outbox.put_reply(b'{"method":"other","params":{}}\n')
            outbox.flush()
            peer.buffer += drained(theirs)
        while outbox.waiting:
            outbox.flush()
            peer.buffer += drained(theirs)
        others = 0
        while not seen or seen[-1][1] != seq:
            message = await peer.message()
            params = message["params"]
            if message["method"] == "other":
                others += 1
            else:
                dropped = params.get("dropped", 0)
                seen.append((params["device"], params["seq"], {"imu0": dropped} if dropped else {}))
        assert (others, assert_accounted(seen, ("imu0",))) == (10, {"imu0": outbox.dropped})
        assert outbox.sent == len(seen)
        outbox.discard()
        ours.close()
        theirs.close()

    run(body)


class EndedOutbox(TestOutbox):
    def on_broken(self, reason: str) -> None:
        assert reason == "Bad file descriptor"


def test_a_client_that_left_sends_nothing_to_the_next_owner_of_its_descriptor() -> None:
    """A client can leave while imud sends a batch to its list."""
    ours, theirs = socket.socketpair()
    outbox, number = EndedOutbox(ours, Pool(1 << 26, MANY)), ours.fileno()
    outbox.discard()
    ours.close()
    for sock in (theirs, *(others := socket.socketpair())):
        sock.setblocking(False)
    assert others[0].fileno() == number
    put(outbox, 1, 1)
    assert drained(others[1]) == b""
    for sock in (theirs, *others):
        sock.close()


def test_queued_messages_hold_no_samples() -> None:
    """The interpreter would never release the memory of thousands of queued samples."""
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    encoding = BinaryEncoding()
    outbox = TestOutbox(ours, Pool(1 << 26, MANY))
    batches = [batch("imu0", seq) for seq in range(1, 2001)]
    for one in batches:
        Outbox.put_samples([outbox], encoding.encode(one), one, encoding)
    assert outbox.queue_samples > 100
    assert len({sys.getrefcount(each) for each in batches[:-1]}) == 1  # equal for sent and queued batches
    # a batch that `publish` had no time to encode
    late = batch("imu0", 2001)
    references = [sys.getrefcount(late)]
    delivery = Delivery(1 << 60, late, encoding, None)
    references.append(sys.getrefcount(late))
    assert delivery.messages() == encoding.encode(late)
    references.append(sys.getrefcount(late))
    assert references == [references[0], references[0] + 1, references[0]]
    outbox.discard()
    ours.close()
    theirs.close()


BIG_BYTES = 400_000
"""A `status` of 128 devices."""


def held_bytes(server: SocketServer) -> int:
    connections = server.hub.connections.values()
    return sum(one.queue_bytes + len(one._input) + one._work_bytes for one in connections)


@in_server(memory_mb=8)
async def test_unread_replies_and_half_lines_stay_within_the_memory(server: SocketServer) -> None:
    big = "x" * BIG_BYTES
    good = await Peer.greeted(server)
    (connection,) = server.hub.connections.values()
    silent = [await Peer.greeted(server) for _ in range(100)]
    tracemalloc.start()
    for one in list(server.hub.connections.values()):
        if one is not connection:
            one.post(encode_notification("big", big))
            assert held_bytes(server) <= server.hub.pool.held_bytes <= 8 << 20
    connection.post(encode_notification("big", big + "good"))  # the largest and last message
    assert tracemalloc.get_traced_memory()[0] < 8 << 20
    tracemalloc.stop()
    evicted = server.hub.status().evicted
    assert 70 < evicted < 100
    assert (await good.body()).endswith(b'good"}')
    assert len(await good.result("devices")) == 2
    assert not connection.closed
    for peer in (good, *silent):
        peer.close()
    await until(lambda: not server.hub.connections)
    assert server.hub.pool.held_bytes == 0
    good = await Peer.greeted(server)
    silent = [await Peer.greeted(server) for _ in range(120)]
    for peer in silent:
        with suppress(ConnectionResetError, BrokenPipeError):
            await peer.send(b"x" * 60_000)
    await until(lambda: server.hub.status().evicted > evicted + 40)  # 69 half lines fit into 4 MiB
    assert held_bytes(server) == server.hub.pool.held_bytes <= 4 << 20
    assert len(await good.result("devices")) == 2
    for peer in (good, *silent):
        peer.close()
    await until(lambda: not server.hub.connections)
    assert server.hub.pool.held_bytes == 0


class Blocked:
    """A socket that accepts no data until `room` is true."""

    def __init__(self) -> None:
        self.room = False
        self.sent: list[int] = []

    def fileno(self) -> int:
        return -1

    def send(self, _fd: int, data: bytes) -> int:
        if not self.room:
            raise BlockingIOError
        self.sent.append(len(data))
        return len(data)


class BlockedOutbox(TestOutbox):
    """An outbox with a `Blocked` socket. imud may evict it."""

    def __init__(self, pool: Pool, uid: int = 1) -> None:
        super().__init__(Blocked(), pool, uid)
        self.gone = False

    def evict(self, reason: str) -> None:
        self.gone = True
        self.discard()


def waiting(pool: Pool, uid: int, size_bytes: int) -> BlockedOutbox:
    outbox = BlockedOutbox(pool, uid)
    outbox.put_reply(bytes(size_bytes))
    return outbox


def put(outbox: Outbox, first: int, count: int) -> None:
    some = batch("imu0", first, count)
    Outbox.put_samples([outbox], BinaryEncoding().encode(some), some, BinaryEncoding())


EACH_BYTES = SAMPLE_BYTES + 4 + SLOT_BYTES
"""Memory of a queued binary sample, bytes."""


@pytest.mark.parametrize("limits", [Limits(5, 1 << 22), Limits(4096, 5 * EACH_BYTES)])
def test_exactly_the_limit_of_samples_may_wait(limits: Limits) -> None:
    pool = Pool(1 << 26, limits)
    outbox = BlockedOutbox(pool)
    put(outbox, 1, 3)
    put(outbox, 4, 2)
    assert (outbox.queue_samples, outbox.queue_bytes, outbox.dropped) == (5, 5 * EACH_BYTES, 0)
    put(outbox, 6, 1)
    # imud dropped a complete delivery
    assert (outbox.queue_samples, outbox.queue_bytes, outbox.dropped) == (3, 3 * EACH_BYTES, 3)
    put(outbox, 7, 20)
    assert (outbox.queue_samples, outbox.queue_bytes, outbox.dropped) == (5, 5 * EACH_BYTES, 21)
    outbox.put_reply(bytes(70))
    assert (outbox.queue_bytes, pool.held_bytes) == (5 * EACH_BYTES + 70, 5 * EACH_BYTES + 70 + REPLY_BYTES)
    outbox.discard()
    assert (outbox.queue_bytes, pool.held_bytes) == (0, 0)


def test_a_queue_is_sent_in_pieces() -> None:
    sock = Blocked()
    outbox = TestOutbox(sock, Pool(1 << 26, MANY))
    put(outbox, 1, 300)
    sock.room = True
    while outbox.flush():
        pass
    assert sock.sent == [102 * 324, 102 * 324, 96 * 324]  # a piece ends with the message that reaches 32 KiB


@pytest.mark.parametrize("sizes", [(30, 30, 30), (1, 99)])
def test_exactly_the_limit_of_replies_may_wait(sizes: tuple[int, ...]) -> None:
    """The first message is partly sent, so it does not count."""
    pool = Pool(1 << 26, Limits(20, 1 << 20, replies=3, reply_bytes=100))
    outbox = BlockedOutbox(pool)
    outbox.put_reply(bytes(1000))
    for size_bytes in sizes:
        outbox.put_reply(bytes(size_bytes))
    assert not outbox.gone
    outbox.set_request_bytes(50)
    held_bytes = 1000 + sum(sizes) + REPLY_BYTES * len(sizes) + 50
    assert (outbox.held_bytes, pool.held_bytes) == (held_bytes, held_bytes)
    outbox.put_reply(bytes(1))
    assert outbox.gone
    assert pool.held_bytes == 0


def test_the_share_of_a_client_shrinks_with_each_that_waits() -> None:
    """Samples may use 3/8 of the memory. At 1/2 of the memory, imud cuts all clients to their share."""
    pool = Pool(16 * EACH_BYTES, MANY)  # shares of 6, 3 and 2 samples, and 8 samples for all
    first, second, third = (BlockedOutbox(pool) for _ in range(3))

    def waiting_samples() -> list[int]:
        return [outbox.queue_samples for outbox in (first, second, third)]

    put(first, 1, 10)
    assert waiting_samples() == [6, 0, 0]
    put(second, 1, 2)
    assert waiting_samples() == [6, 2, 0]
    put(second, 3, 1)
    assert waiting_samples() == [3, 3, 0]
    put(third, 1, 1)
    assert waiting_samples() == [3, 3, 1]
    pool.trim()
    assert waiting_samples() == [2, 1, 1]  # the second client loses a delivery of two samples
    assert pool.held_bytes == 4 * EACH_BYTES
    second.discard()
    put(first, 11, 1)
    assert waiting_samples() == [3, 0, 1]


def test_the_user_with_most_memory_loses_the_client_without_progress() -> None:
    pool = Pool(2_000_000, MANY)
    one = waiting(pool, 1, 300_000)
    many = [waiting(pool, 2, 100_000) for _ in range(8)]
    assert not one.gone  # the largest client, but its user occupies less
    assert sum(owner.gone for owner in many) == 1
    assert pool.held_bytes <= 1_000_000
    pool = Pool(2_000_000, MANY)
    owners = [waiting(pool, 1, 300_000) for _ in range(3)]
    late = waiting(pool, 1, 400_000)
    assert [owner.gone for owner in (*owners, late)] == [True, False, False, False]


def test_samples_are_cut_immediately_when_more_clients_wait() -> None:
    """Each client reached its share at another number of clients. Without a tick, the sum stays within the limit."""
    pool = Pool(1 << 20, MANY)
    encoding = BinaryEncoding()
    some = batch("imu0", 1, 50)
    messages = encoding.encode(some)
    outboxes = [BlockedOutbox(pool) for _ in range(32)]
    most = 0
    for outbox in outboxes:
        for _ in range(40):
            Outbox.put_samples([outbox], messages, some, encoding)
            most = max(most, pool.held_bytes)
    assert 1 << 18 < most <= (1 << 19) + 30_000  # a batch is 28 kB
    for outbox in outboxes:
        outbox.discard()
    assert pool.held_bytes == 0
