"""Requirements for every stream driver: any split, damage and noise, a balanced ledger."""

from collections.abc import Iterable, Sequence
from random import Random
from typing import Final

from imud.contracts.codec import CodecEvent, StreamCodec
from imud.contracts.driver import StreamDriver
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.testing.invariants import cut, feed_stream, untimed

IDLE: Final = 2000  # number of zero bytes that complete any claimed frame


def make(driver: StreamDriver) -> StreamCodec:
    """Return a codec with its own ledger and default options."""
    return driver.make_codec(Ledger(), driver.settings())


def measurements(events: Iterable[CodecEvent]) -> list[CodecEvent]:
    """Return the measurements without the number of the following bytes in the same read."""
    return [event for event in untimed(events) if isinstance(event, Measurement)]


def truncated(frame: bytes, random: Random) -> bytes:
    """Return the start of a frame. The first byte of the next frame does not complete it."""
    return frame[: random.choice([size for size in range(1, len(frame)) if frame[size] != frame[0]])]


def noise(driver: StreamDriver, random: Random) -> bytes:
    """Return damage of one kind, without a complete frame."""
    frame = driver.example_frame(random)
    flipped = bytearray(frame)
    flipped[random.randrange(len(frame))] ^= 1 << random.randrange(8)
    head = frame[: random.randint(1, 8)]
    text = random.choice((b"APP_VER=156\r\n", b"OK\n", b"\r", b"Z", b"no end", b"\r\n", b"x" * 400))
    kinds = (
        random.randbytes(random.randint(1, 60)),
        truncated(frame, random),
        frame[random.randrange(1, len(frame)) :],  # start lost
        bytes(flipped),
        head + random.randbytes(random.randint(0, 6)),  # a wrong length
        frame[:2] * random.randint(1, 5) + head,  # adjacent sync words
        text,
    )
    return random.choice(kinds)


def adjacent_frames_are_all_decoded(driver: StreamDriver, random: Random, _data: bytes) -> None:
    frames = [driver.example_frame(random) for _ in range(12)]
    alone = [event for frame in frames for event in make(driver).feed(frame)]
    codec = make(driver)
    together = feed_stream(codec, cut(b"".join(frames), random))
    assert (untimed(together), codec.ledger.frames_good) == (untimed(alone), len(frames))
    assert codec.ledger.bytes_in_good_frames == codec.ledger.bytes_in


def any_split_gives_the_same_events(driver: StreamDriver, random: Random, _data: bytes) -> None:
    stream = b"".join(random.choice((driver.example_frame, lambda r: noise(driver, r)))(random) for _ in range(15))
    whole, single, parts = make(driver), make(driver), make(driver)
    expected = untimed(feed_stream(whole, [stream]))
    assert untimed(feed_stream(single, (stream[i : i + 1] for i in range(len(stream))))) == expected
    assert untimed(feed_stream(parts, cut(stream, random))) == expected
    assert whole.ledger.snapshot() == single.ledger.snapshot() == parts.ledger.snapshot()


def a_cut_frame_costs_only_itself(driver: StreamDriver, random: Random, _data: bytes) -> None:
    before, after, lost = ([driver.example_frame(random) for _ in range(n)] for n in (3, 8, 1))
    shortened = truncated(lost[0], random)
    events = feed_stream(make(driver), cut(b"".join([*before, shortened, *after]) + bytes(IDLE), random))
    expected = [event for frame in before + after for event in make(driver).feed(frame)]
    assert measurements(events) == measurements(expected)


def noise_never_costs_an_intact_frame(driver: StreamDriver, random: Random, _data: bytes) -> None:
    stream, expected = b"", list[CodecEvent]()
    for _ in range(12):
        frame = driver.example_frame(random)
        stream += b"".join(noise(driver, random) for _ in range(random.randrange(3))) + frame
        expected += make(driver).feed(frame)
    found = measurements(feed_stream(make(driver), cut(stream + bytes(IDLE), random)))
    assert contains_in_order(found, measurements(expected))


def contains_in_order(found: Sequence[CodecEvent], wanted: Sequence[CodecEvent]) -> bool:
    """Return whether `found` contains all `wanted` events in their order."""
    rest = iter(found)
    return all(any(event == other for other in rest) for event in wanted)


def random_bytes_never_raise(driver: StreamDriver, random: Random, data: bytes) -> None:
    sync = driver.example_frame(random)[:2]
    codec = make(driver)
    feed_stream(codec, cut(data + sync + data.replace(b"\x00", sync), random))
    codec.flush()
    assert codec.ledger.closes()


def flush_returns_frames_inside_an_incomplete_frame(driver: StreamDriver, random: Random, _data: bytes) -> None:
    """A header with a too large length hides the following frames until the link is idle."""
    frames = [driver.example_frame(random) for _ in range(3)]
    expected = [event for frame in frames for event in make(driver).feed(frame)]
    for length in range(2, 8):
        codec = make(driver)
        cut_short = frames[0][:length]
        events = feed_stream(codec, cut(cut_short + b"".join(frames), random))
        events += codec.flush()
        assert measurements(events) == measurements(expected)
        assert codec.ledger.closes()


def flush_keeps_and_reset_skips_pending_bytes(driver: StreamDriver, random: Random, _data: bytes) -> None:
    """A frame with a pause in its middle still arrives, even if the link counts as idle several times."""
    frame = driver.example_frame(random)
    expected = untimed(make(driver).feed(frame))
    codec = make(driver)
    events: list[CodecEvent] = []
    for part in cut(frame, random):
        events += codec.feed(part)
        events += codec.flush()
        assert codec.ledger.closes()
    assert untimed(events) == expected
    codec = make(driver)
    part = random.choice((frame[: random.randrange(1, len(frame))], b"half a line", b"Z"))
    codec.feed(part)
    codec.reset()
    assert (codec.ledger.bytes_pending, codec.ledger.bytes_skipped) == (0, len(part))
    assert codec.ledger.closes()
    assert untimed(codec.feed(frame)) == expected
    assert codec.ledger.closes()


REQUIREMENTS: Final = (
    adjacent_frames_are_all_decoded,
    any_split_gives_the_same_events,
    a_cut_frame_costs_only_itself,
    noise_never_costs_an_intact_frame,
    random_bytes_never_raise,
    flush_returns_frames_inside_an_incomplete_frame,
    flush_keeps_and_reset_skips_pending_bytes,
)
