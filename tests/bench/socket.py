"""Cost of `publish` for socket clients, compared with the same number of plain `send` calls.

All sockets are UNIX sockets in one process. A round publishes ten batches of one sample (measured), then reads the
sockets of the clients (not measured). The figures contain the work of the daemon and the kernel's part of `send`, but
not the wake-up of readers.
"""

import asyncio
import gc
import grp
import os
import socket
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from time import perf_counter_ns

from imud.contracts.publisher import Batch
from imud.formats.jsonrpc import encode_request, line_of
from imud.model.sample import Sample, Sync
from imud.publishers.socket.server import SocketOptions, SocketServer
from tests.bench.rows import Row, at_most
from tests.support.publisher_context import publisher_context

CLIENTS = (1, 10, 100)
SAMPLES_PER_ROUND = 10
"""Number of samples per round. Ten samples in 100 sockets fit into the processor cache, as at 1 kHz."""
OWN_LIMIT_NS = 300.0
"""Maximum time that publishing may add to each `send`, ns. A `send` that wakes a reader takes about 3 µs."""


def make_batch(seq: int) -> Batch:
    t_ns = 80_000_000_000_000 + seq * 1_000_000
    sample = Sample(
        "imu0", seq, t_ns, 11_873, Sync.REGRESSION, t_ns + 913_201, 1_790_000_000_000_000_000 + t_ns,
        t_dev_ns=seq * 1_000_000,
        accel_m_s2=(0.12258312900000001, -0.4903325, 9.78703670),
        gyro_rad_s=(0.0017453292519943296, -0.0034906585039886592, 0.0052359877559829881),
        mag_t=(2.1300000e-05, -3.4000000e-06, -4.2700000e-05),
        quat_wxyz=(0.9238795325112867, 0.0012, -0.0034, 0.38268343236508984),
        euler_rad=(0.0123456789, -0.0234567891, 0.7853981633974483),
        temperature_c=31.0, pressure_pa=101325.25, status=4,
    )  # fmt: skip
    return Batch("imu0", 0, (sample,))


def connect(path: str, request: bytes) -> socket.socket:
    """Connect a client and send its request. The replies are not read."""
    sock = socket.socket(socket.AF_UNIX)
    sock.connect(path)
    sock.sendall(request)
    sock.setblocking(False)
    return sock


def empty(socks: list[socket.socket]) -> int:
    """Read all pending data. Return the number of bytes of the last socket."""
    count = 0
    for sock in socks:
        count = 0
        try:
            while got := sock.recv(1 << 18):
                count += len(got)
        except BlockingIOError:
            continue
    return count


def per_sample_ns(kinds: Sequence[Callable[[], None]], after: Callable[[], object], rounds: int) -> list[float]:
    """Return the median time of one sample for each kind of round, ns. The kinds alternate against noise."""
    times: list[list[float]] = [[] for _ in kinds]
    for _ in range(rounds):
        for kind, taken in zip(kinds, times, strict=True):
            start_ns = perf_counter_ns()
            kind()
            taken.append((perf_counter_ns() - start_ns) / SAMPLES_PER_ROUND)
            after()
    return [median(taken) for taken in times]


async def measure(directory: str, clients: int, encoding: str, rate_hz: float, rounds: int) -> tuple[float, float]:
    """Return the cost of `publish` and of plain sends of the same bytes to the same sockets, ns per sample."""
    # a stopped clock: otherwise the server postpones some of the clients
    context = publisher_context(list, 1, lambda: 0)
    own_group = grp.getgrgid(os.getegid()).gr_name
    server = SocketServer(SocketOptions(path=str(Path(directory) / "s"), group=own_group), context)
    server.start()
    server.add_device("imu0", 0)
    request = line_of(encode_request("watch", {"encoding": encoding, "rate_hz": rate_hz}, 1))
    socks = [connect(server.hub.path, request) for _ in range(clients)]
    while sum(bool(status.encoding) for status in server.hub.clients()) < clients:
        await asyncio.sleep(0)
    empty(socks)
    batches = iter([make_batch(seq) for seq in range(1, 2 + SAMPLES_PER_ROUND * rounds)])
    server.publish(next(batches))
    # 700 bytes if the subscription has a lower rate and no sample arrived
    message = b"x" * (empty(socks) or 700)
    sends = [(connection._send, connection.fd) for connection in server.hub.connections.values()]

    def publish() -> None:
        for _ in range(SAMPLES_PER_ROUND):
            server.publish(next(batches))

    def bare() -> None:
        for _ in range(SAMPLES_PER_ROUND):
            for send, fd in sends:
                send(fd, message)

    gc.collect()
    cost_ns, bare_ns = per_sample_ns((publish, bare), lambda: empty(socks), rounds)
    assert all(status.dropped == status.queue_samples == 0 for status in server.hub.clients())
    server.close()
    for sock in socks:
        sock.close()
    return cost_ns, bare_ns


def rows(quick: bool = False) -> list[Row]:
    found: list[Row] = []
    with tempfile.TemporaryDirectory() as directory:
        for encoding in ("json", "binary"):
            own_ns = {}
            for clients in CLIENTS:
                rounds = max(50, (300 if quick else 3000) // clients)
                cost_ns, bare_ns = asyncio.run(measure(directory, clients, encoding, 0, rounds))
                name = f"socket: publish, {encoding}, {clients} clients"
                found.append(Row(name, cost_ns, "ns/sample"))
                found.append(Row(f"{name}: only the sends", bare_ns, "ns/sample"))
                own_ns[clients] = cost_ns - bare_ns
            each_ns = (own_ns[100] - own_ns[1]) / 99
            found.append(
                at_most(f"socket: {encoding}, work per further client without send", each_ns, "ns/sample", OWN_LIMIT_NS)
            )
        cost_ns, _ = asyncio.run(measure(directory, 100, "json", 10.0, 50))
        found.append(Row("socket: publish, json, 100 clients at 10 Hz each", cost_ns, "ns/sample"))
    return found
