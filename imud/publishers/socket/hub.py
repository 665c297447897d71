"""What all clients of the socket share: devices, newest samples, subscriptions, delivery of batches and events."""

import asyncio
import logging
import socket
from collections.abc import Callable, Collection, Coroutine, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import ClientStatus, SocketStatus
from imud.formats.jsonrpc import Code, RpcError, encode_notification
from imud.model.errors import ImudError, reason_of
from imud.model.event import Event
from imud.publishers.recorder.client_stream import ClientRecording, stream_pair
from imud.publishers.socket.admission import Quota, RateLimitedLog
from imud.publishers.socket.client import ClientConnection
from imud.publishers.socket.messages import DeviceNotice
from imud.publishers.socket.outbox import Pool
from imud.publishers.socket.scheduler import TokenBucket
from imud.publishers.socket.subscription import DeliveryPlan, Subscription

log = logging.getLogger(__name__)

RECORDINGS_MAX: Final = 4
"""At a time, of all clients: each has a thread and up to 16 MiB of records that wait."""

CheckFds = Callable[[Sequence[int]], None]
"""Raises RpcError where clients may not use these descriptors."""


class ClientRecordings:
    """The recordings of all clients. Synchronization: the event loop's thread only."""

    def __init__(self, context: PublisherContext, check_fds: CheckFds) -> None:
        self._context = context
        self._check_fds = check_fds
        self._ids: dict[str, int] = {}
        self._running: dict[int, ClientRecording] = {}
        """By number of the connection."""
        self._ending: list[ClientRecording] = []
        """Those that still send what waited when they were stopped."""

    # --- the clients' side -------------------------------------------------------------------------------------------

    def start(self, connection: ClientConnection, devices: Collection[str] | None) -> int:
        """Record for a client; return the descriptor for it, which goes with the reply. Raises RpcError."""
        if connection.number in self._running:
            raise RpcError(Code.UNAVAILABLE, "record.start: this connection records already; record.stop ends that")
        count = len(self._running) + len(self._ending)
        if count >= RECORDINGS_MAX:
            raise RpcError(
                Code.UNAVAILABLE, f"record.start: {count} recordings run already, as many as there may be at a time"
            )
        ours, fd = self._lend(connection, "record.start")
        try:
            made = ClientRecording(self._context, devices, ours)
        except RuntimeError as error:  # no thread can be started
            ours.close()
            raise RpcError(Code.UNAVAILABLE, f"record.start: the daemon cannot record: {error}") from None
        for name, device_id in self._ids.items():
            made.add_device(name, device_id)
        self._running[connection.number] = made
        log.info("client %d (pid %d, uid %d) records", connection.number, connection.peer.pid, connection.peer.uid)
        return fd

    def stop(self, connection: ClientConnection) -> tuple[bool, int]:
        """End the recording of a client regularly; return whether there was one, and the records that it lost."""
        made = self._running.pop(connection.number, None)
        if made is None:
            return False, 0
        made.stop("it was stopped")
        self._ending.append(made)
        return True, made.records_dropped

    def snapshot(self, connection: ClientConnection) -> tuple[float, int]:
        """Send a client what the flight recorder has: its length, s, and the descriptor. Raises RpcError."""
        if not self._context.outputs.snapshots:
            raise RpcError(
                Code.UNAVAILABLE,
                "record.snapshot: there is no flight recorder; `recorder: {flight: {enabled: true}}` in the "
                "configuration makes one",
            )
        ours, fd = self._lend(connection, "record.snapshot")
        try:
            return self._context.outputs.snapshots[0](ours), fd
        except ImudError as error:
            ours.close()
            raise RpcError(Code.UNAVAILABLE, f"record.snapshot: {error}") from None

    def remove(self, connection: ClientConnection) -> None:
        """End the recording of a client that has gone; no-op if absent."""
        made = self._running.pop(connection.number, None)
        if made is not None:
            made.close()
            log.info("client %d records no more: its connection has ended", connection.number)

    def _lend(self, connection: ClientConnection, method: str) -> tuple[socket.socket, int]:
        """Make a pair of sockets; return the daemon's, and the client's descriptor. Raises RpcError."""
        try:
            ours, theirs = stream_pair()
        except OSError as error:
            message = f"{method}: the daemon cannot make a descriptor: {reason_of(error)}"
            raise RpcError(Code.UNAVAILABLE, message) from None
        try:
            self._check_fds((ours.fileno(), theirs.fileno()))
            return ours, connection.wakers.lend(theirs)
        except RpcError:
            ours.close()
            theirs.close()
            raise

    # --- the daemon's side -------------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        """A device appears."""
        self._ids[name] = device_id
        for made in self._running.values():
            made.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        """A device leaves, or is made anew."""
        self._ids.pop(name, None)
        for made in self._running.values():
            made.remove_device(name)

    def event(self, event: Event) -> None:
        """Record an event."""
        for made in self._running.values():
            made.event(event)

    def tick(self, now_ns: int) -> None:
        """Record checks and losses, and forget what is over."""
        for number, made in list(self._running.items()):
            made.tick(now_ns)
            if made.ended:
                self._running.pop(number).close()
                log.info("client %d records no more: it has closed its descriptor", number)
        for made in list(self._ending):
            made.tick(now_ns)
            if made.ended:
                self._ending.remove(made)
                made.close()

    def close(self) -> None:
        """End all recordings regularly; may be called twice."""
        for made in self._running.values():
            made.stop("imud stopped")
        for made in (*self._running.values(), *self._ending):
            made.close(flush=True)
        self._running.clear()
        self._ending.clear()


WAKE_NS: Final = 300_000
"""Waking clients takes so long in one turn of the event loop; the others are woken in the next."""
CLIENTS_PER_LOOK: Final = 16


class Hub:
    """Keeps the clients and what each of them asked for. Synchronization: the event loop's thread."""

    def __init__(self, path: str, context: PublisherContext, quota: Quota, time: TokenBucket, pool: Pool) -> None:
        self.path = path
        self.control_group = "the control group"
        """Whose members may change things, for people."""
        self.context = context
        self._quota = quota
        self._time = time
        self._pool = pool
        self._devices: dict[str, int] = {}
        self._newest: dict[str, Batch] = {}
        self._connections: dict[int, ClientConnection] = {}
        self._subscriptions: dict[int, Subscription] = {}
        self._events: dict[int, Collection[str] | None] = {}
        """Devices whose events a client gets, None for all; clients without events are absent."""
        self._plans: dict[str, DeliveryPlan] = {}
        self._work: dict[int, asyncio.Future[None]] = {}
        """Requests that take their time, by the number of the client."""
        self._wanting_wake: dict[str, dict[ClientConnection, None]] = {}
        """Clients that have a descriptor to be woken by, by device."""
        self.recordings = ClientRecordings(context, quota.check_fds)
        """What clients record."""
        self._accepted = 0
        self._refused = 0
        self._evicted = 0
        self._failed = 0
        self._failures = RateLimitedLog(context.clock.now_ns)
        self._to_wake: dict[str, list[ClientConnection]] = {}
        """Clients that are still to be woken for the newest batch of a device."""

    @property
    def devices(self) -> Mapping[str, int]:
        """The daemon's number of each device, by name."""
        return self._devices

    @property
    def newest(self) -> Mapping[str, Batch]:
        """The newest sample of each device that has one: the last of its batch."""
        return self._newest

    @property
    def connections(self) -> Mapping[int, ClientConnection]:
        """The clients by number."""
        return self._connections

    # --- devices, samples, events -------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device; clients that watch all get its number before its first sample."""
        self._devices[name] = device_id
        self.recordings.add_device(name, device_id)
        watching = self._subscriptions.items()
        everything = [self._connections[number] for number, wanted in watching if wanted.devices is None]
        post_all(everything, encode_notification("device", DeviceNotice(name, device_id)))

    def remove_device(self, name: str) -> None:
        """Remove a device; subscriptions that name it stay, for it may be added again."""
        device_id = self._devices.pop(name, None)
        if device_id is not None:
            matching = [number for number, wanted in self._subscriptions.items() if wanted.matches(name)]
            notice = encode_notification("device_removed", DeviceNotice(name, device_id))
            post_all([self._connections[number] for number in matching], notice)
        self.recordings.remove_device(name)
        self._newest.pop(name, None)
        self._plans.pop(name, None)

    def publish(self, batch: Batch) -> None:
        """Send a batch to all clients that watch its device."""
        device = batch.device
        self._newest[device] = batch
        plan = self._plans.get(device)
        if plan is None:
            plan = self._plans[device] = self._new_plan(device)
        plan.send(batch, self.context.clock.now_ns, self._time)
        if device in self._wanting_wake:
            # Not now: a client that wakes reads shared memory, whose publisher may have its turn after this one.
            asyncio.get_running_loop().call_soon(self._wake_all, device)

    def event(self, event: Event) -> None:
        """Send an event to all clients that asked for it; those of the daemon itself ("") go to all that get any."""
        self.recordings.event(event)
        device = event.device
        wanting = [
            self._connections[number]
            for number, devices in self._events.items()
            if devices is None or not device or device in devices
        ]
        for texts in (False, True):
            some = [connection for connection in wanting if connection.text_numbers is texts]
            if some:
                post_all(some, encode_notification("event", event, texts=texts))

    def _new_plan(self, device: str) -> DeliveryPlan:
        """The plan for a device, with the clients that watch it."""
        plan = DeliveryPlan(self._pool.next_order)
        for number, wanted in self._subscriptions.items():
            if wanted.matches(device):
                plan.add(wanted, self._connections[number].outbox)
        return plan

    def _wake_all(self, device: str) -> None:
        """Wake all clients that want it; those left of the round before come first."""
        waiting = self._to_wake.get(device)
        if waiting:
            left = dict.fromkeys(waiting)
            self._to_wake[device] = [*(one for one in self._wanting_wake.get(device, ()) if one not in left), *waiting]
        else:
            self._to_wake[device] = list(self._wanting_wake.get(device, ()))
            self._wake_some(device)

    def _wake_some(self, device: str) -> None:
        """Wake clients, from the end of the list, for WAKE_NS, then go on in the next turn of the event loop."""
        now_ns, waiting = self.context.clock.now_ns, self._to_wake[device]
        end_ns = now_ns() + WAKE_NS
        while waiting:
            for _ in range(min(CLIENTS_PER_LOOK, len(waiting))):
                self._wake(waiting.pop(), device)
            if waiting and now_ns() > end_ns:
                asyncio.get_running_loop().call_soon(self._wake_some, device)
                return

    def _wake(self, connection: ClientConnection, device: str) -> None:
        try:
            if not connection.wakers.wake(device):
                self._forget_waker(connection, device)
        except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
            connection.on_failure(error)

    def _forget_waker(self, connection: ClientConnection, device: str) -> None:
        wanting = self._wanting_wake.get(device)
        if wanting is not None:
            if connection in wanting:
                del wanting[connection]
                self.context.latencies.release(_asker(connection, device))
            if not wanting:
                del self._wanting_wake[device]

    # --- what a client asks for ---------------------------------------------------------------------------------------

    def subscribe(self, connection: ClientConnection, subscription: Subscription) -> None:
        """Send samples to a client from now on, in place of those it watched before.

        Raises RpcError when its user has too many forms of samples.
        """
        old = self._subscriptions.get(connection.number)
        self._quota.exchange_form(connection.peer.uid, old and old.key, subscription.key)
        self._stop_sending(connection)
        self._subscriptions[connection.number] = subscription
        self.context.latencies.ask(_asker(connection), subscription.latency_ns, subscription.devices)
        for device, plan in self._plans.items():
            if subscription.matches(device):
                plan.add(subscription, connection.outbox)

    def unsubscribe(self, connection: ClientConnection) -> None:
        """Send no more samples to a client; no-op if it watches none."""
        subscription = self._stop_sending(connection)
        if subscription is not None:
            self._quota.exchange_form(connection.peer.uid, subscription.key, None)
            self.context.latencies.release(_asker(connection))

    def _stop_sending(self, connection: ClientConnection) -> Subscription | None:
        """Send what the client watches no more; returns what that was."""
        subscription = self._subscriptions.pop(connection.number, None)
        if subscription is not None:
            for device, plan in self._plans.items():
                if subscription.matches(device):
                    plan.discard(subscription, connection.outbox)
        return subscription

    def subscribe_events(self, connection: ClientConnection, devices: Collection[str] | None) -> None:
        """Send events of `devices` (None for all) to a client from now on, in place of those before."""
        self._events[connection.number] = devices

    def unsubscribe_events(self, connection: ClientConnection) -> None:
        """Send no more events to a client; no-op if it gets none."""
        self._events.pop(connection.number, None)

    def make_waker(self, connection: ClientConnection, device: str, latency_ns: int = 0) -> int:
        """Make a descriptor that wakes a client after batches of `device`, so late at most.

        Raises RpcError as `ClientWakers.make`.
        """
        self._quota.check_waker(connection.peer, self._connections.values())
        fd = connection.wakers.make(device, self._quota.check_fds)
        self._wanting_wake.setdefault(device, {})[connection] = None
        self.context.latencies.ask(_asker(connection, device), latency_ns, (device,))
        return fd

    def wakes(self, device: str) -> bool:
        """Whether batches of `device` wake any client."""
        return device in self._wanting_wake

    def busy(self, connection: ClientConnection) -> bool:
        """Whether a request of the client is still being carried out."""
        return connection.number in self._work

    def do_later(self, connection: ClientConnection, work: Coroutine[Any, Any, None]) -> None:
        """Carry out a request that takes its time. It goes on when the client leaves."""
        number = connection.number
        task = self._work[number] = asyncio.ensure_future(work)
        task.add_done_callback(lambda _done: self._work.pop(number, None))

    # --- clients ------------------------------------------------------------------------------------------------------

    def next_number(self) -> int:
        """Count an accepted connection; the count is its number."""
        self._accepted += 1
        return self._accepted

    @property
    def accepted(self) -> int:
        """Connections accepted since start; the number of the newest."""
        return self._accepted

    def add(self, connection: ClientConnection) -> None:
        """Add a client that was accepted."""
        self._connections[connection.number] = connection

    def remove(self, connection: ClientConnection) -> None:
        """Remove a client and all it asked for; no-op if absent."""
        number = connection.number
        self._connections.pop(number, None)
        self.unsubscribe(connection)
        self._events.pop(number, None)
        self.recordings.remove(connection)
        for device in list(self._wanting_wake):
            self._forget_waker(connection, device)

    def count_refused(self) -> None:
        """Count a connection that was refused."""
        self._refused += 1

    def count_evicted(self) -> None:
        """Count a client that is disconnected for what it did."""
        self._evicted += 1

    def count_failed(self, error: Exception) -> None:
        """Count a client that was ended by an internal error; log the first, and one a minute of more."""
        self._failed += 1
        count = self._failures.count()
        if count:
            log.error("an internal error while a client was served (%d since the last report)", count, exc_info=error)

    def clients(self) -> tuple[ClientStatus, ...]:
        """The state of every client."""
        return tuple(self.each_client())

    def each_client(self) -> Iterator[ClientStatus]:
        """The state of every client that is there now, each as it is when its turn comes."""
        for number, connection in list(self._connections.items()):
            yield connection.status(self._encoding(number))

    def status(self, clients: tuple[ClientStatus, ...] | None = None) -> SocketStatus:
        """The state of the socket; `clients` are those asked for before, None: now."""
        if clients is None:
            clients = self.clients()
        return SocketStatus(self.path, clients, self._accepted, self._refused, self._evicted, self._failed)

    def tick(self) -> None:
        """Close clients that lingered long enough."""
        for connection in list(self._connections.values()):
            try:
                connection.tick()
            except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
                connection.on_failure(error)

    def close(self) -> None:
        """Close every client and cancel what is still being carried out; may be called twice."""
        self.recordings.close()
        for connection in list(self._connections.values()):
            connection.close()
        for task in list(self._work.values()):
            task.cancel()

    def _encoding(self, number: int) -> str:
        wanted = self._subscriptions.get(number)
        return str(wanted.form) if wanted else ""


def post_all(connections: Iterable[ClientConnection], body: bytes) -> None:
    """Send one JSON object to several clients."""
    for connection in connections:
        try:
            connection.post(body)
        except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
            connection.on_failure(error)


def _asker(connection: ClientConnection, notified: str = "") -> str:
    """A client as who asks for a latency: for what it watches, or for being woken by a device."""
    return f"client {connection.number}" + (f", notify {notified}" if notified else "")
