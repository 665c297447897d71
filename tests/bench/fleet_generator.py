"""Simulated gateways for load tests: one MQTT 3.1.1 connection each, in processes of their own.

    parent: Generators ──shared counters──▶ process: epoll loop ──PUBLISH, QoS 1──▶ broker

The generator must not be the limit. All gateways send the same numbers in the same turn, so a message is the
concatenation of three encoded parts: the topic of the device, the start of the JSON object with its names, and the rest
of the object, which all devices share. A gateway stores only the number of its sent and of its acknowledged messages.
The packets follow OASIS MQTT 3.1.1, sections 2 and 3. After a lost connection, a gateway connects to the next broker of
its list and sends all messages without an acknowledgement again.
"""

import ctypes
import errno
import multiprocessing
import resource
import select
import socket
import struct
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from random import Random
from time import monotonic
from typing import Final, NamedTuple, Self

from imud.fleet.messages import (
    FleetMessage,
    GatewayClock,
    Interval,
    Measures,
    MessageKind,
    Stream,
    encode_message,
    topic_of,
)
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.support.daemon_process import wait_until

SITE: Final = "load"
SAMPLES: Final = 100  # samples per interval; an interval has 1 s
WINDOW: Final = 20  # messages without an acknowledgement per gateway, as in the output `mqtt`
CONNECTING_MAX: Final = 50  # gateways that wait for CONNACK at a time; a broker has a queue of 100 connections
CONNECT_S: Final = 120.0  # maximum time until all gateways are connected, s
ANSWER_S: Final = 15.0  # maximum time without an acknowledgement, s; the gateway then connects again
RETRY_S: Final = 2.0  # maximum wait before a new connection, random, s
POLL_S: Final = 0.005
CHECK_S: Final = 0.5
READ_BYTES: Final = 65_536
TAILS: Final = 4096  # number of encoded parts in memory, 2 MB
RESERVED: Final = 100  # descriptors of a process that are not connections
_CONNACK: Final = b"\x20\x02\x00\x00"  # accepted, no session (section 3.2)


class Offer(NamedTuple):
    """Messages that simulated gateways offer to the brokers."""

    gateways: int
    devices: int  # per gateway; each has messages of its own
    intervals: int  # intervals per message, one per second of data
    period_s: float  # time between two messages of a device, s; 0: as fast as the broker acknowledges
    begin_utc_ns: int  # UTC time of the first interval; also the name of the boot
    messages: int = 1 << 40  # maximum number of messages per device

    @property
    def per_second(self) -> float:
        """Return the number of messages per second of all gateways."""
        return self.gateways * self.devices / self.period_s

    @property
    def boot(self) -> str:
        return f"{self.begin_utc_ns:016x}"

    @property
    def numbers(self) -> int:
        """Return the number of sequence numbers in a message."""
        return self.intervals * SAMPLES


class _Counters(ctypes.Structure):
    """Counters of one process, in memory that the parent shares."""

    _fields_ = (
        ("begin_s", ctypes.c_double),  # CLOCK_MONOTONIC at which the gateways start; 0: not yet
        ("is_over", ctypes.c_bool),  # True: no new messages
        ("ready", ctypes.c_longlong),  # number of connected gateways
        ("connects", ctypes.c_longlong),
        ("offered", ctypes.c_longlong),  # number of messages
        ("acknowledged", ctypes.c_longlong),  # number of messages
        ("late_s", ctypes.c_double),  # maximum delay of the generator itself, s
    )


class Generators:
    """Processes with simulated gateways. Synchronization: one thread."""

    def __init__(self, offer: Offer, ports: Sequence[int], processes: int = 1) -> None:
        """Start the processes and wait until all gateways are connected."""
        context = multiprocessing.get_context("spawn")
        numbers = [range(at, offer.gateways, processes) for at in range(processes)]
        self._counters = [context.RawValue(_Counters) for _ in numbers]
        self._processes = [
            context.Process(target=_main, args=(offer, tuple(ports), some, counters), daemon=True)
            for some, counters in zip(numbers, self._counters, strict=True)
        ]
        for process in self._processes:
            process.start()
        wait_until(lambda: self._sum("ready") == offer.gateways or not self.is_alive, "all gateways connect", CONNECT_S)
        assert self.is_alive, "a generator ended; see its traceback"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.terminate()
            process.join()

    @property
    def is_alive(self) -> bool:
        return all(process.is_alive() for process in self._processes)

    @property
    def pids(self) -> list[int]:
        return [process.pid for process in self._processes if process.pid is not None]

    def begin(self) -> float:
        """Let the gateways send. Return CLOCK_MONOTONIC of the first message, s."""
        begin_s = monotonic()
        for one in self._counters:
            one.begin_s = begin_s
        return begin_s

    def end(self) -> None:
        """Offer no new messages. The gateways still send the offered messages."""
        for one in self._counters:
            one.is_over = True

    def forget_delays(self) -> None:
        for one in self._counters:
            one.late_s = 0.0

    @property
    def offered(self) -> int:
        return self._sum("offered")

    @property
    def acknowledged(self) -> int:
        return self._sum("acknowledged")

    @property
    def connects(self) -> int:
        return self._sum("connects")

    @property
    def late_s(self) -> float:
        return float(max(one.late_s for one in self._counters))

    def _sum(self, name: str) -> int:
        return sum(getattr(one, name) for one in self._counters)


class _Gateway:
    __slots__ = (
        "acknowledged", "at", "due", "heads", "heard_s", "is_ready", "number", "out", "read", "retry_s", "sent",
        "socket",
    )  # fmt: skip

    def __init__(self, number: int, offer: Offer, ports: Sequence[int]) -> None:
        self.number = number
        self.at = number % len(ports)
        # topic with its length, and the start of the JSON object, for each device
        self.heads = [_head(number, f"d{device}", offer.boot) for device in range(offer.devices)]
        self.socket: socket.socket | None = None
        self.is_ready = False
        self.due = self.sent = self.acknowledged = 0  # number of messages
        self.heard_s = self.retry_s = 0.0
        self.out = self.read = b""


def gateway_name(number: int) -> str:
    return f"gw-{number}"


def _head(number: int, device: str, boot: str) -> tuple[bytes, bytes]:
    gateway = gateway_name(number)
    topic = topic_of(SITE, gateway, device, Stream.STATISTICS).encode()
    names = f'{{"v":1,"gateway":"{gateway}","boot":"{boot}","device":"{device}",'
    return struct.pack(">H", len(topic)) + topic, names.encode()


def _tail(turn: int, offer: Offer) -> bytes:
    """Return the part of the messages of a turn that all devices share."""
    first, last = turn * offer.numbers + 1, (turn + 1) * offer.numbers
    starts = range(first, last, SAMPLES)
    intervals = [_interval(one, offer.begin_utc_ns) for one in starts]
    clock = GatewayClock(intervals[-1].end_t_ns, offer.begin_utc_ns, synchronised=True, error_ns=1000)
    message = FleetMessage(
        v=1, gateway="", boot="", device="", kind=MessageKind.INTERVALS, begin=1, first=first, last=last,
        count=last - first + 1, utc_ns=intervals[-1].end_utc_ns, clock=clock, intervals=intervals,
    )  # fmt: skip
    return encode_message(message).partition(b'"device":"",')[2]


def _interval(first: int, begin_utc_ns: int) -> Interval:
    def vector(scale: float) -> Measures:
        value = (scale * first * 0.1234567, scale * 0.7654321, scale * 9.8066512)
        return Measures(value, value, value, value)

    begin_ns = (first - 1) * NS_PER_S // SAMPLES
    end_ns = begin_ns + (SAMPLES - 1) * NS_PER_S // SAMPLES
    return Interval(
        first, first + SAMPLES - 1, SAMPLES, begin_ns, end_ns, begin_utc_ns + begin_ns, begin_utc_ns + end_ns,
        NS_PER_MS // 100, Sync.REGRESSION,
        {"accel_m_s2": vector(1.0), "gyro_rad_s": vector(0.01), "euler_rad": vector(0.1)},
    )  # fmt: skip


def raise_descriptor_limit(number: int) -> None:
    """Raise the limit of descriptors of this process and its children. Raises SystemExit if the host refuses it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft >= number:
        return
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (number, max(hard, number)))
    except (OSError, ValueError) as error:
        raise SystemExit(
            f"expected a limit of {number} descriptors, got {hard}: {error}; try ulimit -n {number}"
        ) from None


def _main(offer: Offer, ports: tuple[int, ...], numbers: range, counters: _Counters) -> None:
    _Generator(offer, ports, numbers, counters).run()


class _Generator:
    """Gateways of one process. Synchronization: one thread."""

    def __init__(self, offer: Offer, ports: tuple[int, ...], numbers: range, counters: _Counters) -> None:
        self._offer, self._ports, self._counters = offer, ports, counters
        self._gateways = [_Gateway(number, offer, ports) for number in numbers]
        self._turns = 0  # number of offered messages of the process, divided by the number of devices
        self._epoll = select.epoll()
        self._by_descriptor: dict[int, _Gateway] = {}
        self._connecting = 0
        self._random = Random(numbers.start)
        self._tail = lru_cache(TAILS)(lambda turn: _tail(turn, offer))

    def run(self) -> None:
        parent, checked_s = multiprocessing.parent_process(), 0.0
        while True:
            for descriptor, events in self._epoll.poll(POLL_S):
                gateway = self._by_descriptor[descriptor]
                try:
                    self._handle(gateway, events)
                except OSError:
                    self._lose(gateway)
            self._offer_due()
            now_s = monotonic()
            if now_s - checked_s > CHECK_S or self._counters.ready + self._connecting < len(self._gateways):
                checked_s = now_s
                self._check(now_s)
                if parent is None or not parent.is_alive():
                    return

    def _handle(self, gateway: _Gateway, events: int) -> None:
        if events & ~select.EPOLLOUT:
            self._read(gateway)
        if events & select.EPOLLOUT and gateway.socket is not None:
            self._write(gateway, b"")

    def _offer_due(self) -> None:
        """Offer the messages whose time has come, one turn of a gateway after another."""
        offer, counters = self._offer, self._counters
        if counters.is_over or not counters.begin_s:
            return
        count, elapsed_s = len(self._gateways), monotonic() - counters.begin_s
        most = offer.messages * count
        due = min(most, int(elapsed_s / offer.period_s * count) + 1) if offer.period_s else most
        if offer.period_s and due > self._turns:
            counters.late_s = max(counters.late_s, elapsed_s - self._turns * offer.period_s / count)
        for turn in range(self._turns, due):
            gateway = self._gateways[turn % count]
            gateway.due += offer.devices
            self._send_safely(gateway)
        self._turns = max(self._turns, due)
        counters.offered = self._turns * offer.devices

    def _send_safely(self, gateway: _Gateway) -> None:
        try:
            self._send(gateway)
        except OSError:
            self._lose(gateway)

    def _send(self, gateway: _Gateway) -> None:
        """Send due messages, at most WINDOW without an acknowledgement."""
        last = min(gateway.due, gateway.acknowledged + WINDOW)
        if not gateway.is_ready or gateway.out or last <= gateway.sent:
            return
        if gateway.sent == gateway.acknowledged:
            gateway.heard_s = monotonic()
        parts: list[bytes] = []
        devices = self._offer.devices
        for number in range(gateway.sent, last):
            turn, device = divmod(number, devices)
            (topic, names), tail = gateway.heads[device], self._tail(turn)
            # PUBLISH with QoS 1 (section 3.3)
            size = len(topic) + 2 + len(names) + len(tail)
            parts += (b"\x32", _length(size), topic, struct.pack(">H", number % 0xFFFF + 1), names, tail)
        gateway.sent = last
        self._write(gateway, b"".join(parts))

    def _write(self, gateway: _Gateway, data: bytes) -> None:
        assert gateway.socket is not None
        had_rest = bool(gateway.out)
        data = gateway.out + data
        if data:
            with suppress(BlockingIOError):
                data = data[gateway.socket.send(data) :]
        gateway.out = data
        if bool(data) != had_rest:
            self._epoll.modify(gateway.socket, select.EPOLLIN | (select.EPOLLOUT if data else 0))
        if had_rest and not data:
            self._send(gateway)

    def _read(self, gateway: _Gateway) -> None:
        assert gateway.socket is not None
        try:
            data = gateway.read + gateway.socket.recv(READ_BYTES)
        except BlockingIOError:
            return
        if len(data) == len(gateway.read):
            raise ConnectionResetError
        gateway.heard_s = monotonic()
        if not gateway.is_ready:
            if data[:4] != _CONNACK[: len(data)]:
                raise ConnectionRefusedError
            if len(data) < len(_CONNACK):
                gateway.read = data
                return
            data = data[len(_CONNACK) :]
            gateway.is_ready = True
            self._connecting -= 1
            self._counters.ready += 1
            self._counters.connects += 1
        # PUBACK has 4 bytes, and brokers acknowledge messages in order (sections 3.4 and 4.6)
        count, rest = divmod(len(data), 4)
        if data[: 4 * count : 4] != b"\x40" * count:
            raise ConnectionRefusedError
        gateway.read = data[len(data) - rest :] if rest else b""
        gateway.acknowledged += count
        self._counters.acknowledged += count
        self._send(gateway)

    # --- connections --------------------------------------------------------------------------------------------------

    def _check(self, now_s: float) -> None:
        """Open missing connections. Close connections without acknowledgements."""
        for gateway in self._gateways:
            if gateway.socket is None:
                if self._connecting < CONNECTING_MAX and now_s >= gateway.retry_s:
                    self._connect(gateway, now_s)
            elif now_s - gateway.heard_s > ANSWER_S and (gateway.sent > gateway.acknowledged or not gateway.is_ready):
                self._lose(gateway)

    def _connect(self, gateway: _Gateway, now_s: float) -> None:
        made = socket.socket()
        made.setblocking(False)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        status = made.connect_ex(("127.0.0.1", self._ports[gateway.at]))
        if status not in (0, errno.EINPROGRESS):
            made.close()
            gateway.retry_s = now_s + self._random.random() * RETRY_S
            return
        name = gateway_name(gateway.number).encode()
        # protocol level 4, clean session, no keep-alive (section 3.1)
        head = b"\x00\x04MQTT\x04\x02\x00\x00" + struct.pack(">H", len(name)) + name
        gateway.out = b"\x10" + _length(len(head)) + head
        gateway.socket, gateway.heard_s = made, now_s
        self._connecting += 1
        self._by_descriptor[made.fileno()] = gateway
        self._epoll.register(made, select.EPOLLIN | select.EPOLLOUT)

    def _lose(self, gateway: _Gateway) -> None:
        made, gateway.socket = gateway.socket, None
        if made is None:
            return
        if gateway.is_ready:
            self._counters.ready -= 1
        else:
            self._connecting -= 1
        gateway.is_ready = False
        gateway.sent = gateway.acknowledged
        gateway.out = gateway.read = b""
        gateway.at = (gateway.at + 1) % len(self._ports)
        gateway.retry_s = monotonic() + self._random.random() * RETRY_S
        del self._by_descriptor[made.fileno()]
        with suppress(OSError):
            self._epoll.unregister(made)
        made.close()


@lru_cache(1024)
def _length(size: int) -> bytes:
    """Return the remaining length of a packet (section 2.2.3)."""
    found = bytearray()
    while True:
        size, low = divmod(size, 128)
        found.append(low | (128 if size else 0))
        if not size:
            return bytes(found)
