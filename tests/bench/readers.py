"""Process with N socket clients. It prints `ready`, reads until the server or standard input closes, and prints JSON.

The first client checks each sample and measures its latency. The other clients only receive. With
`--devices`, every client checks its samples, each client watches every fifth device, and every second client uses JSON.
The result is one line of JSON.
"""

import argparse
import json
import mmap
import select
import socket
import struct
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import msgspec

from imud.formats.slot import SLOT_BYTES
from tests.bench.writer import FIRST_PA

LENGTH = struct.Struct("<I")  # length prefix of binary messages
SEQ_DEVICE_AND_PRESSURE = struct.Struct("<Q52xH138xd")  # members of a slot: sequence number, device id and pressure
CHUNK = 1 << 18  # 256 KiB per receive
PARTS = 5  # number of devices per watched device, with `--devices`


class Seen:
    """Counters of a client: samples, gaps in `seq`, and latencies from the write into the pty to the receive, ns."""

    def __init__(self, times: mmap.mmap | None = None, skip: int = 0) -> None:
        self.times = times
        self.skip = skip
        self.latencies_ns: list[int] = []
        self.samples = 0
        self.gaps = 0
        self.newest: dict[object, int] = {}

    def add(self, device: object, seq: int, pressure_pa: float, now_ns: int) -> None:
        """Count one sample. Its pressure contains the number of the frame in the writer."""
        self.samples += 1
        self.gaps += seq - self.newest.get(device, seq - 1) - 1
        self.newest[device] = seq
        if self.times is not None and (index := int(pressure_pa) - FIRST_PA) >= self.skip:
            self.latencies_ns.append(now_ns - struct.unpack_from("<q", self.times, 8 * index)[0])


Take = Callable[[bytearray, Seen, int], None]
"""Function that removes complete messages from the start of a buffer and counts their samples."""


def take_binary(buffer: bytearray, seen: Seen, now_ns: int) -> None:
    at = 0
    while len(buffer) - at >= LENGTH.size:
        (length,) = LENGTH.unpack_from(buffer, at)
        body = at + LENGTH.size
        if len(buffer) - body < length:
            break
        if length % SLOT_BYTES == 0:  # a message of another size is a notification
            for slot in range(body, body + length, SLOT_BYTES):
                seq, device, pressure_pa = SEQ_DEVICE_AND_PRESSURE.unpack_from(buffer, slot)
                seen.add(device, seq, pressure_pa, now_ns)
        at = body + length
    del buffer[:at]


def take_json(buffer: bytearray, seen: Seen, now_ns: int) -> None:
    end = buffer.rfind(b"\n") + 1
    for line in bytes(buffer[:end]).splitlines():
        params = msgspec.json.decode(line).get("params", {})
        if "seq" in params:
            seen.add(params["device"], params["seq"], params.get("pressure_pa") or 0.0, now_ns)
    del buffer[:end]


def take_attitudes(buffer: bytearray, seen: Seen, now_ns: int) -> None:
    end = buffer.rfind(b"\n") + 1
    for _ in range(buffer.count(b'"class":"ATT"', 0, end)):
        seen.add("gpsd", seen.samples, 0.0, now_ns)
    del buffer[:end]


TAKES: dict[str, Take] = {"binary": take_binary, "json": take_json}


class Client(NamedTuple):
    socket: socket.socket
    buffer: bytearray  # received bytes that were not processed yet


def subscribe(path: str, encoding: str, bare: bool, wanted: dict[str, object]) -> Client:
    sock = socket.socket(socket.AF_UNIX)
    sock.connect(path)
    if bare:
        return Client(sock, bytearray())
    request = {"jsonrpc": "2.0", "id": 1, "method": "watch", "params": {"encoding": encoding, **wanted}}
    sock.sendall(json.dumps(request).encode() + b"\n")
    got = b""
    while got.count(b"\n") < 2:  # wait for hello and the reply
        got += sock.recv(CHUNK)
    _, reply, rest = got.split(b"\n", 2)
    assert b'"error"' not in reply, reply
    return Client(sock, bytearray(rest))


def subscribe_to_gpsd(port: int) -> Client:
    sock = socket.create_connection(("127.0.0.1", port))
    sock.sendall(b'?WATCH={"enable":true,"json":true};\n')
    got = b""
    while b'"class":"WATCH"' not in got or not got.endswith(b"\n"):
        got += sock.recv(CHUNK)
    return Client(sock, bytearray())


def receive(clients: list[Client], takes: list[tuple[Take, Seen]], seconds: float) -> None:
    """Receive for `seconds`, or until a socket or standard input closes. The first clients count with `takes`."""
    poll = select.epoll()
    by_fd = {client.socket.fileno(): (client, number) for number, client in enumerate(clients)}
    for fd, (client, _) in by_fd.items():
        client.socket.setblocking(False)
        poll.register(fd, select.EPOLLIN)
    poll.register(sys.stdin.fileno(), select.EPOLLIN)
    scratch = bytearray(CHUNK)
    now_ns = time.monotonic_ns
    until_ns = now_ns() + int(seconds * 1e9)
    while now_ns() < until_ns:
        for fd, _ in poll.poll(1.0):
            # standard input: the parent process ends the measurement
            if fd not in by_fd:
                return
            client, number = by_fd[fd]
            count = client.socket.recv_into(scratch)
            if count == 0:
                return
            if number < len(takes):
                t_ns = now_ns()
                client.buffer.extend(memoryview(scratch)[:count])
                take, seen = takes[number]
                take(client.buffer, seen, t_ns)


def percentile(ordered: list[int], share: float) -> float:
    """Return the value below which `share` of the values are; NaN without values."""
    return float(ordered[min(len(ordered) - 1, int(share * len(ordered)))]) if ordered else float("nan")


def figures(seen: list[Seen]) -> dict[str, float]:
    """Return the counters of all checking clients, and the latencies of the first client."""
    ordered = sorted(seen[0].latencies_ns)
    found = {name: percentile(ordered, share) / 1e3 for name, share in (("p50_us", 0.5), ("p99_us", 0.99))}
    return found | {"samples": sum(one.samples for one in seen), "gaps": sum(one.gaps for one in seen)}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--socket", default="")
    parser.add_argument("--gpsd", type=int, metavar="PORT", help="connect the clients to gpsd")
    parser.add_argument("--clients", type=int, default=1)
    parser.add_argument("--encoding", choices=list(TAKES), default="binary")
    parser.add_argument("--bare", action="store_true")
    parser.add_argument("--watch", type=json.loads, default={}, help="further parameters of `watch`, JSON")
    parser.add_argument("--times")
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--skip", type=int, default=0, help="number of first frames without a latency measurement")
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--devices", nargs="+", default=[])
    args = parser.parse_args()
    times = None
    if args.times:
        with open(args.times, "rb") as file:
            times = mmap.mmap(file.fileno(), 8 * args.frames, access=mmap.ACCESS_READ)
    ask = partial(subscribe, args.socket, bare=args.bare)
    takes: list[tuple[Take, Seen]] = [(TAKES[args.encoding], Seen(times, args.skip))]
    if args.gpsd:
        clients = [subscribe_to_gpsd(args.gpsd) for _ in range(args.clients)]
        takes = [(take_attitudes, Seen())]
    elif args.devices:
        kinds = [list(TAKES)[number % 2] for number in range(args.clients)]
        wanted = [{"devices": args.devices[number % PARTS :: PARTS]} for number in range(args.clients)]
        clients = [ask(kind, wanted=one) for kind, one in zip(kinds, wanted, strict=True)]
        takes = [(TAKES[kind], Seen()) for kind in kinds]
    else:
        clients = [ask(args.encoding, wanted=args.watch) for _ in range(args.clients)]
    print("ready", flush=True)
    receive(clients, takes, args.seconds)
    print(json.dumps(figures([seen for _, seen in takes])), flush=True)


if __name__ == "__main__":
    main()
