"""All stream codecs: the same events for all chunk sizes, a balanced ledger, and no effect after a pause or a reset."""

import zlib
from collections.abc import Sequence
from random import Random

from imud.contracts.codec import CodecEvent, StreamCodec
from imud.contracts.driver import StreamDriver
from imud.model.ledger import Ledger
from imud.testing.invariants import check_closed, check_counted, cut, feed_stream, untimed
from tests.fuzz.drivers import EXAMPLES, mender, names_of, row, spliced, variants
from tests.fuzz.target import FRAMES_BYTES_MAX, Target

SPLICE_SHARE = 0.1  # share of inputs with an inserted example frame


def names() -> Sequence[str]:
    return names_of(StreamDriver)


def make(name: str) -> Target:
    driver = row(name, StreamDriver)
    choices = variants(driver.settings)
    mend = mender(name)

    def run(data: bytes) -> None:
        settings = choices[len(data) % len(choices)]
        whole, parts, idle = (driver.make_codec(Ledger(), settings) for _ in range(3))
        random = Random(zlib.crc32(data))
        expected = untimed(feed_stream(whole, [data]))
        assert untimed(feed_stream(parts, cut(data, random))) == expected
        assert parts.ledger.values() == whole.ledger.values()
        _flush_and_reset(parts, data)
        _feed_with_pauses(idle, cut(data, random))

    def mended(data: bytes, random: Random) -> bytes:
        if random.random() < SPLICE_SHARE:
            return spliced(data, random, driver.example_frame(random))
        return mend(data, random)

    return Target(run, lambda: seeds(driver), mended, bytes_max=FRAMES_BYTES_MAX)


def seeds(driver: StreamDriver) -> list[bytes]:
    random = Random(1)
    frames = [driver.example_frame(random) for _ in range(EXAMPLES)]
    text = [b"APP_VER=156\r\nPRODUCT=HI13\r\nOK\r\n", b"ERR\r\n"]
    damaged = [frame[: len(frame) // 2] + frames[0] for frame in frames[:2]]
    return [*frames, b"".join(frames[:6]), *text, text[0].join(frames[:3]), *damaged, frames[0] * 3]


def _flush_and_reset(codec: StreamCodec, data: bytes) -> None:
    """A pause loses no frames. A reset leaves no pending bytes, and earlier bytes have no effect after it."""
    codec.flush()
    check_closed(codec.ledger)
    assert codec.flush() == []
    codec.reset()
    assert codec.ledger.bytes_pending == 0
    assert codec.ledger.bytes_in == len(data)
    check_closed(codec.ledger)


def _feed_with_pauses(codec: StreamCodec, parts: Sequence[bytes]) -> None:
    events: list[CodecEvent] = []
    for part in parts:
        events += codec.feed(part)
        events += codec.flush()
        check_closed(codec.ledger)
    check_counted(codec.ledger, events)
