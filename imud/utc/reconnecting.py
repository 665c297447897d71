"""What the sources have in common that read a stream which may go away and come back."""

import asyncio
from abc import ABC, abstractmethod
from contextlib import suppress

from imud.utc.retry import Retry
from imud.utc.source import OnSentence
from imud.utc.splitter import SentenceSplitter


class ReconnectingSource(ABC):
    """An `RmcSource` that tries again after each end. Synchronization: the loop's thread only."""

    def __init__(self, title: str, retry: Retry | None) -> None:
        self.title = title
        self.problem = ""
        self.sentences = 0
        self._retry = retry or Retry()
        self._splitter = SentenceSplitter()
        self._on_sentence: OnSentence = _nobody
        self._task: asyncio.Task[None] | None = None

    def start(self, on_sentence: OnSentence) -> None:
        """Give sentences from now on."""
        self._on_sentence = on_sentence
        self._task = asyncio.get_running_loop().create_task(self._run(), name=self.title)

    async def close(self) -> None:
        """Stop and let go of everything; may be called twice."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    @abstractmethod
    async def _listen(self) -> None:
        """One connection from beginning to end; leaves the reason of its end in `problem`."""

    async def _run(self) -> None:
        while True:
            self._splitter.clear()
            await self._listen()
            await self._retry.pause()

    def _take(self, data: bytes, t_rx_ns: int) -> None:
        """Bytes of the stream, with CLOCK_MONOTONIC right after the read."""
        for sentence in self._splitter.feed(data):
            self.problem = ""
            self.sentences += 1
            self._retry.reset()
            self._on_sentence(sentence, t_rx_ns)


def _nobody(sentence: bytes, t_rx_ns: int) -> None:
    """Before `start` nobody listens."""
