"""Reader of a fleet: batches of all gateways with their ledger. The reader reconnects after each lost connection.

    async for batch in Fleet("mqtts://broker.example", name="archive").watch(gateway="gw-17"):
        store(batch.message.samples)

The reader acknowledges a batch when the loop requests the next batch. With a `name`, the broker keeps the session. It
stores messages while the reader is not connected, and sends messages without an acknowledgement again. Only one reader
can use a name at a time.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import suppress
from secrets import token_hex
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

from imud.fleet.accounts import (
    INCOMPLETE_MAX,
    BootClocks,
    BootKey,
    BootOffset,
    FleetLedger,
    GatewayBoots,
    GatewayState,
    PlacedTime,
    SpoolPositions,
    StreamAccount,
    StreamKey,
    boot_of,
    decode_state,
    placed,
)
from imud.fleet.broker import (
    CONNECT_S,
    LOST,
    REFUSED,
    UNANSWERED,
    BrokerAccess,
    BrokerError,
    BrokerTurn,
    ReaderAccess,
    check_extra,
    close_client,
    connection_problem,
    open_client,
    paho_client,
)
from imud.fleet.messages import ROOT, STATE, FleetMessage, Stream, TopicParts, decode_message, parse_topic
from imud.fleet.settings import Broker, broker_of, is_name
from imud.model.errors import BadArgument
from imud.model.units import NS_PER_S

# Maximum number of messages without an acknowledgement. 1,000 gateways with two devices send this number per second.
RECEIVE_MAX: Final = 2000
# Maximum size of the waiting messages, bytes. A message with statistics usually has 4 kB, at most 130 kB.
WAITING_BYTES: Final = 16 << 20
# Maximum length of a message, bytes. A message of a gateway has at most 130 kB; the state of a hundred devices is
# shorter.
PACKET_BYTES: Final = 1_000_000
# Maximum length of the stored states of all gateways, bytes: 10,000 gateways with 3 kB
STATES_BYTES: Final = 32 << 20
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


def decode_delivery(delivery: FleetDelivery) -> tuple[TopicParts, FleetMessage | GatewayState]:
    """Return the topic and the content of a message of the session. Raises ValueError if the payload is invalid."""
    parts = parse_topic(delivery.topic)
    assert parts is not None  # FleetSession.next checks the topic
    if parts.leaf == STATE:
        return parts, decode_state(delivery.payload)
    message = decode_message(delivery.payload)
    if (message.gateway, message.device) != (parts.gateway, parts.device):
        raise ValueError(f"expected a message of {parts.gateway}/{parts.device}, got a message of another device")
    return parts, message


class ReaderConnection:
    """Connection to one broker. `open` creates it. Synchronization: the event loop's thread."""

    def __init__(self, broker: Broker) -> None:
        # Number of rejected messages with QoS 0. A broker can send any number of them without an acknowledgement.
        self.refused = 0
        self._broker = broker
        self._queue: deque[FleetDelivery] = deque()
        self._bytes = 0  # bytes of the messages in the queue
        self._changed = asyncio.Event()
        self._problem = ""
        self._answered = False
        self._awaited = 0  # number of topics without a SUBACK
        self._client: Any = None
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
    ) -> "ReaderConnection":
        """Connect and subscribe. Raises BrokerError. `session_s` is the time for which the broker keeps the session
        without a connection, s; 0: no session. With MQTT 3.1.1 the configuration of the broker decides the time."""
        self = cls(broker)
        try:
            await self._connect(access, client_id, session_s, is_v5=is_v5)
            await self._until(lambda: self._answered, "no answer")
            self._awaited = len(topics)
            self._call_client(lambda: self._client.subscribe([(topic, 1) for topic in topics]))
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
        await asyncio.to_thread(open_client, client, self._broker, KEEP_ALIVE_S, RECEIVE_MAX, PACKET_BYTES, session_s)
        self._socket = client.socket()
        if self._socket is None:
            raise BrokerError(f"{self._broker.name}: {LOST}")
        client.on_socket_close = self._on_socket_close
        self._descriptor = self._socket.fileno()
        asyncio.get_running_loop().add_reader(self._descriptor, self._read)
        self._check_keep_alive()

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

    def close(self) -> None:
        """Send DISCONNECT and close the connection. The broker keeps the session. A second call does nothing."""
        client, self._client = self._client, None
        self._problem = self._problem or "the connection is closed"
        self._changed.set()
        for timer in (self._timer, self._pause_timer):
            if timer is not None:
                timer.cancel()
        self._remove_socket()
        if client is not None:
            close_client(client)

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

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._problem = f"the broker refuses the connection: {reason}"
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


log = logging.getLogger(__name__)

# Time for which the broker keeps a named session without a connection, s. A broker can have a lower limit.
SESSION_S: Final = 7 * 24 * 3600
RETRY_MAX_S: Final = 60.0
KEEP_BOOTS: Final = 10  # default number of boots of a gateway that stay in memory
# Time without a message after which a boot with missing numbers leaves the memory, ns
SILENT_NS: Final = 7 * 24 * 3600 * NS_PER_S
VERSIONS: Final = ("5", "3.1.1")  # Supported versions of MQTT. The first is the default.


class FleetBatch(NamedTuple):
    """New part of a stream message."""

    site: str
    stream: Stream
    message: FleetMessage  # message with samples of the same type as in `imud.client`
    # Newest clock offset of the boot; None before the first. It gives older records of the boot a UTC time.
    offset: BootOffset | None = None

    def time_of(self, utc_ns: int, t_ns: int) -> PlacedTime:
        """Return the UTC time of a record with these two times."""
        return placed(utc_ns, t_ns, self.message.clock, self.offset)

    def time_of_newest(self) -> PlacedTime:
        """Return the UTC time of the newest record. It is the only time of dropped samples."""
        message, t_ns = self.message, self.message.newest_t_ns
        return placed(message.utc_ns, t_ns, message.clock, self.offset)


def brokers_of(urls: Sequence[str]) -> list[Broker]:
    """Return the brokers of URLs. Raises BadArgument if a URL is invalid or the list is empty."""
    found = []
    for url in urls:
        broker = broker_of(url)
        if broker is None:
            raise BadArgument(
                f"expected a URL such as mqtts://broker.example:8883 (mqtt, mqtts, ws or wss; no user, no password), "
                f"got {url!r}"
            )
        found.append(broker)
    if not found:
        raise BadArgument("expected the URL of at least one broker, got none")
    return found


class Fleet:
    """Gateways of one broker or one cluster. Synchronization: one event loop."""

    def __init__(
        self, *urls: str, access: ReaderAccess | None = None, name: str = "", version: str = VERSIONS[0],
        from_begin: bool = False, retry_max_s: float = RETRY_MAX_S, now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        """Create a reader for the URLs `mqtt`, `mqtts`, `ws` or `wss` of one cluster, without user and password.

        `name` is the name of the session on the broker, `version` the version of MQTT (5 or 3.1.1). With `from_begin`,
        numbers before the first received message count as missing. `retry_max_s` is the maximum pause between two
        attempts, s. Raises BadArgument, and ServerError without the extra `mqtt`.
        """
        if version not in VERSIONS:
            raise BadArgument(f"expected MQTT {' or '.join(VERSIONS)}, got {version!r}")
        if name and not is_name(name):
            raise BadArgument(f"expected a name of 1 to 64 letters, digits, '_' or '-', got {name!r}")
        check_extra()
        self.brokers: list[Broker] = brokers_of(urls)
        self.access = access or ReaderAccess()
        self.is_v5 = version == VERSIONS[0]
        self.session_s = SESSION_S if name else 0
        self.client_id = f"imud-reader-{name or token_hex(8)}"
        self.retry_max_s, self.now_ns = retry_max_s, now_ns
        self.ledger = FleetLedger(from_begin=from_begin)
        self.states: dict[tuple[str, str], GatewayState] = {}  # newest state of each gateway, by site and gateway
        self._states_bytes = 0
        self._state_bytes: dict[tuple[str, str], int] = {}  # length of each state, in the order of their arrival
        self.foreign = 0  # number of messages outside the selection
        self._undecoded = 0
        self.connections = 0  # number of accepted connections
        self.problem = ""  # cause of a missing connection, one sentence; empty while the reader is connected
        self.clocks = BootClocks()  # clock offsets of the gateways
        self._positions = SpoolPositions(from_begin=from_begin)
        # Number of boots of each gateway that stay in memory. Earlier boots leave it when all their numbers arrived.
        self.keep_boots = KEEP_BOOTS
        self.expired_boots = 0  # number of boots that left the memory
        self.expired_incomplete = 0  # number of these boots with missing numbers
        self._boots = GatewayBoots()

    @property
    def ignored(self) -> int:
        """Return the number of messages outside the selection or not from a gateway of a supported version."""
        return self.foreign + self._undecoded

    @property
    def accounts(self) -> Mapping[StreamKey, StreamAccount]:
        """Return the ledger of each stream: sent, received, gaps by cause, and numbers in the spool."""
        return self._positions.accounts(self.ledger)

    @property
    def offsets(self) -> Mapping[BootKey, BootOffset]:
        """Return the newest clock offset of each boot whose clock was synchronized."""
        return self.clocks.offsets

    async def watch(
        self, *, site: str | None = None, gateway: str | None = None, device: str | None = None
    ) -> AsyncGenerator[FleetBatch, None]:
        """Yield batches. Acknowledge each batch when the caller requests the next. None selects all.

        The reader tries again after connection problems and stores them in `problem`. Raises BadArgument if a name is
        invalid.
        """
        async with FleetSession(self, site=site, gateway=gateway, device=device) as session:
            while True:
                delivery = await session.next()
                if delivery is None:
                    continue
                batch = self.take(delivery)
                if batch is not None:
                    yield batch
                session.acknowledge(delivery)

    def take(self, delivery: FleetDelivery) -> FleetBatch | None:
        """Add a message to the ledger. Return its new part."""
        try:
            parts, content = decode_delivery(delivery)
        except ValueError as error:
            self._undecoded += 1
            log.warning("%s: %s", delivery.topic, error)
            return None
        if isinstance(content, GatewayState):
            self._keep_state((parts.site, parts.gateway), content, len(delivery.payload))
            self._positions.take(parts.gateway, content)
            self.clocks.take_state(parts.gateway, content)
            for boot in (*(one.boot for one in content.positions), content.boot):
                self._expire(BootKey(parts.gateway, boot.partition("-")[0]))
            return None
        stream = Stream(parts.leaf)
        fresh = self.ledger.take(content, stream)
        offset = self.clocks.take(content)
        self._expire(boot_of(content))
        return FleetBatch(parts.site, stream, fresh, offset) if fresh is not None else None

    def _expire(self, newest: BootKey) -> None:
        """Note a message of a boot. If the boot is new, remove the old boots of its gateway from the memory."""
        now_ns = self.now_ns()
        old = self._boots.use(newest, now_ns, self.keep_boots)
        for number, (boot, at_ns) in enumerate(old.items(), 1):
            is_complete = self._positions.is_complete(boot, self.ledger)
            if is_complete or now_ns - at_ns > SILENT_NS or number <= len(old) - INCOMPLETE_MAX:
                for owner in (self.ledger, self._positions, self.clocks, self._boots):
                    owner.forget(boot)
                self.expired_boots += 1
                self.expired_incomplete += not is_complete

    def _keep_state(self, key: tuple[str, str], state: GatewayState, size: int) -> None:
        """Store the newest state of a gateway. Forget the oldest states if all states are too large."""
        self.states.pop(key, None)
        self._states_bytes += size - self._state_bytes.pop(key, 0)
        self.states[key], self._state_bytes[key] = state, size
        while self._states_bytes > STATES_BYTES:
            oldest = next(iter(self._state_bytes))
            self._states_bytes -= self._state_bytes.pop(oldest)
            del self.states[oldest]


class FleetSession:
    """Session with the broker over several connections. Synchronization: one event loop."""

    def __init__(self, fleet: Fleet, *, site: str | None, gateway: str | None, device: str | None) -> None:
        """Select all gateways or devices with None. Raises BadArgument if a name is invalid."""
        for what, given in (("site", site), ("gateway", gateway), ("device", device)):
            if given is not None and not is_name(given):
                raise BadArgument(f"{what}: expected 1 to 64 letters, digits, '_' or '-', got {given!r}")
        self._fleet = fleet
        self._wanted = (site, gateway, device)
        self._turn = BrokerTurn(fleet.brokers, fleet.retry_max_s)
        self._connection: ReaderConnection | None = None
        self._again_ns = 0

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    async def next(self, timeout_s: float | None = None) -> FleetDelivery | None:
        """Return the next message of a gateway; None after `timeout_s`, and sometimes while there is no connection."""
        fleet = self._fleet
        try:
            if self._connection is None and not await self._connected(timeout_s):
                return None
            assert self._connection is not None
            delivery = await self._connection.next(timeout_s)
        except BrokerError as error:
            self._lost(error)
            return None
        if delivery is None:
            return None
        parts = parse_topic(delivery.topic)
        if parts is None or not self._is_wanted(parts):
            fleet.foreign += 1  # the session still has the subscription of an earlier reader with the same name
            self.acknowledge(delivery)
            return None
        return delivery

    def acknowledge(self, delivery: FleetDelivery) -> None:
        """Acknowledge a message. The broker sends a message of an earlier connection again."""
        if delivery.connection is self._connection:
            self._connection.acknowledge(delivery.number)

    def close(self) -> None:
        """Close the connection. The broker keeps a named session. A second call does nothing."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    async def _connected(self, timeout_s: float | None) -> bool:
        """Connect if the pause is over. Return whether there is a connection. Raises BrokerError."""
        fleet = self._fleet
        pause_s = (self._again_ns - fleet.now_ns()) / NS_PER_S
        if pause_s > 0:
            await asyncio.sleep(pause_s if timeout_s is None else min(pause_s, timeout_s))
        if fleet.now_ns() < self._again_ns:
            return False
        broker = self._turn.broker
        self._connection = await ReaderConnection.open(
            broker, fleet.access, fleet.client_id, self._topics(), fleet.session_s, is_v5=fleet.is_v5
        )
        self._turn.connected(fleet.now_ns())
        fleet.connections += 1
        fleet.problem = ""
        log.info("connected to %s", broker.name)
        return True

    def _lost(self, error: BrokerError) -> None:
        self.close()
        fleet = self._fleet
        now_ns = fleet.now_ns()
        pause_s = self._turn.failed(now_ns)
        self._again_ns = now_ns + round(pause_s * NS_PER_S)
        if fleet.problem != str(error):
            fleet.problem = str(error)
            log.warning("%s; trying again", error)

    def _topics(self) -> list[str]:
        """Return the topics of the subscription: states and selected streams."""
        site, gateway, device = (name or "+" for name in self._wanted)
        base = f"{ROOT}/{site}/{gateway}"
        topics = [f"{base}/{STATE}", *(f"{base}/{device}/{stream}" for stream in Stream)]
        return topics if self._wanted[2] is not None else [*topics, f"{base}/{Stream.EVENTS}"]

    def _is_wanted(self, parts: TopicParts) -> bool:
        """Return whether the selection contains a topic. A session can contain topics of an earlier reader."""
        if parts.leaf != STATE and parts.leaf not in Stream.__members__.values():
            return False
        given = (parts.site, parts.gateway, parts.device if parts.leaf != STATE else self._wanted[2])
        return all(want is None or want == name for want, name in zip(self._wanted, given, strict=True))
