"""Connection of a reader to one broker, with paho-mqtt in the event loop. The reader acknowledges each message."""

import asyncio
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

from imud.fleet.broker import LOST, REFUSED, UNANSWERED, BrokerError
from imud.fleet.paho_client import (
    CONNECT_S,
    CONNECTION_S,
    BrokerAccess,
    ConnectDeadline,
    close_client,
    connection_problem,
    open_client,
    paho_client,
)
from imud.fleet.settings import Broker

# Maximum number of messages without an acknowledgement. 1,000 gateways with two devices send this number per second.
RECEIVE_MAX: Final = 2000
# Maximum size of the waiting messages, bytes. A message with statistics usually has 4 kB, at most 130 kB.
WAITING_BYTES: Final = 16 << 20
# Maximum length of a message, bytes. A message of a gateway has at most 130 kB; the state of a hundred devices is
# shorter.
PACKET_BYTES: Final = 1_000_000
KEEP_ALIVE_S: Final = 30
# Pause after received messages, s. Reading several messages together costs less than half of the CPU time per message.
GATHER_S: Final = 0.01
MISC_S: Final = 1.0  # interval of the keep-alive checks, s


class FleetDelivery(NamedTuple):
    """Message as the broker delivered it."""

    topic: str
    payload: bytes
    retain: bool  # True if the broker stored the message (retained)
    number: int  # packet identifier for the acknowledgement, valid in `connection`
    connection: "ReaderConnection"


class ReaderConnection:
    """Connection to one broker. `open` creates it. Synchronization: the event loop's thread."""

    def __init__(self, broker: Broker) -> None:
        # Number of rejected messages with QoS 0. A broker can send any number of them without an acknowledgement.
        self.refused = 0
        self.is_kept = False  # True if the broker kept the session of an earlier connection
        self._broker = broker
        self._queue: deque[FleetDelivery] = deque()
        self._bytes = 0  # bytes of the messages in the queue
        self._changed = asyncio.Event()
        self._problem = ""
        self._answered = False
        self._awaited = 0  # number of topics without a SUBACK
        self._client: Any = None
        self._deadline: ConnectDeadline | None = None  # None after CONNACK
        self._socket: Any = None
        # True while the socket is not read: after received messages, or because the queue is full
        self._is_paused = False
        self._pause_timer: asyncio.TimerHandle | None = None
        # descriptor of the socket: paho-mqtt can close the socket before the event loop removes it
        self._descriptor = -1
        self._timer: asyncio.TimerHandle | None = None

    @classmethod
    async def open(
        cls,
        broker: Broker,
        access: BrokerAccess,
        client_id: str,
        topics: Sequence[str],
        session_s: int,
        *,
        is_v5: bool = True,
        former: Sequence[str] = (),
    ) -> "ReaderConnection":
        """Connect, subscribe to `topics`, and end the subscriptions `former` of a session that the broker kept. Raises
        BrokerError. `session_s` is the time for which the broker keeps the session without a connection, s; 0: no
        session. With MQTT 3.1.1 the configuration of the broker decides the time."""
        self = cls(broker)
        try:
            await self._connect(access, client_id, session_s, is_v5=is_v5)
            await self._until(lambda: self._answered, "no answer")
            self._remove_deadline()
            self._awaited = len(topics)
            if topics:
                self._call_client(lambda: self._client.subscribe([(topic, 1) for topic in topics]))
            # after SUBSCRIBE: each message then has at least one of both subscriptions
            if former and self.is_kept and not self._problem:
                self._call_client(lambda: self._client.unsubscribe(list(former)))
            self._watch_writable()
            # SUBACK follows the messages of the session, and these can fill the queue
            await self._until(lambda: not self._awaited or not self._has_room(), "no answer to the subscription")
        except (OSError, ValueError) as error:
            self.close()
            raise BrokerError(f"{broker.name}: {connection_problem(error)}") from error
        except BaseException:
            self.close()
            raise
        return self

    async def _connect(self, access: BrokerAccess, client_id: str, session_s: int, *, is_v5: bool) -> None:
        client = paho_client(
            self._broker, access, client_id, self, is_v5=is_v5, packet_bytes=PACKET_BYTES, session_s=session_s,
            manual_ack=True,
        )  # fmt: skip
        client.max_inflight_messages_set(RECEIVE_MAX)
        self._client = client
        self._deadline = ConnectDeadline(client, CONNECTION_S)
        await asyncio.to_thread(open_client, client, self._broker, KEEP_ALIVE_S, RECEIVE_MAX, PACKET_BYTES, session_s)
        self._socket = client.socket()
        if self._socket is None:
            raise BrokerError(f"{self._broker.name}: {LOST}")
        client.on_socket_close = self._on_socket_close
        self._descriptor = self._socket.fileno()
        asyncio.get_running_loop().add_reader(self._descriptor, self._read)
        self._check_keep_alive()

    def _remove_deadline(self) -> None:
        deadline, self._deadline = self._deadline, None
        if deadline is not None:
            deadline.close()

    @property
    def waiting(self) -> int:
        """Return the number of waiting messages."""
        return len(self._queue)

    async def next(self, timeout_s: float | None = None) -> FleetDelivery | None:
        """Return the next message; None after `timeout_s`. Raises BrokerError if the connection is lost."""
        if not self._queue:
            with suppress(TimeoutError):
                await self._until(lambda: bool(self._queue), "", timeout_s)
        found = self._queue.popleft() if self._queue else None
        self._bytes -= len(found.payload) if found is not None else 0
        self._continue_reading()
        return found

    def acknowledge(self, number: int) -> None:
        """Acknowledge a message. Do nothing if the connection is lost."""
        client = self._client
        if client is not None and not self._problem:
            self._call_client(lambda: client.ack(number, 1))
            self._watch_writable()

    def close(self, *, ends_session: bool = False) -> None:
        """Send DISCONNECT and close the connection. The broker keeps the session, unless `ends_session` (MQTT 5). A
        second call does nothing."""
        client, self._client = self._client, None
        if self._deadline is not None:
            self._deadline.end()  # a thread can still wait for the broker
            self._remove_deadline()
        self._problem = self._problem or "the connection is closed"
        self._changed.set()
        for timer in (self._timer, self._pause_timer):
            if timer is not None:
                timer.cancel()
        self._remove_socket()
        if client is not None:
            close_client(client, ends_session=ends_session)

    # --- socket -------------------------------------------------------------------------------------------------------

    async def _until(self, true: Any, problem: str, timeout_s: float | None = CONNECT_S) -> None:
        """Wait until `true` returns True. Raises BrokerError; raises TimeoutError if `problem` is empty."""
        try:
            async with asyncio.timeout(timeout_s):
                while not true():
                    if self._problem:
                        raise BrokerError(f"{self._broker.name}: {self._problem}")
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            if not problem:
                raise
            raise BrokerError(f"{self._broker.name}: {problem} within {timeout_s:g} s") from None

    def _read(self) -> None:
        """Let paho-mqtt read all pending data. After received messages, pause reading for GATHER_S."""
        client, before = self._client, len(self._queue)
        while client is not None:
            known = len(self._queue)
            self._call_client(client.loop_read)
            has_more = len(self._queue) > known or self._pending()
            if self._problem or not has_more or len(self._queue) > RECEIVE_MAX or self._bytes > WAITING_BYTES:
                break
        if self._socket is not None and len(self._queue) > before:
            loop = asyncio.get_running_loop()
            self._is_paused = True
            loop.remove_reader(self._descriptor)
            self._pause_timer = loop.call_later(GATHER_S, self._end_pause)
        self._watch_writable()

    def _end_pause(self) -> None:
        self._pause_timer = None
        self._continue_reading()

    def _continue_reading(self) -> None:
        """Continue to read after a pause if the queue has room."""
        if self._is_paused and self._pause_timer is None and self._has_room() and self._socket is not None:
            loop = asyncio.get_running_loop()
            self._is_paused = False
            loop.add_reader(self._descriptor, self._read)
            if self._pending():  # the event loop cannot see bytes that the TLS library already read
                loop.call_soon(self._read)

    def _has_room(self) -> bool:
        return len(self._queue) <= RECEIVE_MAX // 2 and self._bytes <= WAITING_BYTES // 2

    def _pending(self) -> int:
        """Return the number of bytes that the TLS library read from the socket but did not decode."""
        return int(getattr(self._socket, "pending", lambda: 0)())

    def _write(self) -> None:
        if self._client is not None:
            self._call_client(self._client.loop_write)
            self._watch_writable()

    def _watch_writable(self) -> None:
        """Wait until the socket is writable if paho-mqtt has data to write."""
        if self._socket is None:
            return
        loop = asyncio.get_running_loop()
        if self._client.want_write():
            loop.add_writer(self._descriptor, self._write)
        else:
            loop.remove_writer(self._descriptor)

    def _check_keep_alive(self) -> None:
        """Send and check keep-alives."""
        self._timer = asyncio.get_running_loop().call_later(MISC_S, self._check_keep_alive)
        # otherwise PINGRESP can be in the data that was not read, and paho-mqtt would report a timeout
        if self._has_room():
            self._call_client(self._client.loop_misc)
        self._watch_writable()

    def _call_client(self, work: Any) -> None:
        """Call paho-mqtt. Store the problem if the call or the closed socket shows a lost connection."""
        try:
            work()
        except (OSError, ValueError) as error:
            self._problem = self._problem or connection_problem(error)
        if self._client is not None and self._client.socket() is None:
            self._problem = self._problem or (LOST if self._answered else UNANSWERED)
        if self._problem:
            self._remove_socket()
            self._changed.set()

    def _remove_socket(self) -> None:
        """Remove the socket from the event loop. Its descriptor may be closed and belong to another file."""
        sock, self._socket = self._socket, None
        if sock is not None:
            for forget in ("remove_reader", "remove_writer"):
                with suppress(OSError, RuntimeError):  # RuntimeError: the event loop has ended
                    getattr(asyncio.get_running_loop(), forget)(self._descriptor)

    # --- callbacks of paho-mqtt ---------------------------------------------------------------------------------------

    def _on_connect(self, _client: Any, _data: Any, flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._problem = f"the broker refuses the connection: {reason}"
        self.is_kept = bool(flags.session_present)
        self._answered = True
        self._changed.set()

    def _on_subscribe(self, _client: Any, _data: Any, _mid: int, reasons: Any, _properties: Any) -> None:
        if len(reasons) != self._awaited:
            self._problem = self._problem or (
                f"expected {self._awaited} reason codes for subscriptions from the broker, got {len(reasons)}"
            )
        for reason in reasons:
            if reason.value >= REFUSED:
                self._problem = self._problem or f"the broker refuses a subscription: {reason}"
        self._awaited = 0
        self._changed.set()

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        if not message.qos:
            self.refused += 1
            return
        self._bytes += len(message.payload)
        self._queue.append(FleetDelivery(message.topic, message.payload, bool(message.retain), message.mid, self))
        self._changed.set()

    def _on_socket_close(self, _client: Any, _data: Any, _sock: Any) -> None:
        """Remove the socket from the event loop before paho-mqtt closes its descriptor."""
        self._remove_socket()
        self._changed.set()

    def _on_disconnect(self, _client: Any, _data: Any, flags: Any, reason: Any, _properties: Any) -> None:
        if flags.is_disconnect_packet_from_server:
            self._problem = self._problem or f"the broker ended the connection: {reason}"
