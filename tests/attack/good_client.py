"""A good client: watches every sample, requests `poll` every 10 ms, and prints its figures after it receives a line.

`python -m tests.attack.good_client SOCKET [UID GID]`, as this user if given. Frame i of the writer, at 1 kHz, contains
the time i ms. A gap in these times is therefore a lost sample, in the port, in the daemon, or on the way to this
client.
"""

import json
import select
import socket
import struct
import sys
import time
from dataclasses import dataclass, field

from imud.formats.jsonrpc import encode_request, line_of
from imud.formats.slot import SLOT_BYTES, decode_slot
from imud.model.units import NS_PER_MS
from tests.attack.hostile import become

ASK_S = 0.01  # interval of poll requests


@dataclass
class Figures:
    samples: int = 0
    lost: int = 0
    dropped: int = 0
    replies_ms: list[float] = field(default_factory=list)
    delays_ms: list[float] = field(default_factory=list)

    def report(self) -> str:
        return json.dumps({
            "samples": self.samples, "lost": self.lost, "dropped": self.dropped, "replies": len(self.replies_ms),
            "reply_p50_ms": quantile(self.replies_ms, 0.5), "reply_p99_ms": quantile(self.replies_ms, 0.99),
            "reply_max_ms": quantile(self.replies_ms, 1.0), "sample_p99_ms": quantile(self.delays_ms, 0.99),
        })  # fmt: skip


def quantile(values: list[float], share: float) -> float:
    """Return the quantile `share` of the values; infinity without values, because no reply arrived."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("inf")


class Watcher:
    def __init__(self, path: str) -> None:
        self.sock = connect(path)
        self.sock.sendall(line_of(encode_request("watch", {"devices": ["d0"], "encoding": "binary"}, 1)))
        self._buffer = bytearray()
        self._framed = False
        self._frame: int | None = None

    def read(self, figures: Figures) -> None:
        self._buffer += self.sock.recv(1 << 18)
        if not self._framed:
            reply = self._buffer.find(b'"result"')
            end = self._buffer.find(b"\n", reply)
            if reply < 0 or end < 0:
                return
            del self._buffer[: end + 1]
            self._framed = True
        now_ns = time.monotonic_ns()
        while len(self._buffer) >= 4:
            (length,) = struct.unpack_from("<I", self._buffer)
            if len(self._buffer) < 4 + length:
                return
            body = bytes(self._buffer[4 : 4 + length])
            del self._buffer[: 4 + length]
            self._message(body, now_ns, figures)

    def _message(self, body: bytes, now_ns: int, figures: Figures) -> None:
        if len(body) % SLOT_BYTES:
            message = json.loads(body)
            figures.dropped += message["params"].get("dropped", 0)
            return
        sample = decode_slot(body, "d0")
        assert sample.t_dev_ns is not None
        frame = sample.t_dev_ns // NS_PER_MS
        if self._frame is not None:
            figures.lost += frame - self._frame - 1
        self._frame = frame
        figures.samples += 1
        figures.delays_ms.append((now_ns - sample.t_rx_ns) / 1e6)


def connect(path: str) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX)
    sock.connect(path)
    return sock


def main() -> None:
    if len(sys.argv) == 4:
        become(int(sys.argv[2]), int(sys.argv[3]))
    watcher = Watcher(sys.argv[1])
    asking = connect(sys.argv[1])
    question = line_of(encode_request("poll", {"devices": ["d0"]}, 7))
    figures, answer = Figures(), b""
    asked_s, due_s = 0.0, time.monotonic()
    print("ready", flush=True)
    while True:
        now_s = time.monotonic()
        if not asked_s and now_s >= due_s:
            asking.sendall(question)
            asked_s = now_s
        wait_s = 1.0 if asked_s else max(0.0, due_s - now_s)
        readable, _, _ = select.select([asking, watcher.sock, sys.stdin], [], [], wait_s)
        if asking in readable:
            answer += asking.recv(65536)
            if b'"id":7' in answer and answer.endswith(b"\n"):
                figures.replies_ms.append((time.monotonic() - asked_s) * 1e3)
                due_s, asked_s, answer = asked_s + ASK_S, 0.0, b""
        if watcher.sock in readable:
            watcher.read(figures)
        if sys.stdin in readable:
            if not sys.stdin.readline():
                return
            print(figures.report(), flush=True)
            figures = Figures()


if __name__ == "__main__":
    main()
