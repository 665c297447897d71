"""A source of RMC sentences from the test, and a receiver that stores sentences."""

import asyncio
from collections.abc import Callable

from imud.utc.receivers import OnSentence

LIMIT_S = 60.0


class Sentences:
    def __init__(self) -> None:
        self.got: list[tuple[bytes, int]] = []
        self._arrived = asyncio.Event()

    def __call__(self, sentence: bytes, t_rx_ns: int) -> None:
        self.got.append((sentence, t_rx_ns))
        self._arrived.set()

    @property
    def data(self) -> list[bytes]:
        return [sentence for sentence, _ in self.got]

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(LIMIT_S):
            while not condition():
                self._arrived.clear()
                await self._arrived.wait()


async def soon(_seconds: float) -> None:
    await asyncio.sleep(0)


class FakeSource:
    title = "test"
    problem = ""

    def __init__(self) -> None:
        self.sentences = 0
        self.give: OnSentence = lambda _sentence, _t_rx_ns: None
        self.started = 0
        self.closed = False

    def start(self, on_sentence: OnSentence) -> None:
        self.started += 1
        self.give = on_sentence

    def close(self) -> None:
        self.closed = True
