"""The sending half of a UART: one burst after the other at the rate of the wire, from a buffer with an end."""

from collections import deque

from imud.sim.simulator import Burst
from imud.units import BITS_PER_UART_BYTE, NS_PER_S


class Transmitter:
    """Times what a device sends. Bursts never overlap and never overtake each other."""

    def __init__(self, baud: int, buffer_bytes: int, free_ns: int) -> None:
        """`free_ns`: nothing leaves before."""
        self.baud = baud
        self._buffer_ns = self.wire_ns(buffer_bytes)
        self._free_ns = free_ns
        self._waiting: deque[Burst] = deque()

    def wire_ns(self, size_bytes: int) -> int:
        """Time of so many bytes on the wire."""
        return size_bytes * BITS_PER_UART_BYTE * NS_PER_S // self.baud

    def due_ns(self, ready_ns: int, size_bytes: int) -> int:
        """When a burst that is ready then would be through."""
        return max(ready_ns, self._free_ns) + self.wire_ns(size_bytes)

    def fits(self, ready_ns: int, size_bytes: int) -> bool:
        """Whether the buffer has room for it at that time."""
        return self.due_ns(ready_ns, size_bytes) - ready_ns <= self._buffer_ns

    def send(self, ready_ns: int, data: bytes, sample_ns: int | None = None, device_ms: int | None = None) -> None:
        """Queue a burst, room or not."""
        self._free_ns = self.due_ns(ready_ns, len(data))
        self._waiting.append(Burst(self._free_ns, data, sample_ns, device_ms))

    def sent(self, now_ns: int) -> list[Burst]:
        """Take out what has left the wire by now."""
        waiting, done = self._waiting, []
        while waiting and waiting[0].due_ns <= now_ns:
            done.append(waiting.popleft())
        return done

    def next_ns(self) -> int | None:
        """When the next burst is through, None if none waits."""
        return self._waiting[0].due_ns if self._waiting else None

    def stopped(self, now_ns: int) -> list[Burst]:
        """Power is gone: what got through, the beginning of the burst on the wire last. The rest is forgotten."""
        through = self.sent(now_ns)
        if self._waiting:
            burst = self._waiting.popleft()
            left_ns = now_ns - (burst.due_ns - self.wire_ns(len(burst.data)))
            size = max(left_ns, 0) * self.baud // (BITS_PER_UART_BYTE * NS_PER_S)
            if size:
                through.append(Burst(now_ns, burst.data[:size]))
            self._waiting.clear()
        return through
