"""RMC sentences out of a byte stream that may end and begin again: the base of the sources that read one."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from typing import Final

from imud.formats.rmc import RMC_BYTES_MAX
from imud.utc.source import OnSentence

LINE_BYTES_MAX: Final = 16384
"""Longer lines (gpsd writes JSON of some kilobytes) are skipped without being buffered."""
FIRST_PAUSE_S: Final = 0.5
LONGEST_PAUSE_S: Final = 30.0


class SentenceSplitter:
    """Finder of RMC sentences among other sentences, JSON and noise. Buffers LINE_BYTES_MAX at most.

    Synchronization: one thread.
    """

    def __init__(self) -> None:
        self._tail = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """Add bytes, split anywhere; return the complete sentences, with CR LF, checksums not verified."""
        *lines, tail = (self._tail + data).split(b"\n")
        if lines and self._skipping:
            lines, self._skipping = lines[1:], False
        if len(tail) > LINE_BYTES_MAX:
            tail, self._skipping = b"", True
        self._tail = b"" if self._skipping else tail
        return [sentence for line in lines if len(line) <= LINE_BYTES_MAX and (sentence := _rmc_in(line))]

    def clear(self) -> None:
        """Drop the buffered bytes: the stream begins again."""
        self._tail, self._skipping = b"", False


class Retry:
    """Pauses between attempts: each twice as long as the last, short again after a success.

    Synchronization: one task.
    """

    def __init__(self, sleep: Callable[[float], Awaitable[None]] = asyncio.sleep) -> None:
        self._sleep = sleep
        self._pause_s = FIRST_PAUSE_S

    async def pause(self) -> None:
        """Sleep for the next pause, LONGEST_PAUSE_S at most."""
        pause_s, self._pause_s = self._pause_s, min(self._pause_s * 2, LONGEST_PAUSE_S)
        await self._sleep(pause_s)

    def reset(self) -> None:
        """Note a success."""
        self._pause_s = FIRST_PAUSE_S


class ReconnectingSource(ABC):
    """An `RmcSource` that connects again after each end of its stream. Synchronization: the loop's thread only."""

    def __init__(self, title: str, retry: Retry | None) -> None:
        self.title = title
        self.problem = ""
        self.sentences = 0
        self._retry = retry or Retry()
        self._splitter = SentenceSplitter()
        self._on_sentence: OnSentence = _ignore
        self._task: asyncio.Task[None] | None = None

    def start(self, on_sentence: OnSentence) -> None:
        """Deliver sentences from now on. Needs a running loop."""
        self._on_sentence = on_sentence
        self._task = asyncio.get_running_loop().create_task(self._run(), name=self.title)

    def close(self) -> None:
        """Close the connection, and deliver nothing more; may be called twice."""
        self._on_sentence = _ignore
        self._disconnect()
        if self._task is not None:
            self._task.cancel()
            self._task = None

    @abstractmethod
    async def _connect_and_read(self) -> None:
        """Serve one connection from begin to end, and leave the reason of its end in `problem`."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Close the connection, if any; may be called twice."""

    async def _run(self) -> None:
        while True:
            self._splitter.clear()
            await self._connect_and_read()
            await self._retry.pause()

    def _on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Add bytes of the stream; `t_rx_ns` is CLOCK_MONOTONIC right after the read."""
        for sentence in self._splitter.feed(data):
            self.problem = ""
            self.sentences += 1
            self._retry.reset()
            self._on_sentence(sentence, t_rx_ns)


def _rmc_in(line: bytes) -> bytes | None:
    """Return the RMC sentence at the end of a line: lost bytes may have joined it to an earlier one."""
    begin = line.rfind(b"$")
    sentence = line[begin:].rstrip(b"\r")
    if begin < 0 or sentence[3:7] != b"RMC," or len(sentence) > RMC_BYTES_MAX - 2:
        return None
    return sentence + b"\r\n"


def _ignore(_sentence: bytes, _t_rx_ns: int) -> None:
    """Ignore the sentence: the receiver before `start` and after `close`."""
