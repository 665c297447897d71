"""RMC sentences in a byte stream: any split, limited buffer; and the pauses between connections."""

import tracemalloc
from random import Random

import pytest

from imud.formats.nmea0183 import build
from imud.model.units import NS_PER_S
from imud.utc.receivers import FIRST_PAUSE_S, LINE_BYTES_MAX, LONGEST_PAUSE_S, Retry, SentenceSplitter
from tests.support.event_loops import in_loop

SENTENCES = [build((1_795_000_000 + n) * NS_PER_S) for n in range(5)]
GGA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
JSON = b'{"class":"TPV","device":"/dev/ttyS0","mode":3}\r\n'


@pytest.mark.parametrize("size", [1, 2, 7, 64, 10_000])
def test_any_split_gives_the_same(size: int) -> None:
    data = JSON + b"".join(sentence + GGA for sentence in SENTENCES)
    splitter = SentenceSplitter()
    found = [s for at in range(0, len(data), size) for s in splitter.feed(data[at : at + size])]
    assert found == SENTENCES


def test_broken_and_too_long_sentences_are_skipped() -> None:
    broken = SENTENCES[0][:30] + SENTENCES[1]
    assert SentenceSplitter().feed(broken + b"noise\xff$" + SENTENCES[2]) == SENTENCES[1:3]
    splitter = SentenceSplitter()
    splitter.feed(SENTENCES[0][:20])
    splitter.clear()
    assert splitter.feed(SENTENCES[0][20:] + SENTENCES[1]) == [SENTENCES[1]]
    random = Random(1)
    assert splitter.feed(b"$GPRMC," + b"1" * 120 + b"\r\n") == []
    for _ in range(100):
        splitter.feed(random.randbytes(random.randrange(200)))


def test_a_line_without_end_is_skipped_and_not_buffered() -> None:
    splitter = SentenceSplitter()
    tracemalloc.start()
    try:
        for _ in range(100):
            assert splitter.feed(b"$" + b"x" * 1000) == []
            assert tracemalloc.get_traced_memory()[0] <= LINE_BYTES_MAX + 4000
    finally:
        tracemalloc.stop()
    assert splitter.feed(SENTENCES[0] + SENTENCES[1]) == [SENTENCES[1]]  # the first sentence ends the skipped line


@in_loop
async def test_pauses() -> None:
    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    retry = Retry(sleep)
    for _ in range(10):
        await retry.pause()
    retry.reset()
    await retry.pause()
    assert pauses[:3] == [FIRST_PAUSE_S, 2 * FIRST_PAUSE_S, 4 * FIRST_PAUSE_S]
    assert pauses[-2:] == [LONGEST_PAUSE_S, FIRST_PAUSE_S]
