"""One connection of a reader to a broker, by paho-mqtt in the event loop of asyncio, with MQTT 5 or 3.1.1.

The broker keeps what is not acknowledged and sends it again in the next connection of the same session. With MQTT 5 it
sends no more than RECEIVE_MAX messages ahead of the acknowledgements ("receive maximum", MQTT 5.0, section
3.1.2.11.3): a reader that is slow is not sent more, and the broker queues it. MQTT 3.1.1 has no such bound; there the
socket is not read while so many messages wait here.
"""

import asyncio
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

from imud.publishers.mqtt.access import (
    CONNECT_S,
    LOST,
    REFUSED,
    UNANSWERED,
    BrokerAccess,
    BrokerError,
    connection_problem,
    paho_client,
    properties_of,
)
from imud.publishers.mqtt.settings import Broker

RECEIVE_MAX: Final = 2000
"""Messages without an acknowledgement: what 1,000 gateways with two devices send in a second."""
WAITING_BYTES: Final = 16 << 20
"""Bytes of messages that wait to be taken: 4 kB each is usual for statistics, but they can have 130 kB."""
PACKET_BYTES: Final = 1_000_000
"""Longest message: those of gateways have 130 kB, states of a hundred devices less."""
KEEP_ALIVE_S: Final = 30
GATHER_S: Final = 0.01
"""Pause after messages: those that come meanwhile are read together, which costs less than half as much for each."""
MISC_S: Final = 1.0
"""Keep-alives are looked at so often."""


class FleetDelivery(NamedTuple):
    """A message as it came."""

    topic: str
    payload: bytes
    retain: bool
    """Whether the broker had kept it."""
    number: int
    """By which it is acknowledged, in the connection it came by."""
    connection: "ReaderConnection"


class ReaderConnection:
    """A connection. Made by `open`. Synchronization: the thread of the event loop."""

    def __init__(self, broker: Broker) -> None:
        self.refused = 0
        """Messages of QoS 0, which are left out: nothing bounds how many come."""
        self._broker = broker
        self._queue: deque[FleetDelivery] = deque()
        self._bytes = 0
        """Of the messages in the queue."""
        self._came = asyncio.Event()
        self._problem = ""
        self._answered = False
        self._awaited = 0
        """Topics whose subscription the broker has not answered."""
        self._client: Any = None
        self._socket: Any = None
        self._is_paused = False
        """Whether the socket is not read, because messages gather or because enough of them wait."""
        self._gathering: asyncio.TimerHandle | None = None
        self._number = -1
        """Of the socket: paho-mqtt may close it before the event loop has forgotten it."""
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
    ) -> "ReaderConnection":
        """Connect and subscribe. `session_s`: how long the broker keeps the session without a connection, s; 0: none.

        With MQTT 3.1.1 the broker's own settings say how long. Raises BrokerError.
        """
        self = cls(broker)
        try:
            await self._connect(access, client_id, session_s, is_v5=is_v5)
            await self._until(lambda: self._answered, "no answer")
            self._awaited = len(topics)
            self._guarded(lambda: self._client.subscribe([(topic, 1) for topic in topics]))
            self._look_at_writing()
            # a session can have more messages than are read at once, and the answer stands behind them
            await self._until(lambda: not self._awaited or not self._has_room(), "no answer to the subscription")
        except (OSError, ValueError) as error:
            self.close()
            raise BrokerError(f"{broker.name}: {connection_problem(error)}") from error
        except BaseException:
            self.close()
            raise
        return self

    async def _connect(self, access: BrokerAccess, client_id: str, session_s: int, *, is_v5: bool) -> None:
        client = paho_client(self._broker, access, client_id, is_v5=is_v5, keeps_session=session_s > 0, manual_ack=True)
        client.max_inflight_messages_set(RECEIVE_MAX)
        client.on_connect, client.on_subscribe = self._on_connect, self._on_subscribe
        client.on_message, client.on_disconnect = self._on_message, self._on_disconnect
        self._client = client
        await asyncio.to_thread(
            client.connect, self._broker.host, self._broker.port, KEEP_ALIVE_S, **(_of_v5(session_s) if is_v5 else {})
        )
        self._socket = client.socket()
        if self._socket is None:
            raise BrokerError(f"{self._broker.name}: {LOST}")
        client.on_socket_close = self._on_socket_close
        self._number = self._socket.fileno()
        asyncio.get_running_loop().add_reader(self._number, self._read)
        self._look_after()

    @property
    def waiting(self) -> int:
        """Messages that came and that nobody has taken."""
        return len(self._queue)

    # --- as a connection ---------------------------------------------------------------------------------------------

    async def next(self, timeout_s: float | None = None) -> FleetDelivery | None:
        """The next message; None when none came in time. Raises BrokerError when the connection is lost."""
        if not self._queue:
            with suppress(TimeoutError):
                await self._until(lambda: bool(self._queue), "", timeout_s)
        found = self._queue.popleft() if self._queue else None
        self._bytes -= len(found.payload) if found is not None else 0
        self._look_at_reading()
        return found

    def acknowledge(self, number: int) -> None:
        """Tell the broker that a message is done with; no-op when the connection is lost, which may show here first."""
        client = self._client
        if client is not None and not self._problem:
            self._guarded(lambda: client.ack(number, 1))
            self._look_at_writing()

    def close(self) -> None:
        """End the connection with a farewell, keeping the session; may be called twice."""
        client, self._client = self._client, None
        self._problem = self._problem or "the connection is closed"
        self._came.set()
        for timer in (self._timer, self._gathering):
            if timer is not None:
                timer.cancel()
        self._forget_socket()
        if client is not None:
            with suppress(OSError, ValueError):  # it is gone already
                client.disconnect()
                sock = client.socket()
                if sock is not None:
                    sock.close()

    # --- the socket --------------------------------------------------------------------------------------------------

    async def _until(self, true: Any, problem: str, timeout_s: float | None = CONNECT_S) -> None:
        """Wait until something holds. Raises BrokerError; TimeoutError where `problem` is empty."""
        try:
            async with asyncio.timeout(timeout_s):
                while not true():
                    if self._problem:
                        raise BrokerError(f"{self._broker.name}: {self._problem}")
                    self._came.clear()
                    await self._came.wait()
        except TimeoutError:
            if not problem:
                raise
            raise BrokerError(f"{self._broker.name}: {problem} within {timeout_s:g} s") from None

    def _read(self) -> None:
        """Let paho-mqtt read all that is there, then leave the socket alone for a moment if that was messages."""
        client, before = self._client, len(self._queue)
        while client is not None:
            known = len(self._queue)
            self._guarded(client.loop_read)
            has_more = len(self._queue) > known or self._pending()
            if self._problem or not has_more or len(self._queue) > RECEIVE_MAX or self._bytes > WAITING_BYTES:
                break
        if self._socket is not None and len(self._queue) > before:
            loop = asyncio.get_running_loop()
            self._is_paused = True
            loop.remove_reader(self._number)
            self._gathering = loop.call_later(GATHER_S, self._gathered)
        self._look_at_writing()

    def _gathered(self) -> None:
        self._gathering = None
        self._look_at_reading()

    def _look_at_reading(self) -> None:
        """Read on after a pause, unless enough messages wait."""
        if self._is_paused and self._gathering is None and self._has_room() and self._socket is not None:
            loop = asyncio.get_running_loop()
            self._is_paused = False
            loop.add_reader(self._number, self._read)
            if self._pending():  # of which the kernel knows nothing
                loop.call_soon(self._read)

    def _has_room(self) -> bool:
        return len(self._queue) <= RECEIVE_MAX // 2 and self._bytes <= WAITING_BYTES // 2

    def _pending(self) -> int:
        """Bytes that the TLS library has read from the socket already."""
        return int(getattr(self._socket, "pending", lambda: 0)())

    def _write(self) -> None:
        if self._client is not None:
            self._guarded(self._client.loop_write)
            self._look_at_writing()

    def _look_at_writing(self) -> None:
        """Wait for room in the socket while paho-mqtt has something to write."""
        if self._problem or self._socket is None:
            return
        loop = asyncio.get_running_loop()
        if self._client.want_write():
            loop.add_writer(self._number, self._write)
        else:
            loop.remove_writer(self._number)

    def _look_after(self) -> None:
        """Send and expect keep-alives."""
        self._timer = asyncio.get_running_loop().call_later(MISC_S, self._look_after)
        if self._has_room():  # else what it would miss may be in what is not read
            self._guarded(self._client.loop_misc)
        self._look_at_writing()

    def _guarded(self, work: Any) -> None:
        """Call paho-mqtt, and note a connection that is lost: whatever writes or reads can close the socket."""
        try:
            work()
        except (OSError, ValueError) as error:
            self._problem = self._problem or connection_problem(error)
        if self._client is not None and self._client.socket() is None:
            self._problem = self._problem or (LOST if self._answered else UNANSWERED)
        if self._problem:
            self._forget_socket()
            self._came.set()

    def _forget_socket(self) -> None:
        """Stop waiting for the socket, whose descriptor may be closed, or be another file's by now."""
        sock, self._socket = self._socket, None
        if sock is not None:
            for forget in ("remove_reader", "remove_writer"):
                with suppress(OSError, RuntimeError):  # RuntimeError: the loop has ended, and with it the waiting
                    getattr(asyncio.get_running_loop(), forget)(self._number)

    # --- what paho-mqtt calls ----------------------------------------------------------------------------------------

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._problem = f"the broker refuses the connection: {reason}"
        self._answered = True
        self._came.set()

    def _on_subscribe(self, _client: Any, _data: Any, _mid: int, reasons: Any, _properties: Any) -> None:
        for reason in reasons:
            if reason.value >= REFUSED:
                self._problem = self._problem or f"the broker refuses a subscription: {reason}"
        self._awaited = 0
        self._came.set()

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        if not message.qos:
            self.refused += 1
            return
        self._bytes += len(message.payload)
        self._queue.append(FleetDelivery(message.topic, message.payload, bool(message.retain), message.mid, self))
        self._came.set()

    def _on_socket_close(self, _client: Any, _data: Any, _sock: Any) -> None:
        """Forget the socket while its descriptor is still its own: paho-mqtt closes it next."""
        self._forget_socket()
        self._came.set()

    def _on_disconnect(self, _client: Any, _data: Any, flags: Any, reason: Any, _properties: Any) -> None:
        if flags.is_disconnect_packet_from_server:
            self._problem = self._problem or f"the broker ended the connection: {reason}"


def _of_v5(session_s: int) -> dict[str, Any]:
    """What a connection says of its session and its room with MQTT 5."""
    properties = properties_of(
        "CONNECT", SessionExpiryInterval=session_s, ReceiveMaximum=RECEIVE_MAX, MaximumPacketSize=PACKET_BYTES
    )
    return {"clean_start": session_s == 0, "properties": properties}
