"""A real gpsd with a receiver on a pseudo-terminal, as the source of RMC sentences."""

import asyncio
import os
import shutil
import subprocess
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic_ns

import pytest

from imud.formats.nmea0183 import checksum
from imud.formats.rmc import Rmc, build, parse
from imud.units import NS_PER_S
from imud.utc.receivers import GpsdSource
from imud.utc.sentence_stream import Retry
from imud.utc.source import RmcSettings
from tests.support.daemon_process import LIMIT_S
from tests.support.rmc_sources import Sentences
from tests.support.surroundings import free_port

UTC_S = 1_795_000_000
NO_GPSD = "" if shutil.which("gpsd") else "gpsd is not installed (Debian package gpsd)"


class Receiver:
    """A GNSS receiver with a fix, on a pty: one cycle of sentences after the other."""

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        os.chmod(self.path, 0o666)  # gpsd gives its rights away
        self.second = UTC_S

    def cycle(self) -> None:
        """One second's sentences."""
        rmc = build(self.second * NS_PER_S)
        time = rmc.split(b",")[1].decode()
        gga = f"GPGGA,{time},0000.000,N,00000.000,E,1,08,0.9,12.0,M,0.0,M,,"
        gsa = "GPGSA,A,3,01,02,03,04,05,06,07,08,,,,,1.6,0.9,1.3"
        rest = "".join(f"${body}*{checksum(body.encode()):02X}\r\n" for body in (gga, gsa))
        with suppress(BlockingIOError):
            os.read(self._master, 4096)  # what gpsd asks of the receiver is not answered
        os.write(self._master, rmc + rest.encode())
        self.second += 1

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


@contextmanager
def gpsd(port: int, device: str, folder: Path) -> Iterator[None]:
    """A gpsd that waits for no client and sends nothing to the receiver."""
    with (folder / "gpsd.log").open("w") as log:
        command = ["gpsd", "-N", "-n", "-b", "-D", "2", "-S", str(port), device]
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            yield
        finally:
            process.terminate()
            process.wait(timeout=LIMIT_S)
            print((folder / "gpsd.log").read_text())


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()
    yield made
    made.close()


@pytest.mark.live
@pytest.mark.skipif(bool(NO_GPSD), reason=NO_GPSD)
def test_sentences_of_the_receiver_come_through_gpsd(receiver: Receiver, tmp_path: Path) -> None:
    port = free_port()

    async def scene() -> Sentences:
        sentences = Sentences()
        source = GpsdSource(
            RmcSettings(source="gpsd", tcp_port=port), monotonic_ns, Retry(lambda _s: asyncio.sleep(0.1))
        )
        source.start(sentences)
        try:
            async with asyncio.timeout(LIMIT_S):
                while len(sentences.got) < 5:
                    receiver.cycle()
                    await asyncio.sleep(0.05)
            assert source.problem == ""
        finally:
            source.close()
        return sentences

    with gpsd(port, receiver.path, tmp_path):
        sentences = asyncio.run(scene())
    parsed = [parse(sentence) for sentence in sentences.data]
    seconds = [rmc.unix_s for rmc in parsed if isinstance(rmc, Rmc) and rmc.valid]
    assert len(seconds) == len(parsed)
    assert seconds == sorted(set(seconds))
    assert set(seconds) <= set(range(UTC_S, receiver.second))
