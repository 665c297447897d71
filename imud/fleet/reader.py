"""The reading side: batches of all gateways, with the ledger; connections are made again as often as it takes.

    async for batch in Fleet("mqtts://broker.example", name="archive").watch(gateway="gw-17"):
        store(batch.message.samples)

A batch is acknowledged when the loop asks for the next one. With a `name` the broker keeps the session: what was not
acknowledged, and what comes while the reader is away, is sent when it is back. Such a name is of one reader at a time.
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

import msgspec

from imud.fleet.accounts import (
    BootClocks,
    BootKey,
    BootOffset,
    FleetLedger,
    GatewayState,
    PlacedTime,
    SpoolPositions,
    StreamAccount,
    StreamKey,
    decode_state,
    key_of,
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
    check_extra,
    close_client,
    connection_problem,
    open_client,
    paho_client,
)
from imud.fleet.messages import ROOT, STATE, FleetMessage, Stream, TopicParts, decode_message, is_name, parse_topic
from imud.fleet.settings import Broker, broker_of
from imud.model.errors import BadArgument, ServerError
from imud.model.units import NS_PER_S

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
        client = paho_client(self._broker, access, client_id, self, is_v5=is_v5, session_s=session_s, manual_ack=True)
        client.max_inflight_messages_set(RECEIVE_MAX)
        self._client = client
        await asyncio.to_thread(open_client, client, self._broker, KEEP_ALIVE_S, RECEIVE_MAX, PACKET_BYTES, session_s)
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
            close_client(client)

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


log = logging.getLogger(__name__)

SESSION_S: Final = 7 * 24 * 3600
"""A session with a name outlives so long an absence of its reader, unless the broker allows less."""
RETRY_MAX_S: Final = 60.0
VERSIONS: Final = ("5", "3.1.1")
"""Of MQTT; the first is taken without asking."""


class ReaderAccess(msgspec.Struct, frozen=True):
    """Who connects, and which certificates count; the keys of `mqtt` with these names say more."""

    user: str = ""
    password_file: str | None = None
    ca_file: str | None = None
    cert_file: str | None = None
    key_file: str | None = None


class FleetBatch(NamedTuple):
    """A message of a stream, without what had come before."""

    site: str
    stream: Stream
    message: FleetMessage
    """Its samples are those that `imud.client` gives."""
    offset: BootOffset | None = None
    """The wall clock of its boot, as far as it is known: with it, what came before can be placed, too."""

    def time_of(self, utc_ns: int, t_ns: int) -> PlacedTime:
        """Where a record of the message with these two times lies on UTC, and whether its gateway knew the time."""
        return placed(utc_ns, t_ns, self.message.clock, self.offset)

    def time_of_newest(self) -> PlacedTime:
        """The same of the newest of the message, which is all there is of what was dropped."""
        message, t_ns = self.message, self.message.newest_t_ns
        return placed(message.utc_ns, t_ns, message.clock, self.offset)


def brokers_of(urls: Sequence[str]) -> list[Broker]:
    """The brokers that URLs name. Raises BadArgument for one that names none, and for no URL."""
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
    """The gateways of a broker, or of a cluster of them. Synchronization: one event loop."""

    def __init__(
        self, *urls: str, access: ReaderAccess | None = None, name: str = "", version: str = VERSIONS[0],
        from_begin: bool = False, retry_max_s: float = RETRY_MAX_S, now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        """`urls`: mqtt, mqtts, ws or wss, without user and password; several are of one cluster, tried in turn.

        `name`: of the session that the broker keeps. `version`: of MQTT, 5 or 3.1.1. `from_begin`: numbers that the
        first message of a stream leaves out count as missing. `retry_max_s`: longest pause between two attempts, s.
        Raises BadArgument, and ServerError without the extra `mqtt`.
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
        self.states: dict[tuple[str, str], GatewayState] = {}
        """The last state of each gateway, by site and gateway."""
        self.ignored = 0
        """Messages of these topics that no gateway of a version known here has sent."""
        self.connections = 0
        """Connections that a broker has accepted, with their subscriptions."""
        self.problem = ""
        """Why nothing comes now, one sentence; empty while the connection is there."""
        self.clocks = BootClocks()
        """What gateways said of their wall clocks."""
        self._positions = SpoolPositions(from_begin=from_begin)

    @property
    def accounts(self) -> Mapping[StreamKey, StreamAccount]:
        """The account of every stream: sent, received, gaps by cause, still in the spool."""
        return self._positions.accounts(self.ledger)

    @property
    def offsets(self) -> Mapping[BootKey, BootOffset]:
        """CLOCK_REALTIME less CLOCK_MONOTONIC of each gateway and boot whose clock was synchronised, with its error."""
        return self.clocks.offsets

    async def watch(
        self, *, site: str | None = None, gateway: str | None = None, device: str | None = None
    ) -> AsyncGenerator[FleetBatch, None]:
        """Batches as they come, each acknowledged when the next one is asked for. None stands for all.

        Raises BadArgument for what is no name, ServerError for more streams than a ledger holds. What is wrong with
        the connection is in `problem`, and it is tried again.
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

    def take(self, delivery: FleetDelivery, changed: set[StreamKey] | None = None) -> FleetBatch | None:
        """Enter a message into the ledger; return what of it is new. Raises ServerError for too many streams.

        The key of an account that changed, be it by a duplicate, is put into `changed`.
        """
        parts = parse_topic(delivery.topic)
        assert parts is not None  # the session gives no other
        try:
            if parts.leaf == STATE:
                state = decode_state(delivery.payload)
                self.states[parts.site, parts.gateway] = state
                self._positions.take(parts.gateway, state)
                self.clocks.take_state(parts.gateway, state)
                return None
            message, stream = decode_message(delivery.payload), Stream(parts.leaf)
            if (message.gateway, message.device) != (parts.gateway, parts.device):
                raise ValueError(f"expected a message of {parts.gateway}/{parts.device}, got one of another")
            fresh = self.ledger.take(message, stream)
            if changed is not None:
                changed.add(key_of(message, stream))
            offset = self.clocks.take(message)
            return FleetBatch(parts.site, stream, fresh, offset) if fresh is not None else None
        except ValueError as error:
            self.ignored += 1
            log.warning("%s: %s", delivery.topic, error)
            return None
        except OverflowError as error:
            raise ServerError(str(error)) from error


class FleetSession:
    """A session with the broker over as many connections as it takes. Synchronization: one event loop."""

    def __init__(self, fleet: Fleet, *, site: str | None, gateway: str | None, device: str | None) -> None:
        """None stands for all. Raises BadArgument for what is no name."""
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
        """The next message of a gateway; None when none came in time, and now and then while there is no connection."""
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
            fleet.ignored += 1  # of a subscription that this session had once
            self.acknowledge(delivery)
            return None
        return delivery

    def acknowledge(self, delivery: FleetDelivery) -> None:
        """Tell the broker that a message is done with; one of an earlier connection comes again."""
        if delivery.connection is self._connection:
            self._connection.acknowledge(delivery.number)

    def close(self) -> None:
        """End the connection; may be called twice. The broker keeps a session that has a name."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    async def _connected(self, timeout_s: float | None) -> bool:
        """Connect, when it is time for it. Raises BrokerError."""
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
        """What is subscribed to: states, and the streams that are wanted."""
        site, gateway, device = (name or "+" for name in self._wanted)
        base = f"{ROOT}/{site}/{gateway}"
        topics = [f"{base}/{STATE}", *(f"{base}/{device}/{stream}" for stream in Stream)]
        return topics if self._wanted[2] is not None else [*topics, f"{base}/{Stream.EVENTS}"]

    def _is_wanted(self, parts: TopicParts) -> bool:
        """Whether a topic is one of those that are wanted; a session can have others from an earlier reader."""
        if parts.leaf != STATE and parts.leaf not in Stream.__members__.values():
            return False
        given = (parts.site, parts.gateway, parts.device if parts.leaf != STATE else self._wanted[2])
        return all(want is None or want == name for want, name in zip(self._wanted, given, strict=True))
