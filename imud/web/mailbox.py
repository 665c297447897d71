"""What waits for one browser: bounded, the newest wins, what is left out is counted.

A page acknowledges what it has drawn. At most WINDOW_MAX messages are on their way at a time: without that, a slow
connection (a tunnel, a telephone) would have megabytes of old samples in the buffers of its kernels.
"""

import asyncio
from collections import deque
from typing import Final

FRAMES_MAX: Final = 100
"""Messages of samples and events that wait: 2 s at 50 Hz. Of state and status only the newest waits, each once."""
WINDOW_MAX: Final = 100
"""Messages that were sent and are not acknowledged: 2 s at 50 Hz, while pages acknowledge four times a second."""


class Mailbox:
    """Messages for one browser. Synchronization: one event loop."""

    def __init__(self) -> None:
        self.dropped = 0
        """Messages left out."""
        self._newest: dict[str, str] = {}
        self._frames: deque[str] = deque()
        self._on_the_way = 0
        self._changed = asyncio.Event()

    def put(self, message: str) -> None:
        """Add a message behind those that wait; the oldest goes where there are too many."""
        if len(self._frames) >= FRAMES_MAX:
            self._frames.popleft()
            self.dropped += 1
        self._frames.append(message)
        self._changed.set()

    def put_newest(self, subject: str, message: str) -> None:
        """Add a message of which only the newest on its subject is of use; one that waits is replaced."""
        self._newest[subject] = message
        self._changed.set()

    def acknowledge(self, messages: int) -> None:
        """Note that the page has dealt with so many; more than were sent is all of them."""
        self._on_the_way = max(0, self._on_the_way - max(0, messages))
        self._changed.set()

    def forget(self) -> None:
        """Throw away what waits: the page shows something else now."""
        self._frames.clear()
        self._newest.clear()

    @property
    def waiting(self) -> int:
        """Messages that wait."""
        return len(self._newest) + len(self._frames)

    async def take(self) -> str:
        """Wait for the next message to send, and for room on the way."""
        while not self.waiting or self._on_the_way >= WINDOW_MAX:
            self._changed.clear()
            await self._changed.wait()
        self._on_the_way += 1
        if self._newest:
            return self._newest.pop(next(iter(self._newest)))
        return self._frames.popleft()
