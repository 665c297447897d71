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
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from secrets import token_hex
from types import TracebackType
from typing import Final, NamedTuple, Self

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
    BrokerError,
    BrokerTurn,
    check_extra,
)
from imud.fleet.connection import FleetDelivery, ReaderConnection
from imud.fleet.messages import ROOT, STATE, FleetMessage, Stream, TopicParts, decode_message, parse_topic
from imud.fleet.paho_client import ReaderAccess
from imud.fleet.settings import Broker, broker_of, is_name
from imud.model.errors import BadArgument
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

# Maximum length of the stored states of all gateways, bytes: 10,000 gateways with 3 kB
STATES_BYTES: Final = 32 << 20
# Time for which the broker keeps a named session without a connection, s. A broker can have a lower limit.
SESSION_S: Final = 7 * 24 * 3600
RETRY_MAX_S: Final = 60.0
KEEP_BOOTS: Final = 10  # default number of boots of a gateway that stay in memory
# Time without a message after which a boot with missing numbers leaves the memory, ns
SILENT_NS: Final = 7 * 24 * 3600 * NS_PER_S
VERSIONS: Final = ("5", "3.1.1")  # Supported versions of MQTT. The first is the default.


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


class GatewayArrival(NamedTuple):
    """GatewayArrival of a message of a gateway."""

    t_ns: int  # CLOCK_MONOTONIC of the reader
    is_retained: bool  # whether the broker had stored the message: the gateway can have sent it long ago


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
        self.name = name
        self.session_s = SESSION_S if name else 0
        self.client_id = f"imud-reader-{name or token_hex(8)}"
        self.retry_max_s, self.now_ns = retry_max_s, now_ns
        self.ledger = FleetLedger(from_begin=from_begin)
        self.states: dict[tuple[str, str], GatewayState] = {}  # newest state of each gateway, by site and gateway
        # Newest arrival of a message of each gateway with a state
        self.arrivals: dict[tuple[str, str], GatewayArrival] = {}
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
        key = (parts.site, parts.gateway)
        if isinstance(content, GatewayState):
            self._note_arrival(key, is_retained=delivery.retain)
            self._keep_state((parts.site, parts.gateway), content, len(delivery.payload))
            self._positions.take(parts.gateway, content)
            self.clocks.take_state(parts.gateway, content)
            for boot in (*(one.boot for one in content.positions), content.boot):
                self._expire(BootKey(parts.gateway, boot.partition("-")[0]))
            return None
        if key in self.states:
            self._note_arrival(key, is_retained=False)
        stream = Stream(parts.leaf)
        fresh = self.ledger.take(content, stream)
        offset = self.clocks.take(content)
        self._expire(boot_of(content))
        return FleetBatch(parts.site, stream, fresh, offset) if fresh is not None else None

    def _note_arrival(self, key: tuple[str, str], *, is_retained: bool) -> None:
        """Store the time of a message. A retained message does not replace an earlier message of the same gateway."""
        if not is_retained or key not in self.arrivals:
            self.arrivals[key] = GatewayArrival(self.now_ns(), is_retained)

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
            self.arrivals.pop(oldest, None)


class Share(NamedTuple):
    """Share of a fleet. The broker divides the messages among the sessions of all shares (MQTT 5, section 4.8.2)."""

    number: int = 0
    total: int = 1  # number of shares; 1: one session receives all messages

    @property
    def is_surplus(self) -> bool:
        """Return whether the share belongs to an earlier, larger number of shares."""
        return self.number >= self.total


WHOLE: Final = Share()
SHARES_MAX: Final = 64
# Time without a message after which the session of a surplus share is empty, s. The broker sends waiting messages
# immediately after each acknowledgement.
DRAIN_S: Final = 5.0


class FleetSession:
    """Session with the broker over several connections. Synchronization: one event loop.

    Share 0 also receives the states of the gateways, because a broker sends retained messages only to subscriptions
    without a share. The session of a surplus share ends its subscriptions and receives only waiting messages.
    """

    def __init__(
        self, fleet: Fleet, *, site: str | None, gateway: str | None, device: str | None, share: Share = WHOLE
    ) -> None:
        """Select all gateways or devices with None. Raises BadArgument if a name is invalid."""
        if share != WHOLE and not (fleet.session_s and fleet.is_v5):
            raise BadArgument(
                "expected MQTT 5 for several shares, got MQTT 3.1.1, which has no shared subscriptions; try one "
                "collector for each site, with --site and its own --name"
                if fleet.session_s
                else "expected a name for several shares, got none"
            )
        for what, given in (("site", site), ("gateway", gateway), ("device", device)):
            if given is not None and not is_name(given):
                raise BadArgument(f"{what}: expected 1 to 64 letters, digits, '_' or '-', got {given!r}")
        self._fleet = fleet
        self._wanted = (site, gateway, device)
        self._turn = BrokerTurn(fleet.brokers, fleet.retry_max_s)
        self._connection: ReaderConnection | None = None
        self._again_ns = 0
        self.is_kept = False  # True if the broker had the session before the newest connection
        self.share = share
        self._open = 0  # number of messages of this connection without an acknowledgement
        self._newest_ns = 0  # time of the last message, acknowledgement or connection

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
        self._open += 1
        self._newest_ns = fleet.now_ns()
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
            self._open -= 1
            self._newest_ns = self._fleet.now_ns()

    @property
    def is_connected(self) -> bool:
        return self._connection is not None

    @property
    def waiting(self) -> int:
        """Return the number of received messages without an acknowledgement."""
        connection = self._connection
        return 0 if connection is None else self._open + connection.waiting

    @property
    def is_drained(self) -> bool:
        """Return whether the session of a surplus share is empty."""
        if self._connection is None or not self.share.is_surplus:
            return False
        quiet_ns = self._fleet.now_ns() - self._newest_ns
        return not self.is_kept or (not self._open and quiet_ns > DRAIN_S * NS_PER_S)

    def close(self) -> None:
        """Close the connection. The broker keeps a named session, except a new session of a surplus share. A second
        call does nothing."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close(ends_session=self.share.is_surplus and not self.is_kept)

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
            broker, fleet.access, self._client_id(), self._topics(), fleet.session_s, is_v5=fleet.is_v5,
            former=self._former(),
        )  # fmt: skip
        self.is_kept = self._connection.is_kept
        self._open, self._newest_ns = 0, fleet.now_ns()
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

    def _client_id(self) -> str:
        """Return the name of the session on the broker. A name of a reader contains no period."""
        return self._fleet.client_id + (f".{self.share.number}" if self.share.number else "")

    def _topics(self) -> list[str]:
        """Return the topics of the subscription: states and selected streams."""
        if self.share.is_surplus:
            return []
        site, gateway, _ = (name or "+" for name in self._wanted)
        states = [f"{ROOT}/{site}/{gateway}/{STATE}"] if self.share.number == 0 else []
        return [*states, *self._streams(is_shared=self.share.total > 1)]

    def _former(self) -> list[str]:
        """Return the topics that the session can have from a reader with another number of shares."""
        fleet, share = self._fleet, self.share
        has_former = fleet.session_s and fleet.is_v5  # MQTT 3.1.1 has no shares
        return self._streams(is_shared=share.total == 1 or share.is_surplus) if has_former else []

    def _streams(self, *, is_shared: bool) -> list[str]:
        site, gateway, device = (name or "+" for name in self._wanted)
        group = f"$share/{self._fleet.name}/" if is_shared else ""
        base = f"{group}{ROOT}/{site}/{gateway}"
        topics = [f"{base}/{device}/{stream}" for stream in Stream]
        return topics if self._wanted[2] is not None else [*topics, f"{base}/{Stream.EVENTS}"]

    def _is_wanted(self, parts: TopicParts) -> bool:
        """Return whether the selection contains a topic. A session can contain topics of an earlier reader."""
        if parts.leaf != STATE and parts.leaf not in Stream.__members__.values():
            return False
        given = (parts.site, parts.gateway, parts.device if parts.leaf != STATE else self._wanted[2])
        return all(want is None or want == name for want, name in zip(self._wanted, given, strict=True))
