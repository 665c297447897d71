"""Sources of UTC: an RMC sentence, the stream of gpsd or of a receiver, and the feed that passes sentences to chronyd.

chronyd sends no replies: imud only writes to its socket.
"""

import zlib
from collections.abc import Sequence
from random import Random
from typing import Final

from imud.contracts.lines import UtcReference
from imud.formats.nmea0183 import RMC_BYTES_MAX, Rmc, RmcFault, as_gprmc, build, checksum, parse
from imud.testing.invariants import cut
from imud.utc.receivers import LINE_BYTES_MAX, SentenceSplitter
from imud.utc.rmc_feed import RmcFeed
from tests.fuzz.target import Target

NOW_NS: Final = 80_000_000_000_000
UTC_NS: Final = 1_763_717_507_000_000_000
REFERENCE: Final = UtcReference(UTC_NS - NOW_NS, 1_000_000)
FINE_BYTES: Final = 1024
STREAM_BYTES_MAX: Final = 2 * LINE_BYTES_MAX


def names() -> Sequence[str]:
    return ["rmc", "sentences"]


def make(name: str) -> Target:
    if name == "rmc":
        return Target(run_rmc, rmc_seeds, mend, words=words, bytes_max=2 * RMC_BYTES_MAX)
    return Target(run_sentences, stream_seeds, mend, words=words, bytes_max=STREAM_BYTES_MAX)


def run_rmc(data: bytes) -> None:
    """The result is an error, or a time that is equal after the sentence was encoded again. The feed counts it once."""
    found = parse(data)
    if isinstance(found, Rmc):
        assert 0 <= found.fraction_ns < 1_000_000_000
        assert parse(as_gprmc(data)) == found
        if found.unix_s % 10:
            assert parse(build(found.utc_ns, valid=found.valid)) != RmcFault.CHECKSUM
    else:
        assert isinstance(found, RmcFault)
    for reference in (None, REFERENCE):
        feed = _feed(reference)
        for pulse_ns in (None, NOW_NS - 1000):
            if pulse_ns is not None:
                feed.on_pulse(pulse_ns)
            feed.on_sentence(data, NOW_NS - 500)
        assert feed.sent + sum(feed.refused.values()) == 2


class FreePort:
    bit_rate = 115200
    is_free = True

    def write(self, data: bytes) -> None: ...

    def on_reset(self) -> None: ...


def _feed(reference: UtcReference | None) -> RmcFeed:
    feed = RmcFeed(FreePort(), lambda: NOW_NS)
    feed.reference = reference
    return feed


def run_sentences(data: bytes) -> None:
    whole = SentenceSplitter().feed(data)
    splitter = SentenceSplitter()
    random = Random(zlib.crc32(data))
    long, end = data[:-FINE_BYTES], data[-FINE_BYTES:]  # feeding a long line in single bytes takes quadratic time
    parts = [*(long[at : at + 997] for at in range(0, len(long), 997)), *cut(end, random)]
    assert [sentence for part in parts for sentence in splitter.feed(part)] == whole
    assert all(len(sentence) <= RMC_BYTES_MAX and sentence[:-2] in data for sentence in whole)


def mend(data: bytes, _random: Random) -> bytes:
    """Correct the checksum of each sentence."""
    lines = data.split(b"\n")
    for number, line in enumerate(lines):
        begin, star = line.rfind(b"$"), line.rfind(b"*")
        if 0 <= begin < star:
            lines[number] = line[: star + 1] + b"%02X\r" % checksum(line[begin + 1 : star])
    return b"\n".join(lines)


def rmc_seeds() -> list[bytes]:
    bodies = [
        b"GPRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A", b"GNRMC,,V,,,,,,,,,,N",
        b"GNRMC,235960.5,A,,,,,,,311216,,,A,V", b"GPRMC,000000,A,,,,,,,010180", b"GPRMC,083559.,A,,,,,,,290299,,",
        b"GPRMC,083559.123456789,A,,,,,,,311279,,,D", b"GPRMC,245959,A,,,,,,,000000,,,A", b"GPGGA,1",
    ]  # fmt: skip
    sentences = [b"$%b*%02X\r\n" % (body, checksum(body)) for body in bodies]
    own = [build(UTC_NS + step, valid=valid) for step in (0, 990_000_000) for valid in (True, False)]
    return [*sentences, *own, sentences[0][:-2], sentences[0].replace(b"A", b"B"), b"$" + b"x" * 130 + b"*00\r\n", b""]


def stream_seeds() -> list[bytes]:
    sentences = rmc_seeds()[:6]
    gpsd = [
        b'{"class":"VERSION","release":"3.22","proto_major":3,"proto_minor":14}\r\n',
        b'{"class":"WATCH","enable":true,"json":false,"nmea":true}\r\n',
        b'{"class":"TPV","device":"/dev/ttyS0","mode":3,"time":"2026-01-01T00:00:00.000Z"}\r\n',
    ]
    joined = sentences[0][:20] + sentences[0]
    long = [b"x" * size + sentences[0] for size in (LINE_BYTES_MAX - 100, LINE_BYTES_MAX, LINE_BYTES_MAX + 100)]
    mixed = b"".join(line for pair in zip(gpsd, sentences, strict=False) for line in pair)
    return [
        *sentences, *gpsd, b"".join(gpsd), mixed, b"".join(sentences), joined, *long, long[2] + sentences[0],
        b"\n" * 50,
    ]  # fmt: skip


def words() -> list[bytes]:
    return [b"$GPRMC,", b"$GNRMC,", b",A,", b",V,", b"*00\r\n", b"235960", b"311279", b",,,,,,,", b"\r\n", b'{"class":']
