"""A process with N socket clients. The first one checks every sample and measures its latency; the rest only receive.

Prints `ready`, reads until the server closes or standard input does, prints one JSON line of figures. With `--stuck`
one more client subscribes and never reads.
"""

import argparse
import json
import mmap
import select
import socket
import struct
import sys
import time

import msgspec

from imud.formats.slot import SLOT_BYTES
from tests.bench.writer import FIRST_PA

LENGTH = struct.Struct("<I")
SEQ_AND_PRESSURE = struct.Struct("<Q192xd")
CHUNK = 1 << 18


class Latency:
    """What the first client saw: samples, gaps in `seq`, time from the write into the pty to the receive."""

    def __init__(self, times: mmap.mmap | None, skip: int) -> None:
        self.times = times
        self.skip = skip
        self.latencies_ns: list[int] = []
        self.samples = 0
        self.gaps = 0
        self.last: dict[object, int] = {}

    def add(self, device: object, seq: int, index: int, now_ns: int) -> None:
        """One sample: `index` is the writer's number of the frame."""
        self.samples += 1
        last = self.last.get(device)
        if last is not None:
            self.gaps += seq - last - 1
        self.last[device] = seq
        if self.times is not None and index >= self.skip:
            self.latencies_ns.append(now_ns - struct.unpack_from("<q", self.times, 8 * index)[0])


def count_binary(buffer: bytearray, seen: Latency, now_ns: int) -> None:
    """Take whole length-prefixed messages off the front of `buffer`."""
    at = 0
    while len(buffer) - at >= 4:
        (length,) = LENGTH.unpack_from(buffer, at)
        if len(buffer) - at - 4 < length:
            break
        body = at + 4
        if buffer[body] != 0x7B or length == SLOT_BYTES:
            for slot in range(body, body + length, SLOT_BYTES):
                seq, pressure = SEQ_AND_PRESSURE.unpack_from(buffer, slot)
                seen.add(struct.unpack_from("<H", buffer, slot + 60)[0], seq, int(pressure) - FIRST_PA, now_ns)
        at = body + length
    del buffer[:at]


def count_json(buffer: bytearray, seen: Latency, now_ns: int) -> None:
    """Take whole lines off the front of `buffer`."""
    end = buffer.rfind(b"\n") + 1
    for line in bytes(buffer[:end]).splitlines():
        params = msgspec.json.decode(line).get("params", {})
        if "seq" in params:
            seen.add(params["device"], params["seq"], int(params["pressure_pa"]) - FIRST_PA, now_ns)
    del buffer[:end]


def subscribe(path: str, encoding: str, bare: bool, wanted: dict[str, object]) -> tuple[socket.socket, bytes]:
    """Connect and ask for samples, as `wanted`; returns the socket and the bytes that came after the reply."""
    sock = socket.socket(socket.AF_UNIX)
    sock.connect(path)
    if bare:
        return sock, b""
    request = {"jsonrpc": "2.0", "id": 1, "method": "watch", "params": {"encoding": encoding, **wanted}}
    sock.sendall(json.dumps(request).encode() + b"\n")
    got = b""
    while got.count(b"\n") < 2:  # hello, then the reply
        got += sock.recv(CHUNK)
    reply = got.split(b"\n", 2)
    assert b'"error"' not in reply[1], reply[1]
    return sock, reply[2]


def count_attitudes(buffer: bytearray, seen: Latency, now_ns: int) -> None:
    """Take whole lines of gpsd off the front of `buffer`."""
    end = buffer.rfind(b"\n") + 1
    for _ in range(buffer.count(b'"class":"ATT"', 0, end)):
        seen.add("gpsd", seen.samples, 0, now_ns)
    del buffer[:end]


def subscribe_to_gpsd(port: int) -> tuple[socket.socket, bytes]:
    """Connect to gpsd and ask for all its reports; returns the socket and the bytes that came after the answer."""
    sock = socket.create_connection(("127.0.0.1", port))
    sock.sendall(b'?WATCH={"enable":true,"json":true};\n')
    got = b""
    while b'"class":"WATCH"' not in got or not got.endswith(b"\n"):
        got += sock.recv(CHUNK)
    return sock, b""


def receive(socks: list[tuple[socket.socket, bytes]], on_bytes: object, seen: Latency, until_ns: int) -> None:
    """Receive on all sockets until they end, standard input closes or it is `until_ns`."""
    assert callable(on_bytes)
    first = socks[0][0]
    buffer = bytearray(socks[0][1])
    poll = select.epoll()
    by_fd = {sock.fileno(): sock for sock, _ in socks}
    for fd, sock in by_fd.items():
        sock.setblocking(False)
        poll.register(fd, select.EPOLLIN)
    poll.register(sys.stdin.fileno(), select.EPOLLIN)
    scratch = bytearray(CHUNK)
    now_ns = time.monotonic_ns
    while now_ns() < until_ns:
        for fd, _ in poll.poll(1.0):
            found = by_fd.get(fd)
            if found is None:
                return
            count = found.recv_into(scratch)
            if count == 0:
                return
            if found is first:
                t_ns = now_ns()
                buffer += memoryview(scratch)[:count]
                on_bytes(buffer, seen, t_ns)


def percentile(ordered: list[int], share: float) -> float:
    """The value below which `share` of the values lie; NaN of none."""
    return float(ordered[min(len(ordered) - 1, int(share * len(ordered)))]) if ordered else float("nan")


def main() -> None:
    """Run as `python -m tests.bench.readers`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--socket", default="")
    parser.add_argument("--gpsd", type=int, metavar="PORT", help="clients of gpsd instead")
    parser.add_argument("--clients", type=int, default=1)
    parser.add_argument("--encoding", choices=["json", "binary"], default="binary")
    parser.add_argument("--bare", action="store_true")
    parser.add_argument("--stuck", action="store_true")
    parser.add_argument("--watch", type=json.loads, default={}, help="more parameters of `watch`, as JSON")
    parser.add_argument("--times")
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--skip", type=int, default=0, help="frames at the beginning whose latency does not count")
    parser.add_argument("--seconds", type=float, default=3600.0)
    args = parser.parse_args()
    times = None
    if args.times:
        with open(args.times, "rb") as file:
            times = mmap.mmap(file.fileno(), 8 * args.frames, access=mmap.ACCESS_READ)
    seen = Latency(times, args.skip)
    stuck = subscribe(args.socket, args.encoding, args.bare, args.watch) if args.stuck else None
    if args.gpsd:
        socks = [subscribe_to_gpsd(args.gpsd) for _ in range(args.clients)]
    else:
        socks = [subscribe(args.socket, args.encoding, args.bare, args.watch) for _ in range(args.clients)]
    print("ready", flush=True)
    on_bytes = count_attitudes if args.gpsd else count_binary if args.encoding == "binary" else count_json
    receive(socks, on_bytes, seen, time.monotonic_ns() + int(args.seconds * 1e9))
    ordered = sorted(seen.latencies_ns)
    shares = {"p50_us": 0.5, "p99_us": 0.99, "p999_us": 0.999}
    figures = {name: percentile(ordered, share) / 1e3 for name, share in shares.items()}
    figures |= {"max_us": ordered[-1] / 1e3 if ordered else 0.0, "samples": seen.samples, "gaps": seen.gaps}
    print(json.dumps(figures), flush=True)
    if stuck is not None:
        stuck[0].close()


if __name__ == "__main__":
    main()
