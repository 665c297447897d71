"""A process with many socket clients, each watching a part of the devices; every one checks the numbers of its samples.

    python -m tests.bench.fleet_readers --socket PATH --clients N DEVICE …

The clients with an even number get binary samples, the others JSON. Prints `ready`, reads until the server closes or
standard input does, and prints as JSON how many samples came and how many numbers were missing.
"""

import argparse
import json
import select
import socket
import struct
import sys

import msgspec

from imud.formats.slot import SLOT_BYTES
from tests.bench.readers import CHUNK, LENGTH

SEQ_AND_DEVICE = struct.Struct("<Q52xH")
"""Of a slot."""
PARTS = 5
"""Every client watches each PARTS-th device."""


class Numbers:
    """What a client saw: samples, and numbers that are missing between them."""

    def __init__(self) -> None:
        self.samples = self.gaps = 0
        self._newest: dict[object, int] = {}

    def add(self, device: object, seq: int) -> None:
        """One sample."""
        self.samples += 1
        self.gaps += seq - self._newest.get(device, seq - 1) - 1
        self._newest[device] = seq


def read_binary(buffer: bytearray, seen: Numbers) -> None:
    """Remove whole length-prefixed messages from the front of `buffer`."""
    at = 0
    while len(buffer) - at >= LENGTH.size:
        (length,) = LENGTH.unpack_from(buffer, at)
        body = at + LENGTH.size
        if len(buffer) - body < length:
            break
        if length % SLOT_BYTES == 0:  # anything else is a notification
            for slot in range(body, body + length, SLOT_BYTES):
                seen.add(*SEQ_AND_DEVICE.unpack_from(buffer, slot)[::-1])
        at = body + length
    del buffer[:at]


def read_json(buffer: bytearray, seen: Numbers) -> None:
    """Remove whole lines from the front of `buffer`."""
    end = buffer.rfind(b"\n") + 1
    for line in bytes(buffer[:end]).splitlines():
        params = msgspec.json.decode(line).get("params", {})
        if "seq" in params:
            seen.add(params["device"], params["seq"])
    del buffer[:end]


class Reader:
    """One client."""

    def __init__(self, path: str, number: int, devices: list[str]) -> None:
        self.seen = Numbers()
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(path)
        encoding = "json" if number % 2 else "binary"
        self._take = read_json if number % 2 else read_binary
        params = {"encoding": encoding, "devices": devices[number % PARTS :: PARTS]}
        self.socket.sendall(
            json.dumps({"jsonrpc": "2.0", "id": 1, "method": "watch", "params": params}).encode() + b"\n"
        )
        got = b""
        while got.count(b"\n") < 2:  # hello, then the reply
            got += self.socket.recv(CHUNK)
        _, reply, rest = got.split(b"\n", 2)
        assert b'"error"' not in reply, reply
        self._buffer = bytearray(rest)
        self.socket.setblocking(False)

    def read(self, scratch: bytearray) -> bool:
        """Take what came; False at the end."""
        count = self.socket.recv_into(scratch)
        self._buffer += memoryview(scratch)[:count]
        self._take(self._buffer, self.seen)
        return count > 0


def main() -> None:
    """Run as `python -m tests.bench.fleet_readers`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--socket", required=True)
    parser.add_argument("--clients", type=int, required=True)
    parser.add_argument("devices", nargs="+")
    args = parser.parse_args()
    readers = [Reader(args.socket, number, args.devices) for number in range(args.clients)]
    by_fd = {reader.socket.fileno(): reader for reader in readers}
    poll, scratch = select.epoll(), bytearray(CHUNK)
    for fd in (*by_fd, sys.stdin.fileno()):
        poll.register(fd, select.EPOLLIN)
    print("ready", flush=True)
    running = True
    while running:
        for fd, _ in poll.poll():
            running = running and fd in by_fd and by_fd[fd].read(scratch)
    figures = {"samples": sum(r.seen.samples for r in readers), "gaps": sum(r.seen.gaps for r in readers)}
    print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
