"""What all clients of the socket share: devices, newest samples, who wants what, and the way of a batch to them all."""

import asyncio
from collections.abc import Coroutine, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import ClientStatus, SocketStatus
from imud.event import Event
from imud.formats.jsonrpc import encode_notification
from imud.publishers.socket.connection import Connection
from imud.publishers.socket.encoding import BinaryEncoding, Encoding, JsonEncoding
from imud.publishers.socket.outbox import Outbox
from imud.publishers.socket.subscription import Form, Pace, Subscription
from imud.sample import Sample

_BINARY: Final = BinaryEncoding()


class Group:
    """Clients that get the samples of one device in the same form: each message is made once for all of them."""

    def __init__(self, encoding: Encoding) -> None:
        self.encoding = encoding
        self.direct: list[Outbox] = []
        """Those that want every sample."""
        self.paced: list[tuple[Pace, Outbox]] = []

    def send(self, batch: Batch) -> None:
        """Give the batch to every client of the group."""
        encoding, device = self.encoding, batch.device
        made: dict[int, bytes] = {}
        if self.direct:
            messages = encoding.encode(batch)
            Outbox.put_samples(self.direct, messages, device, encoding)
            made = dict(enumerate(messages)) if self.paced else made
        newest_ns = batch.samples[-1].t_ns
        for pace, outbox in self.paced:
            if newest_ns < pace.due_ns:
                continue  # the usual case, so no call for it
            chosen = [index for index, sample in enumerate(batch.samples) if pace.takes(sample.t_ns)]
            if chosen:
                for index in chosen:
                    if index not in made:
                        made[index] = encoding.encode_one(batch, index)
                messages = [made[index] for index in chosen]
                Outbox.put_samples((outbox,), messages, device, encoding)


@dataclass(frozen=True, slots=True)
class Plan:
    """Where a batch of one device goes. Made anew when anything changes, never changed: `publish` iterates over it."""

    groups: Sequence[Group]
    wakes: bool
    """Whether these batches wake any client."""


class Hub:
    """Synchronization: the event loop's thread."""

    def __init__(self, path: str, context: PublisherContext) -> None:
        self.path = path
        self.context = context
        self.devices: dict[str, int] = {}
        """Name → the daemon's number."""
        self.newest: dict[str, Sample] = {}
        self.connections: dict[int, Connection] = {}
        self.accepted = 0
        self.refused = 0
        self.evicted = 0
        self._plans: dict[str, Plan] = {}
        self._work: dict[int, asyncio.Future[None]] = {}
        """What is being done for clients, by their numbers."""

    def publish(self, batch: Batch) -> None:
        """Give a batch to everyone who wants it."""
        self.newest[batch.device] = batch.samples[-1]
        plan = self._plans.get(batch.device)
        if plan is None:
            plan = self._plans[batch.device] = self._make_plan(batch.device)
        for group in plan.groups:
            group.send(batch)
        if plan.wakes:
            # Not now: whoever wakes reads shared memory, and its publisher may have its turn after this one.
            asyncio.get_running_loop().call_soon(self._wake, batch.device)

    def event(self, event: Event) -> None:
        """Tell an event to everyone who wants it."""
        wanting = [c for c in self.connections.values() if c.wants_events_of(event.device)]
        if wanting:
            post_all(wanting, encode_notification("event", event))

    def add_device(self, name: str, device_id: int) -> None:
        """A device appears; clients that watch all are told its number before its first sample."""
        self.devices[name] = device_id
        watching_all = [c for c in self.connections.values() if c.subscription and c.subscription.devices is None]
        post_all(watching_all, encode_notification("device", {"device": name, "device_id": device_id}))

    def remove_device(self, name: str) -> None:
        """A device is gone; subscriptions that name it stay, it may come back."""
        self.devices.pop(name, None)
        self.newest.pop(name, None)
        self._plans.pop(name, None)

    def busy(self, connection: Connection) -> bool:
        """Whether something is still being done for the client."""
        return connection.number in self._work

    def do_later(self, connection: Connection, work: Coroutine[Any, Any, None]) -> None:
        """Have something done whose reply takes its time. It goes on when the client leaves."""
        number = connection.number
        task = self._work[number] = asyncio.ensure_future(work)
        task.add_done_callback(lambda _done: self._work.pop(number, None))

    def end(self) -> None:
        """Give up what is still being done; may be called twice."""
        for task in list(self._work.values()):
            task.cancel()

    def changed(self) -> None:
        """A client came, went, or wants something else."""
        self._plans = {}

    def clients(self) -> tuple[ClientStatus, ...]:
        """Every client now."""
        return tuple(connection.status() for connection in self.connections.values())

    def status(self) -> SocketStatus:
        """The socket now."""
        return SocketStatus(self.path, self.clients(), self.accepted, self.refused, self.evicted)

    def _wake(self, device: str) -> None:
        gone = [connection for connection in self.connections.values() if not connection.wake(device)]
        if gone:
            self.changed()

    def _make_plan(self, device: str) -> Plan:
        groups: dict[tuple[Form, tuple[str, ...] | None, bool], Group] = {}
        for connection in self.connections.values():
            wanted = connection.subscription
            if wanted is None or not wanted.matches(device):
                continue
            key = (wanted.form, wanted.fields if wanted.form is Form.JSON else None, connection.framed)
            group = groups.get(key)
            if group is None:
                group = groups[key] = Group(_encoding(wanted, connection.framed))
            pace = wanted.pace_of(device)
            if pace is None:
                group.direct.append(connection.outbox)
            else:
                group.paced.append((pace, connection.outbox))
        return Plan(tuple(groups.values()), any(device in c.wakers for c in self.connections.values()))


def post_all(connections: Iterable[Connection], body: bytes) -> None:
    """Send one JSON object to several clients."""
    for connection in connections:
        connection.post(body)


def _encoding(wanted: Subscription, framed: bool) -> Encoding:
    return _BINARY if wanted.form is Form.BINARY else JsonEncoding(wanted.fields, framed)
