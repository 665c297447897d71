"""What all clients of the socket share: devices, newest samples, subscriptions, delivery of batches and events."""

import asyncio
from collections.abc import Collection, Coroutine, Iterable, Mapping
from typing import Any

from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import ClientStatus, SocketStatus
from imud.event import Event
from imud.formats.jsonrpc import encode_notification
from imud.publishers.socket.connection import Connection
from imud.publishers.socket.subscription import DeliveryPlan, Subscription, Watcher, make_plan
from imud.sample import Sample


class Hub:
    """Keeps the clients and what each of them asked for. Synchronization: the event loop's thread."""

    def __init__(self, path: str, context: PublisherContext) -> None:
        self.path = path
        self.context = context
        self._devices: dict[str, int] = {}
        self._newest: dict[str, Sample] = {}
        self._connections: dict[int, Connection] = {}
        self._subscriptions: dict[int, Subscription] = {}
        self._events: dict[int, Collection[str] | None] = {}
        """Devices whose events a client gets, None for all; clients without events are absent."""
        self._plans: dict[str, DeliveryPlan] = {}
        self._work: dict[int, asyncio.Future[None]] = {}
        """Requests that take their time, by the number of the client."""
        self._accepted = 0
        self._refused = 0
        self._evicted = 0

    @property
    def devices(self) -> Mapping[str, int]:
        """The daemon's number of each device, by name."""
        return self._devices

    @property
    def newest(self) -> Mapping[str, Sample]:
        """The newest sample of each device that has one."""
        return self._newest

    @property
    def connections(self) -> Mapping[int, Connection]:
        """The clients by number."""
        return self._connections

    # --- devices, samples, events -------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device; clients that watch all get its number before its first sample."""
        self._devices[name] = device_id
        watching = self._subscriptions.items()
        everything = [self._connections[number] for number, wanted in watching if wanted.devices is None]
        post_all(everything, encode_notification("device", {"device": name, "device_id": device_id}))

    def remove_device(self, name: str) -> None:
        """Remove a device; subscriptions that name it stay, for it may be added again."""
        self._devices.pop(name, None)
        self._newest.pop(name, None)
        self._plans.pop(name, None)

    def publish(self, batch: Batch) -> None:
        """Send a batch to all clients that watch its device."""
        self._newest[batch.device] = batch.samples[-1]
        plan = self._plans.get(batch.device)
        if plan is None:
            plan = self.plan_of(batch.device)
        for group in plan.groups:
            group.send(batch)
        if plan.wakes:
            # Not now: a client that wakes reads shared memory, whose publisher may have its turn after this one.
            asyncio.get_running_loop().call_soon(self._wake, batch.device)

    def event(self, event: Event) -> None:
        """Send an event to all clients that asked for it; those of the daemon itself ("") go to all that get any."""
        device = event.device
        wanting = [
            self._connections[number]
            for number, devices in self._events.items()
            if devices is None or not device or device in devices
        ]
        if wanting:
            post_all(wanting, encode_notification("event", event))

    def plan_of(self, device: str) -> DeliveryPlan:
        """Where batches of `device` go."""
        plan = self._plans.get(device)
        if plan is None:
            clients = ((self._connections[number], wanted) for number, wanted in self._subscriptions.items())
            watchers = (Watcher(wanted, client.outbox, client.framed) for client, wanted in clients)
            wakes = any(device in client.wakers for client in self._connections.values())
            plan = self._plans[device] = make_plan(device, watchers, wakes)
        return plan

    def _wake(self, device: str) -> None:
        gone = [connection for connection in self._connections.values() if not connection.wakers.wake(device)]
        if gone:
            self._plans = {}

    # --- what a client asks for ---------------------------------------------------------------------------------------

    def subscribe(self, connection: Connection, subscription: Subscription) -> None:
        """Send samples to a client from now on, in place of those it watched before."""
        self._subscriptions[connection.number] = subscription
        self._plans = {}

    def unsubscribe(self, connection: Connection) -> None:
        """Send no more samples to a client; no-op if it watches none."""
        self._subscriptions.pop(connection.number, None)
        self._plans = {}

    def subscribe_events(self, connection: Connection, devices: Collection[str] | None) -> None:
        """Send events of `devices` (None for all) to a client from now on, in place of those before."""
        self._events[connection.number] = devices

    def unsubscribe_events(self, connection: Connection) -> None:
        """Send no more events to a client; no-op if it gets none."""
        self._events.pop(connection.number, None)

    def make_waker(self, connection: Connection, device: str) -> int:
        """Make a descriptor that wakes a client after batches of `device`. Raises RpcError as `ClientWakers.make`."""
        fd = connection.wakers.make(device)
        self._plans = {}
        return fd

    def busy(self, connection: Connection) -> bool:
        """Whether a request of the client is still being carried out."""
        return connection.number in self._work

    def do_later(self, connection: Connection, work: Coroutine[Any, Any, None]) -> None:
        """Carry out a request that takes its time. It goes on when the client leaves."""
        number = connection.number
        task = self._work[number] = asyncio.ensure_future(work)
        task.add_done_callback(lambda _done: self._work.pop(number, None))

    # --- clients ------------------------------------------------------------------------------------------------------

    def next_number(self) -> int:
        """Count an accepted connection; the count is its number."""
        self._accepted += 1
        return self._accepted

    def add(self, connection: Connection) -> None:
        """Add a client that was accepted."""
        self._connections[connection.number] = connection

    def remove(self, connection: Connection) -> None:
        """Remove a client and all it asked for; no-op if absent."""
        number = connection.number
        self._connections.pop(number, None)
        self._subscriptions.pop(number, None)
        self._events.pop(number, None)
        self._plans = {}

    def count_refused(self) -> None:
        """Count a connection that was refused."""
        self._refused += 1

    def count_evicted(self) -> None:
        """Count a client that is disconnected for what it did."""
        self._evicted += 1

    def clients(self) -> tuple[ClientStatus, ...]:
        """The state of every client."""
        return tuple(connection.status(self._encoding(number)) for number, connection in self._connections.items())

    def status(self) -> SocketStatus:
        """The state of the socket."""
        return SocketStatus(self.path, self.clients(), self._accepted, self._refused, self._evicted)

    def close(self) -> None:
        """Close every client and cancel what is still being carried out; may be called twice."""
        for connection in list(self._connections.values()):
            connection.close()
        for task in list(self._work.values()):
            task.cancel()

    def _encoding(self, number: int) -> str:
        wanted = self._subscriptions.get(number)
        return str(wanted.form) if wanted else ""


def post_all(connections: Iterable[Connection], body: bytes) -> None:
    """Send one JSON object to several clients."""
    for connection in connections:
        connection.post(body)
