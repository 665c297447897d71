"""A process full of hostile clients: `python -m tests.attack.hostile KIND --socket PATH --clients N --seconds S`.

Each kind defines the data of its clients and their way to read. The engine writes and reads as fast as possible,
connects again after a disconnect, ends after the given time, and prints its work as JSON (`Deeds`).
"""

import argparse
import json
import os
import random
import selectors
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from enum import Enum, auto

from imud.model.sample import SAMPLE_FIELDS

RECONNECTS_PER_S = 200  # limit of each process
LOOPBACK = "127.0.0.1"


class Reading(Enum):
    ALL = auto()
    SLOWLY = auto()
    NEVER = auto()


@dataclass(frozen=True)
class Kind:
    sends: Callable[[random.Random], bytes]
    """Function that returns the next data of a client; empty for no more data."""
    reading: Reading = Reading.ALL
    once: bool = False
    """Whether the client sends only once per connection."""
    leaves: bool = False
    """Whether the client disconnects immediately after it has sent its data."""
    scrapes: bool = False


@dataclass
class Deeds:
    clients: int = 0
    connections: int = 0
    requests: int = 0
    """Number of lines sent to the socket, scrapes, signals, and file operations."""
    sent_bytes: int = 0

    def __add__(self, other: "Deeds") -> "Deeds":
        return Deeds(
            self.clients + other.clients, self.connections + other.connections, self.requests + other.requests,
            self.sent_bytes + other.sent_bytes,
        )  # fmt: skip


def request(method: str, **params: object) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": params}).encode() + b"\n"


def padded_line(_rng: random.Random) -> bytes:
    line = b'{"jsonrpc":"2.0","id":1,"method":"poll","x":"'
    return line + b"x" * (65_500 - len(line)) + b'"}\n'


def any_watch(rng: random.Random) -> bytes:
    fields = rng.sample(SAMPLE_FIELDS, rng.randrange(1, len(SAMPLE_FIELDS)))
    return request("watch", fields=fields)


def any_rate(rng: random.Random) -> bytes:
    return request("watch", rate_hz=rng.choice([0.001, 1, 333, 999, 1000, 1e6]), fields=["sync"])


def many_names(_rng: random.Random) -> bytes:
    return request("watch", devices=["d0"] * 2000)


def deep_arguments(_rng: random.Random) -> bytes:
    inner = b'{"a":' * 974 + b"1" + b"}" * 974
    head = b'{"jsonrpc":"2.0","id":1,"method":"command","params":{"device":"d0","name":"x","arguments":'
    return head + inner + b"}}\n"


def all_wakers(_rng: random.Random) -> bytes:
    return b"".join(request("notify", device=f"d{number}") for number in range(4))


KINDS: dict[str, Kind] = {
    "nested": Kind(lambda _rng: b"[" * 65_000 + b"\n"), "deep-arguments": Kind(deep_arguments),
    "empty-lines": Kind(lambda _rng: b"\n" * 65_536), "spaces": Kind(lambda _rng: b" " * 65_000 + b"\n"),
    "long-lines": Kind(padded_line), "many-names": Kind(many_names),
    "half-lines": Kind(lambda _rng: b"x" * 65_000, once=True), "field-orders": Kind(any_watch, once=True),
    "watch-storm": Kind(any_watch), "rates": Kind(any_rate), "polls": Kind(lambda _rng: request("poll") * 16),
    "statuses": Kind(lambda _rng: request("status") * 4), "schemas": Kind(lambda _rng: request("schema") * 4),
    "event-watch": Kind(lambda _rng: request("events"), once=True),
    "event-storm": Kind(lambda _rng: request("events") * 16),
    "scrapes": Kind(lambda _rng: b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n", once=True, scrapes=True),
    "never-reads": Kind(lambda _rng: request("watch") + request("status") * 2, Reading.NEVER),
    "watch-unread": Kind(lambda _rng: request("watch"), Reading.NEVER, once=True),
    "reads-slowly": Kind(lambda _rng: request("watch") + request("events"), Reading.SLOWLY, once=True),
    "connects": Kind(lambda _rng: request("watch"), leaves=True, once=True),
    "wakers": Kind(all_wakers, Reading.NEVER, once=True), "waker-storm": Kind(all_wakers),
}  # fmt: skip


class Hostile:
    def __init__(self, path: str, metrics_port: int, kind: Kind, rng: random.Random, deeds: Deeds) -> None:
        self._path, self._port, self._kind, self._rng, self._deeds = path, metrics_port, kind, rng, deeds
        self._left = b""
        self._sent = False
        self.sock: socket.socket | None = None

    def connect(self) -> socket.socket | None:
        sock = socket.socket(socket.AF_INET if self._kind.scrapes else socket.AF_UNIX)
        sock.setblocking(False)
        try:
            sock.connect((LOOPBACK, self._port) if self._kind.scrapes else self._path)
        except BlockingIOError:  # TCP, or a full queue of a UNIX socket
            if not self._kind.scrapes:
                sock.close()
                return None
        except OSError:
            sock.close()
            return None
        self.sock, self._left, self._sent = sock, b"", False
        self._deeds.connections += 1
        return sock

    def write(self) -> bool:
        assert self.sock is not None
        if not self._left:
            if self._sent and self._kind.once:
                return not self._kind.leaves
            self._left, self._sent = self._kind.sends(self._rng), True
        try:
            size_bytes = self.sock.send(self._left)
            self._deeds.sent_bytes += size_bytes
            self._deeds.requests += 1 if self._kind.scrapes else self._left.count(b"\n", 0, size_bytes)
            self._left = self._left[size_bytes:]
        except BlockingIOError:
            return True
        except OSError:
            return False
        return True

    def read(self) -> bool:
        assert self.sock is not None
        try:
            data, fds, _flags, _address = socket.recv_fds(self.sock, 512 if self._slow else 1 << 18, 8)
        except BlockingIOError:
            return True
        except OSError:
            return False
        for fd in fds:
            os.close(fd)
        return bool(data)

    @property
    def _slow(self) -> bool:
        return self._kind.reading is Reading.SLOWLY

    @property
    def events(self) -> int:
        reads = 0 if self._kind.reading is Reading.NEVER else selectors.EVENT_READ
        done = self._sent and self._kind.once and not self._left and not self._kind.leaves
        writes = 0 if done else selectors.EVENT_WRITE
        return reads | writes


def attack(kinds: list[Kind], path: str, metrics_port: int, clients: int, seconds: float, seed: int) -> Deeds:
    rng = random.Random(seed)
    end_s = time.monotonic() + seconds
    selector = selectors.DefaultSelector()
    deeds = Deeds(clients)
    everyone = [Hostile(path, metrics_port, kinds[number % len(kinds)], rng, deeds) for number in range(clients)]
    idle = list(everyone)  # keep the connections of clients that wait for nothing: no other list contains them
    allowed = float(clients)
    last_s = time.monotonic()
    slow = any(kind.reading is Reading.SLOWLY for kind in kinds)
    while (now_s := time.monotonic()) < end_s:
        allowed, last_s = min(clients, allowed + (now_s - last_s) * RECONNECTS_PER_S), now_s
        while idle and allowed >= 1:
            allowed -= 1
            client = idle.pop()
            sock = client.connect()
            if sock is None:
                idle.insert(0, client)
                break
            selector.register(sock, selectors.EVENT_READ | selectors.EVENT_WRITE, client)
        for key, events in selector.select(0.01):
            client = key.data
            alive = (not events & selectors.EVENT_WRITE or client.write()) and (
                not events & selectors.EVENT_READ or client.read()
            )
            if not alive:
                selector.unregister(key.fileobj)
                client.sock.close()
                idle.append(client)
            elif client.events != key.events:
                if client.events:
                    selector.modify(key.fileobj, client.events, client)
                else:
                    selector.modify(key.fileobj, selectors.EVENT_READ, client)
                    selector.unregister(key.fileobj)
        if slow:
            time.sleep(0.01)
    return deeds


def become(uid: int, gid: int) -> None:
    os.setgroups([gid])
    os.setgid(gid)
    os.setuid(uid)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=[*KINDS, "mix"])
    parser.add_argument("--socket", required=True)
    parser.add_argument("--metrics-port", type=int, default=0)
    parser.add_argument("--nice", type=int, default=0)
    parser.add_argument("--clients", type=int, default=128)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--uid", type=int)
    parser.add_argument("--gid", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with suppress(OSError):
        os.nice(args.nice)
    if args.uid is not None:
        become(args.uid, args.gid)
    kinds = list(KINDS.values()) if args.kind == "mix" else [KINDS[args.kind]]
    deeds = attack(kinds, args.socket, args.metrics_port, args.clients, args.seconds, args.seed)
    print(json.dumps(asdict(deeds)), flush=True)


if __name__ == "__main__":
    main()
