"""How long to wait before something is tried again: longer each time, up to a bound, short again after success."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Final

FIRST_S: Final = 0.5
LONGEST_S: Final = 30.0


class Retry:
    """Pauses between attempts. Synchronization: one task."""

    def __init__(self, sleep: Callable[[float], Awaitable[None]] = asyncio.sleep) -> None:
        self._sleep = sleep
        self._pause_s = FIRST_S

    async def pause(self) -> None:
        """Wait; twice as long as the last time, LONGEST_S at most."""
        pause_s, self._pause_s = self._pause_s, min(self._pause_s * 2, LONGEST_S)
        await self._sleep(pause_s)

    def reset(self) -> None:
        """It went well: the next pause is short."""
        self._pause_s = FIRST_S
