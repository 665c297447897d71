"""Messages as the broker delivers them, and queries of the database."""

from collections.abc import Sequence
from contextlib import closing
from typing import Any

import msgspec

from imud.fleet.accounts import GatewayState
from imud.fleet.connection import FleetDelivery, ReaderConnection
from imud.fleet.database.store import PostgresStore
from imud.fleet.messages import FleetMessage, MessageKind, Stream, encode_message, topic_of
from imud.fleet.reader import brokers_of
from tests.fleet.postgres_server import query

STREAMS = {MessageKind.INTERVALS: Stream.STATISTICS, MessageKind.EVENTS: Stream.EVENTS}
BALANCE = "newest - begin + 1 - whole - thinned - dropped - missing"


def delivery(topic: str, payload: bytes) -> FleetDelivery:
    return FleetDelivery(topic, payload, False, 0, ReaderConnection(brokers_of(["mqtt://broker"])[0]))


def delivery_of(content: FleetMessage | GatewayState, stream: Stream | None = None) -> FleetDelivery:
    """Return a message. The default stream depends on the kind of the message."""
    if isinstance(content, GatewayState):
        return delivery("imud/mill/gw/state", msgspec.json.encode(content))
    leaf = stream or STREAMS.get(content.kind, Stream.SAMPLES)
    return delivery(topic_of("mill", content.gateway, content.device, leaf), encode_message(content))


def deliveries(*contents: FleetMessage | GatewayState) -> Sequence[FleetDelivery]:
    return [delivery_of(one) for one in contents]


def write(url: str, *contents: FleetMessage | GatewayState, from_begin: bool = False) -> PostgresStore:
    """Write messages with a store of its own. Return the closed store."""
    with closing(PostgresStore(url, from_begin=from_begin)) as store:
        store.write(deliveries(*contents))
    return store


def ledgers(url: str, columns: str) -> list[Any]:
    return query(url, f"SELECT {columns} FROM imud_ledger ORDER BY gateway, boot, device, stream")
