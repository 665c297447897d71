"""Many publishing MQTT 3.1.1 clients in one thread, cheap enough that only the broker and the collector are the limit.

The packets follow the standard (OASIS MQTT 3.1.1, sections 2 and 3): CONNECT, PUBLISH with QoS 1, PINGREQ and their
replies. A message stays in the queue until the broker acknowledges it, like in the spool. After a lost connection, a
client connects to the next broker of its list and sends all remaining messages again, the oldest first.
"""

import selectors
import socket
import struct
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from random import Random
from time import monotonic
from typing import Final

CONNACK, PUBACK = 2, 4
WINDOW: Final = 20  # messages without an acknowledgment per client
KEEP_ALIVE_S: Final = 30  # CONNECT, section 3.1.2.10
ANSWER_S: Final = 15.0  # Maximum time without a reply from the broker, s. Then the client closes the connection.
RETRY_S: Final = 2.0  # maximum wait before a new connection, random
READ_BYTES: Final = 262_144


class MqttClient:
    """A client. Synchronization: the thread of its `Clients`."""

    def __init__(self, name: str, ports: Sequence[int], *, first: int = 0) -> None:
        self.name, self.ports = name, tuple(ports)
        self.at = first % len(ports)
        self.socket: socket.socket | None = None
        self.is_ready = False
        self.waiting: deque[tuple[str, bytes]] = deque()  # messages without an acknowledgment, in the order of sending
        self.sent = 0
        self.acknowledged = self.connects = 0
        self.retry_s = 0.0
        self.heard_s = self.wrote_s = 0.0
        self.out = bytearray()
        self.read = bytearray()
        self.number = 0  # Packet identifier of the newest message. Identifiers of a connection are consecutive.

    def give(self, topic: str, payload: bytes) -> None:
        self.waiting.append((topic, payload))


class Clients:
    """All clients of a process. Synchronization: one thread."""

    def __init__(self, clients: Sequence[MqttClient]) -> None:
        self.clients = list(clients)
        self._selector = selectors.DefaultSelector()
        self._random = Random(1)
        self._looked_s = 0.0
        for client in self.clients:
            client.retry_s = monotonic() + self._random.random() * RETRY_S

    def round(self, seconds: float) -> None:
        """Read and write pending data for at most `seconds`, and open missing connections."""
        for key, mask in self._selector.select(seconds):
            client: MqttClient = key.data
            try:
                if mask & selectors.EVENT_READ:
                    self._read(client)
                self._write(client)
            except OSError:
                self._lose(client)
        now_s = monotonic()
        if now_s - self._looked_s > 0.1:
            self._looked_s = now_s
            for client in self.clients:
                self._look_after(client, now_s)

    def write(self, client: MqttClient) -> None:
        try:
            self._write(client)
        except OSError:
            self._lose(client)

    def _write(self, client: MqttClient) -> None:
        if client.socket is None:
            return
        # at most WINDOW messages without an acknowledgment
        while client.is_ready and client.sent < min(WINDOW, len(client.waiting)):
            topic, payload = client.waiting[client.sent]
            client.number = client.number % 0xFFFF + 1
            client.out += packet(0x32, text(topic) + struct.pack(">H", client.number) + payload)
            client.sent += 1
        if client.out:
            with suppress(BlockingIOError):
                del client.out[: client.socket.send(client.out)]
            client.wrote_s = monotonic()
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.out else 0)
        if self._selector.get_key(client.socket).events != events:
            self._selector.modify(client.socket, events, client)

    def close(self) -> None:
        for client in self.clients:
            if client.socket is not None:
                with suppress(OSError):
                    # DISCONNECT (section 3.14)
                    client.socket.send(b"\xe0\x00")
                self._lose(client)
        self._selector.close()

    def _look_after(self, client: MqttClient, now_s: float) -> None:
        if client.socket is None:
            if now_s >= client.retry_s:
                self._connect(client, now_s)
            return
        owes = client.sent or not client.is_ready or client.wrote_s > client.heard_s + KEEP_ALIVE_S / 2
        if owes and now_s - max(client.heard_s, min(client.wrote_s, now_s - ANSWER_S)) > 2 * ANSWER_S:
            self._lose(client)
        elif client.is_ready:
            if now_s - client.wrote_s > KEEP_ALIVE_S / 2:
                # PINGREQ (section 3.12)
                client.out += b"\xc0\x00"
            self.write(client)

    def _connect(self, client: MqttClient, now_s: float) -> None:
        made = socket.socket()
        made.setblocking(False)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.connect_ex(("127.0.0.1", client.ports[client.at]))
        # send all remaining messages again over the new connection
        client.socket, client.is_ready, client.sent = made, False, 0
        client.heard_s = client.wrote_s = now_s
        client.read.clear()
        head = text("MQTT") + bytes((4, 2)) + struct.pack(">H", KEEP_ALIVE_S)  # protocol level 4, clean session
        client.out[:] = packet(0x10, head + text(client.name))
        self._selector.register(made, selectors.EVENT_READ | selectors.EVENT_WRITE, client)

    def _lose(self, client: MqttClient) -> None:
        made, client.socket = client.socket, None
        client.is_ready, client.sent = False, 0
        client.out.clear()
        client.at = (client.at + 1) % len(client.ports)
        client.retry_s = monotonic() + self._random.random() * RETRY_S
        if made is not None:
            self._selector.unregister(made)
            made.close()

    def _read(self, client: MqttClient) -> None:
        assert client.socket is not None
        try:
            data = client.socket.recv(READ_BYTES)
        except BlockingIOError:
            return
        if not data:
            raise ConnectionResetError
        client.heard_s = monotonic()
        client.read += data
        while (found := split(client.read)) is not None:
            first, begin, end = found
            self._take(client, first, bytes(client.read[begin:end]))
            del client.read[:end]

    def _take(self, client: MqttClient, first: int, body: bytes) -> None:
        kind = first >> 4
        if kind == CONNACK:
            if body[1]:
                raise ConnectionRefusedError
            client.connects += 1
            client.is_ready, client.number = True, 0
        elif kind == PUBACK:  # brokers acknowledge messages in order (section 4.6)
            client.waiting.popleft()
            client.sent -= 1
            client.acknowledged += 1


def text(value: str) -> bytes:
    data = value.encode()
    return struct.pack(">H", len(data)) + data


def packet(first: int, body: bytes) -> bytes:
    """Return a packet with its remaining length (section 2.2.3)."""
    size, head = len(body), bytearray((first,))
    while True:
        size, low = divmod(size, 128)
        head.append(low | (128 if size else 0))
        if not size:
            return bytes(head) + body


def split(data: bytearray) -> tuple[int, int, int] | None:
    """Return the first byte, the start and the end of the first packet's body; None if the packet is incomplete."""
    size = 0
    for at in range(1, min(5, len(data))):
        size |= (data[at] & 127) << 7 * (at - 1)
        if data[at] < 128:
            end = at + 1 + size
            return (data[0], at + 1, end) if len(data) >= end else None
    return None
