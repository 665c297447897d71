"""A device on a serial wire in simulated time, received by a UART at any baud rate.

The model works bit by bit: 8N1 at the rate of the device, sampled by a UART at the rate of the host (start edge, still
low half a bit later, then the middle of each bit). The UART delivers a byte with a wrong stop bit as sampled, as Linux
does without INPCK.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count
from random import Random
from typing import Final

from imud.contracts.driver import StreamDriver
from imud.device.search import GaveUp, Listen
from imud.device.stream_search import Search, Step, StreamFound
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns

SET_BAUD_NS: Final = 3 * NS_PER_MS
"""Duration of a change of the baud rate on a USB adapter, ns. Bytes that start in this time are lost."""
REPLY_DELAY_NS: Final = 20 * NS_PER_MS  # time from a request to the reply
TimedByte = tuple[int, int]  # end of the byte on the wire, ns; its value


def levels(data: bytes) -> list[int]:
    """Return the bits on the wire with start and stop bits, least significant bit first."""
    return [bit for byte in data for bit in (0, *((byte >> place) & 1 for place in range(8)), 1)]


@lru_cache(maxsize=4096)
def received(data: bytes, device_baud: int, host_baud: int) -> tuple[TimedByte, ...]:
    """Return the bytes that a UART at `host_baud` receives of `data`, sent at `device_baud` from time 0."""
    if device_baud == host_baud:
        byte_ns = uart_byte_ns(host_baud)
        return tuple(((index + 1) * byte_ns, byte) for index, byte in enumerate(data))
    bits = levels(data)
    device_ns, host_ns = NS_PER_S / device_baud, NS_PER_S / host_baud
    falling = [i * device_ns for i, bit in enumerate(bits) if bit == 0 and (i == 0 or bits[i - 1] == 1)]

    def level(t_ns: float) -> int:
        index = int(t_ns / device_ns)
        return bits[index] if index < len(bits) else 1

    result: list[TimedByte] = []
    t_ns = 0.0
    while (at := bisect_left(falling, t_ns)) < len(falling):
        start_ns = falling[at]
        if level(start_ns + host_ns / 2):  # a glitch, not a start bit
            t_ns = start_ns + host_ns / 2
            continue
        value = sum(level(start_ns + (1.5 + place) * host_ns) << place for place in range(8))
        t_ns = start_ns + 9.5 * host_ns
        result.append((round(start_ns + 10 * host_ns), value))
    return tuple(result)


@dataclass
class FakeDevice:
    driver: StreamDriver
    baud: int
    rate_hz: float
    phase_ns: int = 0
    poll_ns: int = NS_PER_MS
    """Interval at which the host reads bytes, ns: 1 ms for a scheduler, 16 ms for a USB adapter."""
    reply: bytes = b""
    query: bytes = b""
    make_frame: Callable[[Random], bytes] | None = None
    """Frames that the device sends; None for the example frames of the driver."""
    noise: bytes = b""
    damage: float = 0.0  # share of frames with one inverted bit
    random: Random = field(default_factory=lambda: Random(1))
    sent_to: list[tuple[int, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        make = self.make_frame or self.driver.example_frame
        self.frames = [self.noise or self._maybe_damaged(make(self.random)) for _ in range(16)]

    def _maybe_damaged(self, frame: bytes) -> bytes:
        if self.random.random() >= self.damage:
            return frame
        place = self.random.randrange(8, len(frame))
        return frame[:place] + bytes([frame[place] ^ 1]) + frame[place + 1 :]

    def stream(self, host_baud: int, from_ns: int) -> Iterator[TimedByte]:
        if not self.rate_hz:
            return
        wire_ns = max(map(len, self.frames)) * uart_byte_ns(self.baud)
        period_ns = max(round(NS_PER_S / self.rate_hz), wire_ns)
        host_byte_ns = uart_byte_ns(host_baud)
        for number in count(max((from_ns - self.phase_ns) // period_ns - 1, 0)):
            start_ns = self.phase_ns + number * period_ns
            for offset_ns, value in received(self.frames[number % len(self.frames)], self.baud, host_baud):
                if start_ns + offset_ns - host_byte_ns >= from_ns:
                    yield start_ns + offset_ns, value

    def visit(self, step: Listen, now_ns: int) -> Iterator[tuple[int, bytes]]:
        source = self.stream(step.baud, now_ns + SET_BAUD_NS)
        if step.send:
            self.sent_to.append((step.baud, step.send))
            if step.send == self.query and step.baud == self.baud:
                source = iter(self._answer(now_ns))
        polled_ns, gathered = 0, bytearray()
        for t_ns, value in source:
            due_ns = -(-t_ns // self.poll_ns) * self.poll_ns
            if gathered and due_ns > polled_ns:
                yield polled_ns, bytes(gathered)
                gathered.clear()
            polled_ns = due_ns
            gathered.append(value)
        if gathered:
            yield polled_ns, bytes(gathered)

    def _answer(self, now_ns: int) -> Sequence[TimedByte]:
        start_ns = now_ns + SET_BAUD_NS + len(self.query) * uart_byte_ns(self.baud) + REPLY_DELAY_NS
        return [(start_ns + offset_ns, value) for offset_ns, value in received(self.reply, self.baud, self.baud)]


def run_search(search: Search, device: FakeDevice, start_ns: int = 0) -> tuple[StreamFound | GaveUp, int, list[Listen]]:
    """Run a search to its end in simulated time. Return the result, its duration (ns), and every Listen."""
    now_ns, visits = start_ns, []
    step: Step | None = search.start(now_ns)
    while isinstance(step, Listen):
        visits.append(step)
        reads = device.visit(step, now_ns)
        step, now_ns = _stay(search, reads, step)
    assert step is not None
    return step, now_ns - start_ns, visits


def _stay(search: Search, reads: Iterator[tuple[int, bytes]], listen: Listen) -> tuple[Step, int]:
    """Make one stay at one rate, as long as the search requests. Return the step that ends it, and its time."""
    until_ns = listen.until_ns
    t_ns, data = next(reads, (1 << 62, b""))
    while True:
        if t_ns <= until_ns:
            now_ns, step = t_ns, search.on_data(data, t_ns)
            t_ns, data = next(reads, (1 << 62, b""))
        else:
            now_ns, step = until_ns, search.on_time(until_ns)
        if isinstance(step, Listen) and step.baud == listen.baud and not step.send and step.until_ns != until_ns:
            until_ns = step.until_ns
        elif step is not None:
            return step, now_ns
