"""Common state of all clients of the socket: devices, newest samples, subscriptions, recordings."""

import asyncio
import logging
import os
import socket
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, Sequence
from fcntl import F_ADD_SEALS, F_SEAL_GROW, F_SEAL_SEAL, F_SEAL_SHRINK, fcntl
from functools import partial
from typing import BinaryIO, Final, TypeVar
from zlib import crc32

from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import ClientStatus, SocketStatus, WorkStatus
from imud.formats.jsonrpc import Code, RpcError, encode_notification
from imud.model.errors import CommandError, ImudError, reason_of
from imud.model.event import Event
from imud.publishers.recorder.client_stream import ClientRecording, stream_pair
from imud.publishers.socket.admission import Quota
from imud.publishers.socket.client import ClientConnection, Clients
from imud.publishers.socket.history import History
from imud.publishers.socket.messages import DeviceNotice
from imud.publishers.socket.outbox import Pool
from imud.publishers.socket.scheduler import TokenBucket
from imud.publishers.socket.subscription import DeliveryPlan, Subscription

log = logging.getLogger(__name__)

T = TypeVar("T")

RECORDINGS_MAX: Final = 4
"""Maximum number of recordings of all clients. Each has a thread and a queue of up to 16 MiB."""


class ClientRecordings:
    """The recordings of all clients. Synchronization: the event loop's thread.

    A client reads its recording from a descriptor. The recording ends with `record.stop`, with the connection, when the
    client closes the descriptor, or when imud stops. `check_fds` raises RpcError if clients may not use descriptors.
    """

    def __init__(self, context: PublisherContext, check_fds: Callable[[Sequence[int]], None]) -> None:
        self._context = context
        self._check_fds = check_fds
        self._ids: dict[str, int] = {}
        self.running: dict[int, ClientRecording] = {}  # recordings by client number
        self._ending: list[ClientRecording] = []  # stopped recordings that still send their queue

    # --- requests of a client -----------------------------------------------------------------------------------------

    def start(self, connection: ClientConnection, devices: Collection[str] | None) -> int:
        """Start the recording of a client. Return the descriptor for the reply. Raises RpcError."""
        if connection.number in self.running:
            raise RpcError(Code.UNAVAILABLE, "record.start: this connection already records; stop it with record.stop")
        count = len(self.running) + len(self._ending)
        if count >= RECORDINGS_MAX:
            raise RpcError(Code.UNAVAILABLE, f"record.start: {count} recordings are running, the maximum")
        ours, fd = self._make_pair(connection, "record.start")
        try:
            made = ClientRecording(self._context, devices, ours)
        except RuntimeError as error:  # no thread can be started
            ours.close()
            raise RpcError(Code.UNAVAILABLE, f"record.start: the daemon cannot record: {error}") from None
        for name, device_id in self._ids.items():
            made.add_device(name, device_id)
        self.running[connection.number] = made
        log.info("client %d (pid %d, uid %d) records", connection.number, connection.peer.pid, connection.uid)
        return fd

    def stop(self, connection: ClientConnection) -> tuple[bool, int]:
        """Stop the recording of a client. Return whether it had one, and the number of dropped records."""
        made = self.running.pop(connection.number, None)
        if made is None:
            return False, 0
        made.stop("it was stopped")
        self._ending.append(made)
        return True, made.records_dropped

    def snapshot(self, connection: ClientConnection) -> tuple[float, int]:
        """Send the content of the flight recorder. Return its duration, s, and the descriptor. Raises RpcError."""
        if not self._context.outputs.snapshots:
            raise RpcError(
                Code.UNAVAILABLE,
                "record.snapshot: the flight recorder is off; set `recorder: {flight: {enabled: true}}` in the "
                "configuration",
            )
        ours, fd = self._make_pair(connection, "record.snapshot")
        try:
            return self._context.outputs.snapshots[0](ours), fd
        except ImudError as error:
            ours.close()
            raise RpcError(Code.UNAVAILABLE, f"record.snapshot: {error}") from None

    def remove(self, connection: ClientConnection) -> None:
        """Abort the recording of a client that has ended."""
        self.running.pop(connection.number).close()
        log.info("client %d stopped recording: its connection has ended", connection.number)

    def _make_pair(self, connection: ClientConnection, method: str) -> tuple[socket.socket, int]:
        """Make a pair of sockets. Return the daemon's socket and the client's descriptor. Raises RpcError."""
        try:
            ours, theirs = stream_pair()
        except OSError as error:
            message = f"{method}: the daemon cannot make a descriptor: {reason_of(error)}"
            raise RpcError(Code.UNAVAILABLE, message) from None
        try:
            self._check_fds((ours.fileno(), theirs.fileno()))
            return ours, connection.lend(theirs)
        except RpcError:
            ours.close()
            theirs.close()
            raise

    # --- calls of the hub ---------------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        self._ids[name] = device_id
        for made in self.running.values():
            made.add_device(name, device_id)

    def remove_device(self, name: str) -> None:
        """Remove a device, which may be added again."""
        self._ids.pop(name, None)
        for made in self.running.values():
            made.remove_device(name)

    def tick(self, now_ns: int) -> bool:
        """Check all recordings, and close the finished ones. Return whether one needs the next tick within 100 ms."""
        if not (self.running or self._ending):
            return False
        for number, made in list(self.running.items()):
            made.tick(now_ns)
            if made.ended:
                self.running.pop(number).close()
                log.info("client %d stopped recording: it has closed its descriptor", number)
        for made in list(self._ending):
            made.tick(now_ns)
            if made.ended:
                self._ending.remove(made)
                made.close()
        return bool(self.running or self._ending)

    def close(self) -> None:
        """Stop all recordings regularly. A second call does nothing."""
        for made in self.running.values():
            made.stop("imud stopped")
        for made in (*self.running.values(), *self._ending):
            made.close(flush=True)
        self.running.clear()
        self._ending.clear()


class FirmwareUploads:
    """Images of clients for firmware updates, and one update at a time. Synchronization: the event loop's thread.

    A line of the protocol is too short for an image. `firmware.open` makes a file in memory with the size of the image
    and sends its descriptor. The client writes the image into the file. `firmware.update` reads the file once and
    checks its CRC-32, because the client can still change the content.
    """

    def __init__(self, context: PublisherContext, check_fds: Callable[[Sequence[int]], None]) -> None:
        """`check_fds` raises RpcError if clients may not use descriptors."""
        self._clock = context.clock
        self._check_fds = check_fds
        self._files: dict[int, BinaryIO] = {}  # by number of the connection
        self._running: WorkStatus | None = None

    def open(self, connection: ClientConnection, size_bytes: int) -> int:
        """Make a file in place of the previous file of the client. Return the descriptor for the reply.

        Raises RpcError.
        """
        self.remove(connection.number)
        try:
            file = os.fdopen(os.memfd_create("imud-firmware", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING), "r+b", 0)
        except OSError as error:
            message = f"firmware.open: the daemon cannot make a descriptor: {reason_of(error)}"
            raise RpcError(Code.UNAVAILABLE, message) from None
        try:
            file.truncate(size_bytes)
            fcntl(file, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL)  # the client cannot change the size
            copy = os.fdopen(os.dup(file.fileno()), "r+b", 0)
            try:
                self._check_fds((file.fileno(), copy.fileno()))
                fd = connection.lend(copy)
            except RpcError:
                copy.close()
                raise
        except (OSError, RpcError):
            file.close()
            raise
        self._files[connection.number] = file
        return fd

    def take(self, number: int, crc: int) -> bytes:
        """Remove the file of the client and return its content. Raises RpcError for another CRC-32."""
        file = self._files.pop(number, None)
        if file is None:
            raise RpcError(Code.INVALID_PARAMS, "firmware.update: expected firmware.open on this connection before")
        with file:
            file.seek(0)
            data = file.read()
        if crc32(data) != crc:
            message = f"firmware.update: expected an image with the CRC-32 {crc:#010x}, got {crc32(data):#010x}"
            raise RpcError(Code.INVALID_PARAMS, message)
        return data

    async def alone(self, device: str, uid: int, update: Callable[[], Awaitable[T]]) -> T:
        """Run an update. Raises CommandError if another update of the daemon is running."""
        now_ns = self._clock.now_ns()
        if self._running is not None:
            raise CommandError(f"{device}: {self._running.words(now_ns)}; try again later")
        self._running = WorkStatus(f"the firmware update of {device}", now_ns, f"uid {uid}", "")
        try:
            return await update()
        finally:
            self._running = None

    def remove(self, number: int) -> None:
        """Close the file of a client. Do nothing without a file."""
        file = self._files.pop(number, None)
        if file is not None:
            file.close()

    def close(self) -> None:
        """Close all files. A second call does nothing."""
        for number in list(self._files):
            self.remove(number)


WAKE_NS: Final = 300_000
"""Maximum time to wake clients in one turn of the event loop, ns. imud wakes the other clients in the next turn."""
CLIENTS_PER_CHECK: Final = 16
"""Number of clients that imud wakes between two reads of the clock."""


class Hub(Clients):
    """The devices, the newest samples, and the subscriptions of all clients. Synchronization: the event loop's thread.

    `handle_line` carries out a request (methods.py).
    """

    def __init__(
        self,
        path: str,
        context: PublisherContext,
        quota: Quota,
        time: TokenBucket,
        pool: Pool,
        handle_line: Callable[["Hub", ClientConnection, bytes], None],
    ) -> None:
        super().__init__(pool, context.clock.now_ns, partial(handle_line, self))
        self.path = path
        self.context = context
        self.control_group = "the control group"  # name of the group that may control, for error messages
        self.devices: dict[str, int] = {}  # the `device_id` of each device
        self.newest: dict[str, Batch] = {}  # the newest batch of each device
        self.history: History | None = None  # None if `socket.history` switches it off
        self.recordings = ClientRecordings(context, quota.check_fds)
        self.firmware = FirmwareUploads(context, quota.check_fds)
        self._quota = quota
        self._time = time
        self._subscriptions: dict[int, Subscription] = {}
        # devices with events for a client, None for all. A client without events is absent.
        self._events: dict[int, Collection[str] | None] = {}
        self._plans: dict[str, DeliveryPlan] = {}
        self.running: dict[int, asyncio.Task[None]] = {}  # running request of a client, by client number
        self._wanting_wake: dict[str, dict[ClientConnection, None]] = {}  # clients with a waker, by device
        # clients that imud has not woken yet for the newest batch of a device
        self._to_wake: dict[str, list[ClientConnection]] = {}

    # --- devices, samples, events -------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. Clients that watch all devices get its number before its first sample."""
        self.devices[name] = device_id
        self.recordings.add_device(name, device_id)
        watching = self._subscriptions.items()
        everything = [self.connections[number] for number, wanted in watching if wanted.devices is None]
        post_all(everything, encode_notification("device", DeviceNotice(name, device_id)))

    def remove_device(self, name: str) -> None:
        """Remove a device. Subscriptions that name it stay, because it may be added again."""
        device_id = self.devices.pop(name, None)
        if device_id is not None:
            matching = [number for number, wanted in self._subscriptions.items() if wanted.matches(name)]
            notice = encode_notification("device_removed", DeviceNotice(name, device_id))
            post_all([self.connections[number] for number in matching], notice)
        self.recordings.remove_device(name)
        self.newest.pop(name, None)
        if self.history is not None:
            self.history.remove(name)
        self._plans.pop(name, None)

    def publish(self, batch: Batch) -> None:
        device = batch.device
        self.newest[device] = batch
        if self.history is not None:
            self.history.add(batch)
        plan = self._plans.get(device)
        if plan is None:
            plan = self._plans[device] = self._new_plan(device)
        if plan.simple is not None:  # the usual case
            plan.simple.send_first(batch)
        else:
            plan.send(batch)
        if self._wanting_wake and device in self._wanting_wake:
            # later: a woken client reads shared memory, and its publisher may run after this one
            asyncio.get_running_loop().call_soon(self._wake_all, device)

    def event(self, event: Event) -> None:
        """Send an event to the clients that asked for it. Events of the daemon (device "") go to all of them."""
        for recording in self.recordings.running.values():
            recording.event(event)
        if not self._events:
            return
        device = event.device
        wanting = [
            self.connections[number]
            for number, devices in self._events.items()
            if devices is None or not device or device in devices
        ]
        for texts in (False, True):
            some = [connection for connection in wanting if connection.text_numbers is texts]
            if some:
                post_all(some, encode_notification("event", event, texts=texts))

    def _new_plan(self, device: str) -> DeliveryPlan:
        plan = DeliveryPlan(self.pool.next_order, self.context.clock.now_ns, self._time)
        for number, wanted in self._subscriptions.items():
            if wanted.matches(device):
                plan.add(wanted, self.connections[number])
        return plan

    def _wake_all(self, device: str) -> None:
        """Wake all clients with a waker for `device`; first the clients that the last batch did not wake yet."""
        waiting = self._to_wake.get(device)
        if waiting:
            left = dict.fromkeys(waiting)
            self._to_wake[device] = [*(one for one in self._wanting_wake.get(device, ()) if one not in left), *waiting]
        else:
            self._to_wake[device] = list(self._wanting_wake.get(device, ()))
            self._wake_some(device)

    def _wake_some(self, device: str) -> None:
        """Wake clients, from the end of the list, for WAKE_NS. Continue in the next turn of the event loop."""
        now_ns, waiting = self.context.clock.now_ns, self._to_wake[device]
        end_ns = now_ns() + WAKE_NS
        while waiting:
            for _ in range(min(CLIENTS_PER_CHECK, len(waiting))):
                self._wake(waiting.pop(), device)
            if waiting and now_ns() > end_ns:
                asyncio.get_running_loop().call_soon(self._wake_some, device)
                return

    def _wake(self, connection: ClientConnection, device: str) -> None:
        try:
            if not connection.wake(device):
                self._forget_waker(connection, device)
        except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
            connection.on_failure(error)

    def _forget_waker(self, connection: ClientConnection, device: str) -> None:
        wanting = self._wanting_wake.get(device)
        if wanting is not None:
            if connection in wanting:
                del wanting[connection]
                self.context.latencies.release(_requester(connection, device))
            if not wanting:
                del self._wanting_wake[device]

    # --- requests of a client -----------------------------------------------------------------------------------------

    def subscribe(self, connection: ClientConnection, subscription: Subscription) -> None:
        """Send samples to a client, in place of its previous subscription.

        Raises RpcError if the clients of its user watch too many selections of fields.
        """
        old = self._subscriptions.get(connection.number)
        self._quota.exchange_form(connection.uid, old and old.key, subscription.key)
        self._stop_sending(connection)
        self._subscriptions[connection.number] = subscription
        self.context.latencies.ask(_requester(connection), subscription.latency_ns, subscription.devices)
        for device, plan in self._plans.items():
            if subscription.matches(device):
                plan.add(subscription, connection)

    def unsubscribe(self, connection: ClientConnection) -> None:
        """Stop sending samples to a client. Do nothing if it has no subscription."""
        subscription = self._stop_sending(connection)
        if subscription is not None:
            self._quota.exchange_form(connection.uid, subscription.key, None)
            self.context.latencies.release(_requester(connection))

    def _stop_sending(self, connection: ClientConnection) -> Subscription | None:
        """Remove and return the subscription of a client."""
        subscription = self._subscriptions.pop(connection.number, None)
        if subscription is not None:
            for device, plan in self._plans.items():
                if subscription.matches(device):
                    plan.discard(subscription, connection)
        return subscription

    def subscribe_events(self, connection: ClientConnection, devices: Collection[str] | None) -> None:
        """Send events of `devices` (None for all) to a client, in place of its previous selection."""
        self._events[connection.number] = devices

    def unsubscribe_events(self, connection: ClientConnection) -> None:
        self._events.pop(connection.number, None)

    def make_waker(self, connection: ClientConnection, device: str, latency_ns: int = 0) -> int:
        """Make a descriptor that wakes a client at most `latency_ns` after a batch of `device`.

        Raises RpcError as `ClientConnection.make_waker`, or if the user has too many wakers.
        """
        uid = connection.uid
        self._quota.check_waker(uid, sum(len(one.wakers) for one in self.connections.values() if one.uid == uid))
        fd = connection.make_waker(device, self._quota.check_fds)
        self._wanting_wake.setdefault(device, {})[connection] = None
        self.context.latencies.ask(_requester(connection, device), latency_ns, (device,))
        return fd

    def wakes(self, device: str) -> bool:
        """Return whether a client has a waker for `device`."""
        return device in self._wanting_wake

    def has_news_for(self, connection: ClientConnection) -> bool:
        number = connection.number
        is_asked = number in self._subscriptions or number in self._events or number in self.running
        return is_asked or number in self.recordings.running or bool(connection.wakers)

    # --- clients ------------------------------------------------------------------------------------------------------

    def remove(self, connection: ClientConnection) -> None:
        """Remove a client and its subscriptions. Do nothing if it is unknown."""
        number = connection.number
        self.connections.pop(number, None)
        self.ending.pop(connection, None)
        if number in self._subscriptions:
            self.unsubscribe(connection)
        self._events.pop(number, None)
        if number in self.recordings.running:
            self.recordings.remove(connection)
        self.firmware.remove(number)
        for device in list(self._wanting_wake):
            self._forget_waker(connection, device)

    def clients(self) -> tuple[ClientStatus, ...]:
        return tuple(self.each_client())

    def each_client(self) -> Iterator[ClientStatus]:
        """Yield the state of every present client, as it is at that moment."""
        for number, connection in list(self.connections.items()):
            wanted = self._subscriptions.get(number)
            yield connection.status(str(wanted.form) if wanted else "")

    def status(self, clients: tuple[ClientStatus, ...] | None = None) -> SocketStatus:
        """Return the state of the socket with `clients`; None for the present clients."""
        if clients is None:
            clients = self.clients()
        return SocketStatus(self.path, clients, self.accepted, self.refused, self.evicted, self._failed)

    def tick(self, now_ns: int) -> bool:
        """Close clients whose time to read their queue is over, and check the recordings. Return whether a client needs
        the next tick within 100 ms."""
        needs_ticks = self.recordings.tick(now_ns)
        if not self.ending:
            return needs_ticks
        for connection in list(self.ending):
            try:
                connection.tick()
            except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
                connection.on_failure(error)
        return True

    def close(self) -> None:
        """Close every client and cancel running requests. A second call does nothing."""
        self.recordings.close()
        self.firmware.close()
        for connection in list(self.connections.values()):
            connection.close()
        for task in list(self.running.values()):
            task.cancel()


def post_all(connections: Iterable[ClientConnection], body: bytes) -> None:
    for connection in connections:
        try:
            connection.post(body)
        except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
            connection.on_failure(error)


def _requester(connection: ClientConnection, notified: str = "") -> str:
    """Return the name of a client in latency requests, for its subscription or for its waker of a device."""
    return f"client {connection.number}" + (f", notify {notified}" if notified else "")
