"""The wire of a UART: transmission at the baud rate of the device, and reception at another rate."""

from collections import deque
from typing import Final

from imud.model.units import BITS_PER_UART_BYTE, NS_PER_S
from imud.sim.sensor import Burst

# Maximum difference of two rates at which bytes are readable. At ±5 %, the last of 10 bits is sampled half a bit late,
# and edges are not ideal.
TOLERANCE: Final = 0.03


class Transmitter:
    """Transmitter with a buffer of limited size. Bursts keep their order and never overlap."""

    def __init__(self, baud: int, buffer_bytes: int, free_ns: int) -> None:
        """The wire is busy until `free_ns`."""
        self.baud: int = baud  # baud rate, bit/s
        self._buffer_ns = self.wire_ns(buffer_bytes)
        self._free_ns = free_ns
        self._waiting: deque[Burst] = deque()

    def wire_ns(self, size_bytes: int) -> int:
        """Return the time of this number of bytes on the wire, ns."""
        return size_bytes * BITS_PER_UART_BYTE * NS_PER_S // self.baud

    def due_ns(self, ready_ns: int, size_bytes: int) -> int:
        """Return the end of a burst that is ready at `ready_ns`."""
        return max(ready_ns, self._free_ns) + self.wire_ns(size_bytes)

    def fits(self, ready_ns: int, size_bytes: int) -> bool:
        """Return whether the buffer has space for the burst at `ready_ns`."""
        return self.due_ns(ready_ns, size_bytes) - ready_ns <= self._buffer_ns

    def send(self, ready_ns: int, data: bytes, sample_ns: int | None = None, device_ms: int | None = None) -> None:
        """Queue a burst, also if it does not fit into the buffer."""
        self._free_ns = self.due_ns(ready_ns, len(data))
        self._waiting.append(Burst(self._free_ns, data, sample_ns, device_ms))

    def sent(self, now_ns: int) -> list[Burst]:
        """Return and remove the bursts that have left the wire."""
        waiting, done = self._waiting, []
        while waiting and waiting[0].due_ns <= now_ns:
            done.append(waiting.popleft())
        return done

    def next_ns(self) -> int | None:
        """Return the end of the next burst; None if the queue is empty."""
        return self._waiting[0].due_ns if self._waiting else None

    def stopped(self, now_ns: int) -> list[Burst]:
        """Cut the power. Return the bursts sent so far; the last burst may be incomplete."""
        through = self.sent(now_ns)
        if self._waiting:
            burst = self._waiting.popleft()
            left_ns = now_ns - (burst.due_ns - self.wire_ns(len(burst.data)))
            size = max(left_ns, 0) * self.baud // (BITS_PER_UART_BYTE * NS_PER_S)
            if size:
                through.append(Burst(now_ns, burst.data[:size]))
            self._waiting.clear()
        return through


def heard(data: bytes, sent_baud: int, listening_baud: int) -> bytes:
    """Return the bytes that a receiver at `listening_baud` reads from 8N1 `data` sent at `sent_baud` (0 bit/s: no
    bytes).

    The wire is idle before and after the data. The receiver delivers a byte without a valid stop bit as sampled, as a
    Linux tty without INPCK. Then it waits until the wire is idle.
    """
    if not sent_baud or not listening_baud:
        return b""
    if abs(sent_baud - listening_baud) <= TOLERANCE * listening_baud:
        return data
    return _sampled(_line(data), sent_baud / listening_baud)


def _line(data: bytes) -> bytes:
    """Return one 0 or 1 per bit time: start bit, eight data bits from the lowest bit, stop bit."""
    return b"".join(_SYMBOLS[byte] for byte in data)


def _sampled(line: bytes, ratio: float) -> bytes:
    """Return the bytes that a receiver reads from `line`. Its bit time is `ratio` times the bit time of the line."""
    end, found, at = len(line), bytearray(), 0
    while (start := line.find(0, at)) >= 0:
        bits = [line[i] if (i := int(start + (n + 0.5) * ratio)) < end else 1 for n in range(BITS_PER_UART_BYTE)]
        if bits[0]:  # shorter than half a bit: a glitch, not a start bit
            at = line.find(1, start)
            continue
        found.append(sum(bit << n for n, bit in enumerate(bits[1:9])))
        at = int(start + 9.5 * ratio)
        if not bits[9] and (at := line.find(1, at)) < 0:
            break
    return bytes(found)


_SYMBOLS = tuple(bytes([0, *(byte >> n & 1 for n in range(8)), 1]) for byte in range(256))
