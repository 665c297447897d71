"""The reading side: batches of all gateways, with the ledger; connections are made again as often as it takes.

    async for batch in Fleet("mqtts://broker.example", name="archive").watch(gateway="gw-17"):
        store(batch.message.samples)

A batch is acknowledged when the loop asks for the next one. With a `name` the broker keeps the session: what was not
acknowledged, and what comes while the reader is away, is sent when it is back. Such a name is of one reader at a time.
"""

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from secrets import token_hex
from types import TracebackType
from typing import Final, NamedTuple, Self

import msgspec

from imud.errors import BadArgument, ServerError
from imud.fleet.connection import FleetDelivery, ReaderConnection
from imud.formats.fleet.boots import BootClocks, BootKey, BootOffset, PlacedTime, placed
from imud.formats.fleet.ledger import FleetLedger, StreamKey, key_of
from imud.formats.fleet.messages import FleetMessage, decode_message
from imud.formats.fleet.state import GatewayState, SpoolPositions, StreamAccount, decode_state
from imud.formats.fleet.topics import ROOT, STATE, Stream, TopicParts, is_name, parse_topic
from imud.publishers.mqtt.access import BrokerError
from imud.publishers.mqtt.backoff import BrokerTurn
from imud.publishers.mqtt.broker import check_extra
from imud.publishers.mqtt.settings import Broker, broker_of
from imud.units import NS_PER_S

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
