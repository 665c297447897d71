"""Keeps the sentences that a source gives."""

import asyncio
from collections.abc import Callable

LIMIT_S = 10.0


class Sentences:
    """What came so far, and a way to wait for more."""

    def __init__(self) -> None:
        self.got: list[tuple[bytes, int]] = []
        self._told = asyncio.Event()

    def __call__(self, sentence: bytes, t_rx_ns: int) -> None:
        self.got.append((sentence, t_rx_ns))
        self._told.set()

    @property
    def data(self) -> list[bytes]:
        return [sentence for sentence, _ in self.got]

    async def until(self, condition: Callable[[], bool]) -> None:
        """Return when the condition holds, looked at after each sentence."""
        async with asyncio.timeout(LIMIT_S):
            while not condition():
                self._told.clear()
                await self._told.wait()


async def soon(_seconds: float) -> None:
    """A pause that is none, for `Retry`."""
    await asyncio.sleep(0)
