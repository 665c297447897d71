"""The NMEA receiver on a port, with a link in memory that the test plays."""

import asyncio

from imud.contracts.link import OnData, OnEnd
from imud.contracts.status import KernelCounters
from imud.errors import LinkError, LinkMissing
from imud.formats.rmc import build
from imud.units import NS_PER_S
from imud.utc.nmea_port import NmeaPortSource, make
from imud.utc.retry import Retry
from imud.utc.source import RmcSettings
from tests.support.sentences import LIMIT_S, Sentences, soon

SENTENCES = [build((1_795_000_000 + n) * NS_PER_S) for n in range(5)]


class Port:
    """A link of bytes whose far end is the test."""

    title = "/dev/ttyGNSS"
    writable = True
    baud = 9600
    auto_baud = False
    hold_ns = 0

    def __init__(self, refusals: int = 0) -> None:
        self.opened = self.closed = 0
        self.on_data: OnData | None = None
        self.on_end: OnEnd | None = None
        self.started = asyncio.Event()
        self._refusals = refusals

    async def wait_present(self) -> None:
        await asyncio.sleep(0)

    def open(self) -> None:
        if self._refusals:
            self._refusals -= 1
            raise LinkError("/dev/ttyGNSS is in use")
        self.opened += 1

    def start(self, on_data: OnData, on_end: OnEnd) -> None:
        self.on_data, self.on_end = on_data, on_end
        self.started.set()

    def write(self, data: bytes) -> None:
        raise AssertionError(data)

    def set_baud(self, baud: int) -> None:
        raise AssertionError(baud)

    def kernel_counters(self) -> KernelCounters:
        return KernelCounters()

    def close(self) -> None:
        self.closed += 1
        self.started.clear()


def test_sentences_come_with_the_time_of_their_last_byte() -> None:
    async def scene() -> None:
        port, sentences = Port(), Sentences()
        source = NmeaPortSource(port, Retry(soon))
        source.start(sentences)
        async with asyncio.timeout(LIMIT_S):
            await port.started.wait()
            assert "9600 bit/s" in source.problem
            assert port.on_data
            port.on_data(SENTENCES[0][:30], 1000)
            port.on_data(SENTENCES[0][30:] + b"$GPGSV,*00\r\n" + SENTENCES[1], 2000)
        assert sentences.got == [(SENTENCES[0], 2000), (SENTENCES[1], 2000)]
        assert (source.problem, source.sentences) == ("", 2)
        await source.close()
        await source.close()
        assert port.closed >= 1

    asyncio.run(scene())


def test_a_port_that_goes_away_or_is_held_is_opened_again() -> None:
    async def scene() -> None:
        port, sentences = Port(refusals=3), Sentences()
        source = NmeaPortSource(port, Retry(soon))
        source.start(sentences)
        async with asyncio.timeout(LIMIT_S):
            await port.started.wait()
            assert port.on_data
            assert port.on_end
            port.on_data(SENTENCES[0] + SENTENCES[1][:20], 1)
            port.on_end(LinkMissing("/dev/ttyGNSS is gone"))
            assert source.problem == "/dev/ttyGNSS is gone"
            port.started.clear()
            await port.started.wait()
            port.on_data(SENTENCES[1][20:] + SENTENCES[2], 2)
        assert sentences.data == [SENTENCES[0], SENTENCES[2]]
        assert port.opened == 2
        await source.close()

    asyncio.run(scene())


def test_the_row_makes_it_of_the_port_that_is_named() -> None:
    asked: list[tuple[str, int]] = []

    def make_port(path: str, baud: int) -> Port:
        asked.append((path, baud))
        return Port()

    async def scene() -> None:
        source = make(RmcSettings(source="nmea", port="/dev/ttyGNSS", baud=38400), make_port)
        assert source.title == "NMEA receiver on /dev/ttyGNSS"

    asyncio.run(scene())
    assert asked == [("/dev/ttyGNSS", 38400)]
